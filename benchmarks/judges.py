"""How far GRPO with three judges is fooled, by how they are combined: ``python benchmarks/judges.py --seeds 5``.

Trains the example examples/grpo_three_judges.py in every way below. "over training" is the mean over all completions,
"at the end" over those of the last five steps; mean and standard deviation over seeds. Under each way with a discount:
how far it changes the advantages (see uard.adapters.trl.advantage_change), and how many groups are discounted.
"""

import argparse
import importlib.util
import tempfile
import warnings
from pathlib import Path

import numpy as np
import torch

from uard.adapters.trl import UncertaintyDiscountedReward
from uard.method.mitigations import named

warnings.filterwarnings("ignore", category=FutureWarning)
PATH = Path(__file__).parents[1] / "examples" / "grpo_three_judges.py"


def load_example():
    spec = importlib.util.spec_from_file_location("grpo_three_judges", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ways(judges):
    """What the trainer is given in each way: a function that makes the reward functions, and settings."""

    def one(mitigation=None, **settings):
        return lambda: [UncertaintyDiscountedReward(judges, mitigation=mitigation, **settings)]

    return {
        "added up (TRL's default)": (lambda: list(judges), {}),
        "added up, each normalised per group (TRL)": (
            lambda: list(judges),
            {"multi_objective_aggregation": "normalize_then_sum"},
        ),
        "mean on one scale": (one(named("raw")), {}),
        "lowest judge on one scale": (one(named("worst-of-annotations")), {}),
        "mean - deviation on one scale": (one(named("lcb")), {}),
        "median judge on one scale": (one(named("median")), {}),
        "uard": (one(proxy="mean"), {}),
        "uard, median as proxy": (one(proxy="median"), {}),
        "uard, scale_rewards='batch'": (one(), {"scale_rewards": "batch"}),
        "uard, scale_rewards='none'": (one(), {"scale_rewards": "none"}),
    }


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--only", default="", help="only ways with this in their name")
    options = parser.parse_args()
    torch.set_num_threads(1)
    example = load_example()
    print("| way | gold over training | at the end | share of wow over training | at the end | most in one step |")
    print("|---|---|---|---|---|---|", flush=True)
    for name, (make, changes) in ways(example.JUDGES).items():
        if options.only not in name:
            continue
        rows, tallies, change = [], [], []
        for seed in range(options.seeds):
            functions = make()
            with tempfile.TemporaryDirectory() as folder:
                watch, trainer = example.train(functions, seed, folder, max_steps=options.steps, **changes)
            gold, wow = np.array(watch.gold), np.array(watch.exploit)
            rows.append((gold.mean(), gold[-5:].mean(), wow.mean(), wow[-5:].mean(), wow.max()))
            if isinstance(functions[0], UncertaintyDiscountedReward):
                tallies.append(functions[0].tally)
                change.append(trainer.state.log_history[-1]["uard/advantage_change"])
        cells = zip(np.mean(rows, 0), np.std(rows, 0, ddof=1), strict=True)
        print(f"| {name} | " + " | ".join(f"{mean:.2f} ± {sd:.2f}" for mean, sd in cells) + " |", flush=True)
        if sum(tally.discounted for tally in tallies):
            discounted, cancelled, shifted = (
                sum(getattr(tally, count) for tally in tallies) for count in ("discounted", "cancelled", "shifted")
            )
            print(f"  advantages change by {np.mean(change):.2f} ± {np.std(change, ddof=1):.2f}; {discounted} groups "
                  f"discounted, of these {cancelled} cancelled and {shifted} shifted")  # fmt: skip


if __name__ == "__main__":
    main()
