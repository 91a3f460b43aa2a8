"""Section e: below zero the filter prefers what it should avoid."""

from __future__ import annotations

import numpy as np

from uard.envs.tables import Task
from uard.method import bellman
from uard.method.weights import reciprocal_weight
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.verdicts import Part

HAZARDS = (-1.25, -1.5, -2.0, -3.0, -5.0)
LAMBDAS = (0.0, 2.0, 5.0, 10.0)


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [_order(), _penalty(), _hazard(), _kappa(), _scale()]


def _order() -> Check:
    rng = np.random.default_rng(0)
    top = 1.5
    u, size = rng.uniform(0.0, top, (20_000, 4)), rng.uniform(1.0, 2.0, (20_000, 4))
    chosen = {
        f"mean U chosen, {name} values (indifference: 0.75)": float(
            np.take_along_axis(u, (sign * size * reciprocal_weight(u)).argmax(1)[:, None], 1).mean()
        )
        for name, sign in (("negative", -1.0), ("positive", 1.0))
    }
    negative, positive = chosen
    slope = "dJ / d sigma_m at mu = -1, U = 0"
    return Check(
        "e.order",
        recomputed={
            "mu -1, U 0.1": -1.0 * reciprocal_weight(0.1),
            "mu -1.5, U 1.5": -1.5 * reciprocal_weight(1.5),
            slope: paper.LAMBDA * paper.ALPHA,
            **chosen,
        },
        others={"indifference": top / 2},
        claims=(
            Part("of positive values the less uncertain are chosen", lambda n: n[positive] < n["indifference"]),
            Part("of negative values the less uncertain are chosen", lambda n: n[negative] < n["indifference"]),
            Part(
                "a negative value that is worse and less certain scores lower",
                lambda n: n["mu -1.5, U 1.5"] < n["mu -1, U 0.1"],
            ),
            Part("a negative value's score falls with sigma_m", lambda n: n[slope] < 0),
        ),
    )


def _penalty() -> Check:
    left = {lam: reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, lam) for lam in (paper.LAMBDA, 10.0)}
    return Check(
        "e.penalty",
        recomputed={f"lambda {lam:g}": -share for lam, share in left.items()},
        others={"sigma_h": paper.SIGMA_H_AT_TRAP}
        | {f"lambda, {which}": lam for which, lam in zip(("low", "high"), left, strict=True)}
        | {f"share, {which}": share for which, share in zip(("low", "high"), left.values(), strict=True)},
        findings=(
            Part("less than half is left at the lower lambda", lambda n: n["share, low"] < 0.5),
            Part("less is left at the higher lambda", lambda n: n["share, high"] < n["share, low"]),
        ),
    )


def hazard_task(hazard: float) -> tuple[Task, np.ndarray]:
    """Return a small task and its contested steps: a hazard on the direct way, a detour of two steps more round it.

    Args:
        hazard: Reward of entering the hazard.
    """
    step, goal = paper.STEP_REWARD, paper.GOAL_REWARD
    entered = np.array([[1, 2], [5, 5], [3, 3], [4, 4], [5, 5], [5, 5]])
    reward = np.array([[hazard, step], [goal, goal], [step, step], [step, step], [goal, goal], [0.0, 0.0]])
    contested = np.zeros(entered.shape, bool)
    contested[0, 0] = True
    return Task(entered, reward, (entered == 5), 0, 10), contested


def enters(hazard: float, lam: float, sign_aware: bool = False, anchored: bool = False) -> bool:
    """Whether the best path enters a hazard on which the raters disagree by the paper's sigma_h.

    Args:
        hazard: Its reward.
        lam: Strength of the filter.
        sign_aware: Negative rewards are divided by the weight.
        anchored: The filter draws towards one sigma_h below the reward instead of zero.
    """
    task, contested = hazard_task(hazard)
    sigma = np.where(contested, paper.SIGMA_H_AT_TRAP, 0.0)
    weight = reciprocal_weight(paper.BETA * sigma, lam)
    if sign_aware:
        weight = np.where(task.reward < 0, 1.0 / weight, weight)
    anchor = task.reward - sigma if anchored else 0.0
    q = bellman.solve(task.reward, weight, task.next_state, task.terminal, paper.GAMMA, anchor)
    return bellman.greedy_path(q, task, contested).total_visits > 0


def _hazard() -> Check:
    entered = {h: next((lam for lam in LAMBDAS if enters(h, lam)), None) for h in HAZARDS}
    strengths = sorted({lam for lam in entered.values() if lam is not None})
    cases = [(h, lam) for h in HAZARDS for lam in LAMBDAS]
    return Check(
        "e.hazard",
        recomputed={f"hazard {h:g} entered from lambda": lam for h, lam in entered.items()}
        | {
            "cells entered with sign-aware weights": sum(enters(*case, sign_aware=True) for case in cases),
            "cells entered with an anchor one sigma_h below the reward": sum(
                enters(*case, anchored=True) for case in cases
            ),
        },
        others={"unfiltered": LAMBDAS[0], "lowest": min(strengths, default=None)}
        | {"strengths": ", ".join(f"{lam:g}" for lam in strengths)},
        claims=tuple(
            Part(f"a hazard of {h:g} is avoided", lambda n, x=f"hazard {h:g} entered from lambda": n[x] is None)
            for h in HAZARDS
        ),
        findings=(Part("all are avoided without the filter", lambda n: n["lowest"] > n["unfiltered"]),),
    )


def _kappa() -> Check:
    mu, kappa = -0.5, 1.0
    weights = {f"U {u}": 1.0 / (1.0 + kappa * u * u / (2.0 * mu)) for u in (0.3, 0.9, 1.0001, 1.1)}
    return Check(
        "e.kappa",
        recomputed=weights,
        others={"mu": mu, "kappa": kappa},
        claims=tuple(Part(f"it lies there at {u}", lambda n, u=u: 0 < n[u] <= 1) for u in weights),
    )


def _scale() -> Check:
    mu, doubt = np.array([10.0, 6.0]), np.array([0.5, 0.05])
    cases = {"as is": (mu, doubt), "all x 0.1": (0.1 * mu, 0.1 * doubt), "rewards - 10": (mu - 10.0, doubt)}
    scores = {name: m * reciprocal_weight(d) for name, (m, d) in cases.items()}
    used = paper.TABLE_6["Skepticism (lambda)"]
    return Check(
        "e.scale",
        printed={"lambda on grids": float(used.grid), "lambda on MuJoCo": float(used.mujoco)},
        recomputed={f"{name}: J of the two": ", ".join(f"{x:.3f}" for x in s) for name, s in scores.items()}
        | {f"{name}: chosen": float(s.argmax()) for name, s in scores.items()},
        others={"mu": f"({mu[0]:g}, {mu[1]:g})", "U": f"({doubt[0]:g}, {doubt[1]:g})"},
        claims=(
            Part("the choice survives another unit", lambda n: n["all x 0.1: chosen"] == n["as is: chosen"]),
            Part("the choice survives another zero", lambda n: n["rewards - 10: chosen"] == n["as is: chosen"]),
        ),
        findings=(Part("one lambda serves grids and MuJoCo", lambda n: n["lambda on grids"] == n["lambda on MuJoCo"]),),
    )
