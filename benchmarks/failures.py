"""How often are scores that are none found in a log: of a judge that says 0, or -1, where it has failed.

At a rate of 0 % nobody fails, and the share is that of logs in which somebody is said to.

Logs of three judges, six completions per prompt: quality plus errors of 0.4 standard deviations, the second judge with
a scale of 10 about 50, or of 1 about 0. It fails in some of the completions and says 0 or -1. Seeds are 0 to N - 1; on
none of them anything was tuned.

    python benchmarks/failures.py --logs 200
"""

from __future__ import annotations

import argparse

import numpy as np

from uard.judges import ScoreLog, fit
from uard.lab.statistics import wilson

RATES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)
KINDS = {"0, of scores about 50": (50.0, 10.0, 0.0), "-1, of scores about 0": (0.0, 1.0, -1.0)}


def found(seed: int, completions: int, rate: float, location: float, scale: float, failure: float) -> bool:
    """Whether the failure is among the sentinels of the judge that fails, in a log of this seed."""
    random = np.random.default_rng(seed)
    quality = random.normal(size=(completions, 1))
    scores = quality + 0.4 * random.normal(size=(completions, 3))
    scores[:, 1] = np.round(location + scale * scores[:, 1], 2)
    scores[random.random(completions) < rate, 1] = failure
    fitted = fit(ScoreLog(("a", "b", "c"), scores, prompts=[i // 6 for i in range(completions)]))
    sentinels = [judge.sentinels for judge in fitted.panel.judges]
    return bool(sentinels[0] or sentinels[1] or sentinels[2]) if rate == 0 else failure in sentinels[1]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--completions", type=int, nargs="+", default=[300, 1000])
    given = parser.parse_args()
    print("| failure | completions | " + " | ".join(f"{100 * rate:g} %" for rate in RATES) + " |")
    print("|" + "---|" * (len(RATES) + 2))
    for name, kind in KINDS.items():
        for size in given.completions:
            hits = [sum(found(seed, size, rate, *kind) for seed in range(given.logs)) for rate in RATES]
            shares = [(hit / given.logs, *wilson(hit / given.logs, given.logs)) for hit in hits]
            cells = ["{:.2f} [{:.2f}, {:.2f}]".format(*share) for share in shares]
            print(f"| {name} | {size} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
