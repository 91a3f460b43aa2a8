"""What combining judges costs beside their own time: ``python benchmarks/panel.py``.

Milliseconds per batch of 64 completions by 5 judges that answer at once; median [least, most] of 9 turns of 100
batches, rule by rule in each turn. TRL's reward is called as TRL calls it, with both of its logs.
"""

import time
from functools import partial

import numpy as np

from uard.adapters.trl import UncertaintyDiscountedReward
from uard.judges import RULES, PanelReward, ScoreLog, fit

JUDGES, COMPLETIONS, BATCHES, TURNS = 5, 64, 100, 9


def says(scores):
    return lambda **_: scores


def main():
    random = np.random.default_rng(0)
    scores = random.normal(size=(1000, 1)) + 0.5 * random.normal(size=(1000, JUDGES))
    names = tuple(f"judge {k}" for k in range(JUDGES))
    log = ScoreLog(names, scores, prompts=[f"prompt {i // 8}" for i in range(1000)])
    answers = [column.tolist() for column in scores[:COMPLETIONS].T]
    judges = {name: says(given) for name, given in zip(names, answers, strict=True)}
    prompts, texts = [f"prompt {i // 8}" for i in range(COMPLETIONS)], [f"text {i}" for i in range(COMPLETIONS)]
    panels = {rule: fit(log, rule=rule).panel for rule in RULES}
    ways = {f"combine, {rule}": partial(panel.combine, scores[:COMPLETIONS]) for rule, panel in panels.items()}
    ways["asked and combined, uard"] = partial(PanelReward(judges, panels["uard"]), prompts, texts)
    for name, trl in (
        ("fitted panel", UncertaintyDiscountedReward(judges, panel=panels["uard"])),
        ("running scales", UncertaintyDiscountedReward(judges)),
    ):
        logs = {"log_extra": lambda *_: None, "log_metric": lambda *_: None}
        ways[f"TRL's reward, {name}"] = partial(trl, prompts=prompts, completions=texts, **logs)
    taken = {name: [] for name in ways}
    for _ in range(TURNS):
        for name, way in ways.items():
            start = time.perf_counter()
            for _ in range(BATCHES):
                way()
            taken[name].append((time.perf_counter() - start) / BATCHES * 1e3)
    for name, times in taken.items():
        print(f"{name:32} {np.median(times):6.2f} ms [{min(times):.2f}, {max(times):.2f}]")


if __name__ == "__main__":
    main()
