"""verifiers (prime-rl): several judges as one reward of a task. Tested with verifiers 0.4.

    class Poem(vf.Task):
        judged = judged_reward([rhyme, clarity, kindness], "panel.json")

A rollout that nobody could score is an error of its task, which verifiers records and retries; it never scores 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from uard import _checks
from uard.judges import JudgePanel, PanelReward, RewardFunction


def judged_reward(
    judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
    panel: JudgePanel | str | Path,
    *,
    weight: float = 1.0,
    timeout: float | Mapping[str, float] | None = None,
) -> Any:
    """Return a reward method for a ``vf.Task``; assign it to a name in the class.

    Judges are asked with ``prompts`` (the task's prompt as text), ``completions`` (the last reply), ``tasks`` (the
    task's data) and ``traces``, lists of one. What ``Judged.log_of`` returns is recorded as metrics of the rollout,
    without the judges that have no score.

    Examples:
        >>> import verifiers.v1 as vf
        >>> judges = {"long": lambda completions, **_: [len(x) for x in completions], "short": lambda **_: [2.0]}
        >>> class Poem(vf.Task):
        ...     judged = judged_reward(judges, JudgePanel.plain(["long", "short"]))
        >>> [method.__name__ for method in Poem(vf.TaskData(idx=0, prompt="?"), vf.TaskConfig()).hooks("reward")]
        ['judged']

    Args:
        judges: See ``PanelReward``, as for the following.
        panel: What ``uard judges fit`` wrote, or its file.
        weight: Of this reward among the task's.
        timeout: In seconds.

    Raises:
        ModuleNotFoundError: verifiers is not installed.
        InvalidValueError: see ``PanelReward``; the weight is no finite number.
    """
    _checks.number("weight", weight)
    vf: Any = import_module("verifiers.v1")
    reward = PanelReward(judges, panel, timeout=timeout)

    async def judged(self: Any, trace: Any) -> float:
        found = await reward.later([self.data.prompt_text], [trace.last_reply], tasks=[self.data], traces=[trace])
        trace.record_metrics({name: x for name, x in found.log_of(0).items() if not math.isnan(x)})
        (value,) = found.every_reward("reply", [trace.last_reply])
        return value

    return vf.reward(judged, weight=weight)
