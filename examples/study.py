"""I study reward hacking: agents x mitigations x seeds as data, trained once, with intervals (about a minute)."""

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab.cell import Cell
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.result import summaries
from uard.lab.study import results_of
from uard.method.mitigations import named
from uard.ratings.panels import APPENDIX

SEEDS = range(5)


def main() -> None:
    cells = {
        (noise, mitigation): Cell(TrapGrid(6), named(mitigation), QLearning(), APPENDIX, noise)
        for noise in (0.0, 1.2)
        for mitigation in ("raw", "mean-of-annotations", "lcb", "uard")
    }
    store = Store(":memory:")  # a file keeps what is finished
    runner.run([(cell, seed) for cell in cells.values() for seed in SEEDS], store)
    print(f"{'noise':>5}  {'mitigation':20} {'hacks':>24} {'true return':>24}")
    for (noise, mitigation), cell in cells.items():
        found = summaries(results_of(cell, store, SEEDS))
        shown = []
        for s in (found["hacks"], found["true_return"]):
            low, high = s.ci95 or (s.mean, s.mean)  # one seed has no interval
            shown.append(f"{s.mean:.2f} [{low:.2f}, {high:.2f}]")
        print(f"{noise:5}  {mitigation:20} {shown[0]:>24} {shown[1]:>24}")


if __name__ == "__main__":
    main()
