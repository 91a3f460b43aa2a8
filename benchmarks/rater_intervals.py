"""How often the intervals of `uard raters` hold the truth: ``python benchmarks/rater_intervals.py --panels 150``.

Simulated panels of five raters with biases of 0, 0, 0, 0.5 and 1 and noise of 0.2 to 1 (0.4 to 2 for the noisy designs)
rate rewards of deviation 1, of which a share lies by -3. A line per design: the share of intervals, over raters and
panels, that hold a rater's true bias and noise; those that are not defined are left out and counted.
"""

import argparse

import numpy as np

from uard.ratings.log import RatingLog
from uard.ratings.raters import summary

BIAS = np.array([0.0, 0.0, 0.0, 0.5, 1.0])
NOISE = np.array([0.2, 0.4, 0.6, 0.8, 1.0])


def panel(seed, items, visits, noise, lies, rewarded):
    """Draw one log."""
    random = np.random.default_rng([seed, items, visits])
    reward = random.normal(size=items)
    truth = reward - 3.0 * (random.random(items) < lies)
    rows = np.repeat(np.arange(items), visits)
    said = truth[rows, None] + BIAS + noise * random.normal(size=(rows.size, 5))
    return RatingLog(reward[rows] if rewarded else None, said, item=rows)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--panels", type=int, default=150)
    panels = parser.parse_args().panels
    designs = ((1, 1, 0.1, True), (1, 2, 0.1, True), (1, 1, 0.0, False), (3, 1, 0.1, True))
    print("items visits  noise  lies rewards |  bias held  noise held  not defined")
    for items in (12, 40, 100):
        for visits, scale, lies, rewarded in designs:
            noise, beyond = NOISE * scale, BIAS
            if not rewarded:
                beyond = np.array([b - np.median(np.delete(BIAS, k)) for k, b in enumerate(BIAS)])
            held = {"bias": [], "noise": []}
            undefined = 0
            for seed in range(panels):
                told = summary(panel(seed, items, visits, noise, lies, rewarded)).raters
                for name, true in (("bias", beyond), ("noise", noise)):
                    for rater, value in zip(told, true, strict=True):
                        found = getattr(rater, name)
                        if found is None or found.low is None:
                            undefined += 1
                        else:
                            held[name].append(found.low <= value <= found.high)
            print(f"{items:5} {visits:6} {scale:5}x {lies:5} {rewarded!s:>7} | {np.mean(held['bias']):9.2f} "
                  f"{np.mean(held['noise']):11.2f} {undefined:12}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
