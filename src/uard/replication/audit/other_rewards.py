"""Section f: learning from the mean rating without a filter, and the filter with an anchor."""

from __future__ import annotations

import numpy as np

from uard.envs.grids.trapgrid import paper_grid
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.raters import MAIN
from uard.replication.audit.solutions import (
    SIZES,
    TRAP_REWARDS,
    by_size,
    critical_lambdas,
    in_words,
    solved,
    walk,
)
from uard.replication.verdicts import Part

SIGMA, ANCHOR = paper.SIGMA_H_AT_TRAP, -1.0


def checks() -> list[Check]:
    """Return the checks of this part of the section."""
    return [_mean_rating(), _anchor()]


def _mean_rating() -> Check:
    paths = {}
    for name, mean in (("main {-1, 2, 1}", float(np.mean(MAIN))), ("appendix", paper_grid(6).true_trap_reward)):
        for size in SIZES:
            grid = paper_grid(size)
            rated = np.where(grid.truth().hack, mean, grid.task().reward)
            paths[name, size] = walk(grid, solved(grid, reward=rated))
    hacked = [size for (name, size), path in paths.items() if name != "appendix" and not path.reached_goal]
    solved_by_appendix = [
        p for (name, _), p in paths.items() if name == "appendix" and p.reached_goal and not p.total_visits
    ]
    return Check(
        "f.mean-rating",
        recomputed={f"{name}, {size}": in_words(path) for (name, size), path in paths.items()},
        others={"grids": len(SIZES), "grids solved with the appendix's": len(solved_by_appendix)}
        | {"grids hacked with the main ones": len(hacked), "hacked": ", ".join(f"{n}x{n}" for n in hacked)},
        findings=(
            Part("the appendix's avoid and arrive", lambda n: n["grids solved with the appendix's"] == n["grids"]),
            Part("with the main ones it hacks somewhere", lambda n: n["grids hacked with the main ones"] > 0),
        ),
    )


def _anchor() -> Check:
    table, shares, without = {}, [], {}
    for reward in TRAP_REWARDS:
        goal = critical_lambdas(SIGMA, 0.0, reward, anchor=ANCHOR)
        zero = critical_lambdas(SIGMA, 0.0, reward, anchor=ANCHOR, visits_allowed=0)
        table |= by_size(f"goal, +{reward:g}", goal) | by_size(f"goal without a visit, +{reward:g}", zero)
        plain = critical_lambdas(SIGMA, 0.0, reward)
        shares += [g / p for g, p in zip(goal.values(), plain.values(), strict=True) if g is not None and p is not None]
        without[f"without a visit, +{reward:g}"] = max(lam for lam in zero.values() if lam is not None)
    return Check(
        "f.anchor",
        recomputed=table,
        others={"lowest share": min(shares), "highest share": max(shares), "b": ANCHOR, **without}
        | {"trap": paper.TRAP_REWARD, "hard trap": paper.HARD_TRAP_REWARD},
        findings=(Part("at most half of the unanchored lambda", lambda n: n["highest share"] <= 0.5),),
    )
