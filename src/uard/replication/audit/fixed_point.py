"""Section f: does the fixed point of T_lambda (A21-A23), the operator of Theorem 1, stop hacking?"""

from __future__ import annotations

import math

from uard.envs.grids.trapgrid import paper_grid
from uard.method.bellman import GreedyPath
from uard.method.weights import reciprocal_weight
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.episodes import visits_of_the_best
from uard.replication.audit.raters import annotator_sigmas, appendix
from uard.replication.audit.solutions import (
    SIZES,
    TRAP_REWARDS,
    arriving,
    at_traps,
    by_size,
    critical_lambdas,
    critical_ratios,
    in_words,
    solved,
    walk,
)
from uard.replication.audit.table_3 import reductions
from uard.replication.verdicts import Part


def checks() -> list[Check]:
    """Return the checks of this part of the section."""
    return [
        _lambda_2(),
        _critical_lambda(),
        _critical_ratio(),
        _positivity(),
        _origin_of_the_percentage(),
        _undiscounted(),
    ]


def settings(lam: float) -> dict[str, GreedyPath]:
    """Return the walks of T_lambda's fixed point for every reading of the annotators, trap reward and grid size."""
    paths = {}
    for name, (trap, elsewhere) in annotator_sigmas().items():
        for reward in TRAP_REWARDS:
            for size in SIZES:
                grid = paper_grid(size, reward)
                weight = reciprocal_weight(paper.BETA * at_traps(grid, trap, elsewhere), lam)
                paths[f"{name}, +{reward:g}, {size}"] = walk(grid, solved(grid, weight))
    return paths


def _lambda_2() -> Check:
    paths = settings(paper.LAMBDA)
    return Check(
        "f.lambda-2",
        recomputed={name: in_words(path) for name, path in paths.items()}
        | {"settings that hack": float(sum(not p.reached_goal for p in paths.values())), "settings": float(len(paths))},
        others={"lambda": paper.LAMBDA},
        claims=(Part("no setting hacks", lambda n: n["settings that hack"] == 0),),
    )


def _critical_lambda() -> Check:
    sigmas = annotator_sigmas()
    table, exponential = {}, {}
    for name, (trap, elsewhere) in sigmas.items():
        for reward in TRAP_REWARDS:
            table |= by_size(f"{name}, +{reward:g}", critical_lambdas(trap, elsewhere, reward))
    for reward in TRAP_REWARDS:
        lambdas = critical_lambdas(sigmas["main, population SD"][0], 0.0, reward, "exponential")
        exponential |= by_size(f"exponential, main, +{reward:g}", lambdas)
    small, enough, large = (paper.TEXT[f"lambda {which}"].value for which in ("too small", "avoids", "too large"))
    arrive, far = "settings that arrive at lambda = 5", 2 * large
    return Check(
        "f.critical-lambda",
        printed={"lambda": paper.LAMBDA, "too small below": small, "avoids": enough, "too large above": large},
        recomputed={**table, arrive: float(sum(lam <= enough for lam in arriving(table))), **exponential},
        others={
            "lowest": min(arriving(table)),
            "highest": max(arriving(table)),
            "settings": len(table),
            "far above": far,
        }
        | {"settings that arrive far above": sum(path.reached_goal for path in settings(far).values())}
        | {"settings of the appendix that arrive": len(arriving({k: x for k, x in table.items() if "appendix" in k}))},
        claims=(
            Part("below the lambda of L1971 every setting hacks", lambda n: n["lowest"] >= n["too small below"]),
            Part("at the one of L1973 every setting arrives", lambda n: n[arrive] == n["settings"]),
            Part(
                "far above the largest of L1973 fewer arrive", lambda n: n["settings that arrive far above"] < n[arrive]
            ),
        ),
        findings=(Part("none arrives with the appendix's", lambda n: n["settings of the appendix that arrive"] == 0),),
    )


def _critical_ratio() -> Check:
    trap, elsewhere = appendix(0)
    limits = {
        "appendix, lambda to infinity, w of the mean sigma_h": elsewhere.mean() / trap.mean(),
        "appendix, lambda to infinity, mean w of fresh draws": trap.weight_ratio_limit(elsewhere),
    }
    ratios = {f"+{reward:g}, {size}": ratio for (size, reward), ratio in critical_ratios().items()}
    return Check(
        "f.critical-ratio",
        recomputed={
            **ratios,
            **limits,
            "main at lambda = 2": reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, paper.LAMBDA),
        },
        others={"largest ratio": max(ratios.values()), "lowest limit": min(limits.values())},
        findings=(
            Part(
                "the appendix's annotators stay above it in the limit", lambda n: n["lowest limit"] > n["largest ratio"]
            ),
        ),
    )


def _positivity() -> Check:
    weight = 1e-3
    paths = {str(n): walk(g, solved(g, at_traps(g, weight, 1.0))) for n, g in ((n, paper_grid(n)) for n in SIZES)}
    return Check(
        "f.positivity",
        printed={"visits": paper.TABLE_4[2].visits.mean},
        recomputed={size: in_words(path) for size, path in paths.items()},
        others={f"{size}, visits": path.total_visits for size, path in paths.items()} | {"w": weight},
        claims=tuple(Part(f"it can on {n}x{n}", lambda n, x=f"{n}, visits": n[x] <= n["visits"]) for n in SIZES),
    )


def _origin_of_the_percentage() -> Check:
    most = paper.FIGURES["G4"].number("baseline up to")
    return Check(
        "f.93.7",
        printed={"6x6": paper.PERCENT["visits-6x6"].value, "abstract": paper.PERCENT["hacking"].value},
        recomputed={
            "Table 3, 10x10": reductions()["UARD"],
            "one crossing in 16": 100.0 * (1.0 - 1.0 / most),
            "one in 16.2": 100.0 * (1.0 - 1.0 / paper.TABLE_4[0].visits.mean),
        },
        others={"visits of the baseline, up to": most, "UARD's SD": paper.TABLE_4[2].visits.sd},
        findings=(
            Part(
                "one visit gives that on 6x6, cut off",
                lambda n: math.floor(10 * n["one crossing in 16"]) / 10 == n["6x6"],
            ),
            Part("Table 3 gives that of the abstract", lambda n: round(n["Table 3, 10x10"], 1) == n["abstract"]),
            Part("the two percentages differ", lambda n: n["6x6"] != n["abstract"]),
        ),
    )


def _undiscounted() -> Check:
    largest = {reward: -paper.STEP_REWARD / reward for reward in TRAP_REWARDS}
    visits = {w: f"visits of the best policy of 40 steps, 6x6, +4, w = {w}" for w in (0.024, 0.026)}
    below, above = visits.values()
    return Check(
        "f.undiscounted",
        printed={"lambda": paper.LAMBDA},
        recomputed={f"w, +{reward:g}": w for reward, w in largest.items()}
        | {
            f"lambda, +{reward:g}": (1.0 / w - 1.0) / (paper.BETA * paper.SIGMA_H_AT_TRAP)
            for reward, w in largest.items()
        }
        | {name: float(visits_of_the_best(paper_grid(6), w)) for w, name in visits.items()},
        others={"w below": min(visits), "w above": max(visits), "step": -paper.STEP_REWARD},
        findings=(
            Part("one weight tried is below the limit", lambda n: n["w below"] < n["w, +4"]),
            Part("the other one is above it", lambda n: n["w above"] > n["w, +4"]),
            Part("below it the trap is crossed once", lambda n: n[below] == 1),
            Part("above it one bounces", lambda n: n[above] > 1),
        ),
    )
