"""OpenRLHF: several judges as the file that ``--reward.remote_url`` names. Tested against the interface of 0.11.2.

# my_judges.py
reward_func = reward_function([relevance, clarity, kindness], "panel.json")
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from uard import _checks
from uard.judges import JudgePanel, PanelReward, RewardFunction


def reward_function(
    judges: Mapping[str, RewardFunction] | Sequence[RewardFunction],
    panel: JudgePanel | str | Path,
    *,
    timeout: float | Mapping[str, float] | None = None,
) -> Callable[[Sequence[str], Sequence[str], Sequence[Any] | None], dict[str, Any]]:
    """Return ``reward_func(queries, prompts, labels)`` as OpenRLHF calls it, from many threads.

    A query is prompt and completion; judges get both apart, and ``labels`` unless there are none.

    Examples:
        >>> judges = {"long": lambda completions, **_: [len(x) for x in completions], "short": lambda **_: [2.0]}
        >>> reward_func = reward_function(judges, JudgePanel.plain(["long", "short"]))
        >>> sorted(reward_func(["why? so"], ["why?"], ["-"]))
        ['extra_logs', 'rewards', 'scores']

    Args:
        judges: See ``PanelReward``, as for the following.
        panel: What ``uard judges fit`` wrote, or its file.
        timeout: In seconds.

    Returns:
        A function that returns ``rewards`` and ``scores``, a number per query (of one query the number itself, as
        OpenRLHF's executor takes it), and ``extra_logs``, see ``Judged.log_of``: the same names for every query, NaN
        where a judge has no score. It raises JudgeError where nobody scored a query, because OpenRLHF has no missing
        reward: 0 would be one, and NaN would spoil the rewards of the other completions of the prompt. OpenRLHF logs
        the error and stops for want of the reward.

    Raises:
        InvalidValueError: see ``PanelReward``.
    """
    reward = PanelReward(judges, panel, timeout=timeout)

    def reward_func(
        queries: Sequence[str], prompts: Sequence[str], labels: Sequence[Any] | None = None
    ) -> dict[str, Any]:
        """Score some queries.

        Raises:
            InvalidValueError: there is not one prompt, or not one label, per query, or a query does not begin with its
                prompt.
            JudgeError: no judge scored a query.
        """
        for name, column in (("prompts", prompts), ("labels", labels)):
            if column is not None and len(column) != len(queries):
                raise _checks.InvalidValueError(f"number of {name}", len(column), f"{len(queries)}, one per query")
        completions = [_completion(row, query, prompts[row]) for row, query in enumerate(queries)]
        columns = {} if labels is None else {"labels": list(labels)}
        judged = reward(prompts, completions, **columns)
        rewards = judged.every_reward("query", queries)
        logs = [judged.log_of(row) for row in range(len(rewards))]
        if len(rewards) == 1:
            return {"rewards": rewards[0], "scores": rewards[0], "extra_logs": logs[0]}
        extra = {name: [log[name] for log in logs] for name in (logs[0] if logs else ())}
        return {"rewards": rewards, "scores": rewards, "extra_logs": extra}

    return reward_func


def _completion(row: int, query: str, prompt: Any) -> str:
    """Return a query's completion; some tokenizers add a token of the beginning before the prompt."""
    found = re.match(rf"\s*(?:<[^<>]*>\s*)?{re.escape(prompt)}", query) if isinstance(prompt, str) else None
    if found is None:
        raise _checks.InvalidValueError(f"query {row}", query, f"a text that begins with its prompt, {prompt!r}")
    return query[found.end() :]
