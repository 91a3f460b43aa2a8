"""verl: several judges as ``compute_score``. Tested against the interface of 0.9.1.

# my_judges.py, for reward.custom_reward_function.path=my_judges.py and .name=compute_score
compute_score = score_function([relevance, clarity, kindness], "panel.json")
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from uard import _checks
from uard.judges import JudgePanel, PanelReward, RewardFunction
from uard.judges.asking import is_listed


def score_function(
    judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
    panel: JudgePanel | str | Path,
    *,
    timeout: float | Mapping[str, float] | None = None,
) -> Callable[..., dict[str, float]]:
    """Return ``compute_score`` for verl's ``naive`` reward manager, which asks about one solution at a time.

    Examples:
        >>> judges = {"long": lambda completions, **_: [len(x) for x in completions], "short": lambda **_: [2.0]}
        >>> compute_score = score_function(judges, JudgePanel.plain(["long", "short"]))
        >>> found = compute_score(data_source="riddles", solution_str="so", ground_truth="42", extra_info={})
        >>> round(found["score"], 2), found["uard/long"]
        (1.99, 2.0)

    Args:
        judges: See ``PanelReward``, as for the following. They get ``prompts`` (``question`` or ``prompt`` of
            ``extra_info``, else an empty text), ``data_sources``, ``ground_truths`` and ``extra_infos``.
        panel: What ``uard judges fit`` wrote, or its file.
        timeout: In seconds.

    Returns:
        A function that returns ``score`` and, for the logs, what ``Judged.log_of`` returns: always the same names, and
        none that verl uses itself.

    Raises:
        InvalidValueError: see ``PanelReward``.
    """
    reward = PanelReward(judges, panel, timeout=timeout)

    def compute_score(
        data_source: str, solution_str: str, ground_truth: Any, extra_info: Mapping[str, Any] | None = None, **more: Any
    ) -> dict[str, float]:
        """Score one solution.

        Raises:
            JudgeError: no judge scored it; verl has no missing reward, and 0 would be one.
        """
        (found,) = _scored(reward, [data_source], [solution_str], [ground_truth], [extra_info], more)
        return found

    return compute_score


def batch_score_function(
    judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
    panel: JudgePanel | str | Path,
    *,
    timeout: float | Mapping[str, float] | None = None,
) -> Callable[..., list[dict[str, float]]]:
    """Return ``compute_score`` for verl's ``batch`` reward manager; see ``score_function``.

    Examples:
        >>> judges = {"long": lambda completions, **_: [len(x) for x in completions], "short": lambda **_: [2.0, 1.0]}
        >>> compute_score = batch_score_function(judges, JudgePanel.plain(["long", "short"]))
        >>> questions = {"data_sources": ["riddles"] * 2, "ground_truths": ["42"] * 2, "extra_infos": [{}] * 2}
        >>> [found["uard/long"] for found in compute_score(solution_strs=["so", "then"], **questions)]
        [2.0, 4.0]

    Args:
        judges: See there, as for the following.
        panel: What ``uard judges fit`` wrote, or its file.
        timeout: In seconds.

    Raises:
        InvalidValueError: see ``PanelReward``.
    """
    reward = PanelReward(judges, panel, timeout=timeout)

    def compute_score(
        data_sources: Sequence[str],
        solution_strs: Sequence[str],
        ground_truths: Sequence[Any],
        extra_infos: Sequence[Mapping[str, Any] | None],
        **more: Any,
    ) -> list[dict[str, float]]:
        """Score some solutions.

        Raises:
            JudgeError: no judge scored one of them.
        """
        return _scored(reward, data_sources, solution_strs, ground_truths, extra_infos, more)

    return compute_score


def _scored(
    reward: PanelReward,
    sources: Sequence[str],
    solutions: Sequence[str],
    truths: Sequence[Any],
    infos: Sequence[Mapping[str, Any] | None],
    more: Mapping[str, Any],
) -> list[dict[str, float]]:
    columns = {"data_sources": sources, "ground_truths": truths, "extra_infos": infos}
    for name, column in columns.items():
        if not is_listed(column) or len(column) != len(solutions):
            allowed = f"a list of {len(solutions)}, one per solution"
            raise _checks.InvalidValueError(name, column, allowed)
    given = [_columns(row, info) for row, info in enumerate(infos)]
    prompts = [info.get("question", info.get("prompt", "")) for info in given]
    own = {"data_sources": list(sources), "ground_truths": list(truths), "extra_infos": given}
    judged = reward(**{**more, **own, "prompts": prompts, "completions": solutions})
    scores = judged.every_reward("solution", solutions)
    return [{"score": score, **judged.log_of(row)} for row, score in enumerate(scores)]


def _columns(row: int, info: Any) -> dict[str, Any]:
    if info is not None and not isinstance(info, Mapping):
        raise _checks.InvalidValueError(f"extra_info of solution {row}", info, "a dictionary or None")
    return dict(cast("Mapping[str, Any]", info or {}))
