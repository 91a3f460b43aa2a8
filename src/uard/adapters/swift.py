"""ms-swift: several judges as one ORM. Tested against the interface of 4.6.0.

# plugin.py, for --external_plugins plugin.py --reward_funcs judges
from swift.rewards import orms
orms["judges"] = judged_orm([relevance, clarity, kindness], "panel.json")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from uard import _checks
from uard.judges import JudgePanel, PanelReward, RewardFunction


def judged_orm(
    judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
    panel: JudgePanel | str | Path,
    *,
    timeout: float | Mapping[str, float] | None = None,
) -> type:
    """Return a class as ms-swift keeps them in ``orms``: built with ``args``, called with ``completions`` and columns.

    Examples:
        >>> judges = {"long": lambda completions, **_: [len(x) for x in completions], "short": lambda **_: [2.0, 1.0]}
        >>> orm = judged_orm(judges, JudgePanel.plain(["long", "short"]))(args=None)
        >>> len(orm(completions=["so", "therefore"], messages=[[], []]))
        2

    Args:
        judges: See ``PanelReward``, as for the following. They get ``prompts`` (``messages`` without the answer) and
            the other columns of the data set. A column ``prompts`` of its own is passed on only if there are no
            ``messages``.
        panel: What ``uard judges fit`` wrote, or its file.
        timeout: In seconds.

    Raises:
        InvalidValueError: see ``PanelReward``.
    """
    reward = PanelReward(judges, panel, timeout=timeout)

    class UncertaintyDiscountedORM:
        """Judges as one reward function."""

        def __init__(self, args: Any = None, **kwargs: Any):
            self.args = args

        def __call__(self, completions: Sequence[Any], **columns: Any) -> list[float | None]:
            """Return a reward per completion, None where nobody scored it."""
            talks = columns.get("messages")
            if talks is not None:
                columns["prompts"] = [_prompt(row, talk) for row, talk in enumerate(talks)]
            prompts = columns.pop("prompts", [[]] * len(completions))
            return reward(prompts, completions, **columns).rewards()

    return UncertaintyDiscountedORM


def _prompt(row: int, talk: Any) -> list[Any]:
    """Return a conversation without the answer at its end."""
    messages = cast("list[Any]", talk if isinstance(talk, list) else [talk])
    if not all(isinstance(message, Mapping) for message in messages):
        raise _checks.InvalidValueError(f"messages[{row}]", messages, "a list of messages, each with role and content")
    return messages[:-1] if messages and messages[-1].get("role") == "assistant" else messages
