"""Section a: the comparison of baselines on 10x10 (Table 3, F3)."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.episodes import LAST_EPSILONS, episode_moments, hacker_policy, most_visits
from uard.replication.audit.solutions import straight_return
from uard.replication.verdicts import Opinion, Part

ROWS = {r.method: r for r in paper.TABLE_3}
VISITS = {r.method: r.visits.mean / paper.LAST_EPISODES for r in paper.TABLE_3}  # per episode
BASELINES = [m for m in ROWS if m != "UARD"]
GAIN = paper.TRAP_REWARD - paper.STEP_REWARD  # of a step onto a trap, against any other step


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [
        _horizon(),
        _horizon_inclusive(),
        _identity(),
        _sd(),
        _goal(),
        _ceiling(),
        _hacker(),
        _epsilon(),
        _random(),
        _cost_limit(),
        _percent(),
        _optimum(),
    ]


def horizons(trap_reward: float) -> dict[str, float]:
    """Return the T that each row implies, from R = trap_reward v - 0.1 T."""
    return {m: (trap_reward * VISITS[m] - r.reward.mean) / -paper.STEP_REWARD for m, r in ROWS.items()}


@cache
def horizon() -> int:
    """Return the T with which Table 3 was made, as a.horizon finds it."""
    return round(float(np.mean(list(horizons(GAIN).values()))))


def _grid() -> TrapGrid:
    return paper_grid(10, horizon=horizon())


def _horizon() -> Check:
    implied = horizons(GAIN)
    return Check(
        "a.horizon",
        printed={"T (L901)": float(paper.HORIZON[10]), "T (L1002)": float(paper.HORIZON_IN_TEXT)},
        recomputed=implied,
        others={"lowest T": min(implied.values()), "highest T": max(implied.values()), "rows": len(ROWS)}
        | {"trap": paper.TRAP_REWARD, "step": -paper.STEP_REWARD},
        claims=(
            Part("T is the one of L901", lambda n: round(n["lowest T"]) == round(n["highest T"]) == n["T (L901)"]),
            Part("T is the one of L1002", lambda n: round(n["lowest T"]) == round(n["highest T"]) == n["T (L1002)"]),
        ),
        findings=(Part("all rows imply one T", lambda n: round(n["lowest T"]) == round(n["highest T"])),),
    )


def _horizon_inclusive() -> Check:
    implied = horizons(paper.TRAP_REWARD)
    return Check(
        "a.horizon-inclusive",
        recomputed=implied,
        others={"lowest T": min(implied.values()), "highest T": max(implied.values()), "step": -paper.STEP_REWARD},
        findings=(Part("the rows imply different T", lambda n: round(n["lowest T"]) < round(n["highest T"])),),
    )


def residuals() -> dict[str, float]:
    """Return what is left of each row's mean reward when trap visits and T - v other steps are taken off."""
    return {m: r.reward.mean - (GAIN * VISITS[m] + paper.STEP_REWARD * horizon()) for m, r in ROWS.items()}


def _identity() -> Check:
    left = residuals()
    return Check(
        "a.identity",
        printed={f"{m}, R": r.reward.mean for m, r in ROWS.items()},
        recomputed={**left, "largest residual": max(map(abs, left.values()))},
        others={"gain": GAIN, "cost": -paper.STEP_REWARD * horizon(), "T": horizon()},
        findings=(Part("no row is off by more than its rounding", lambda n: n["largest residual"] <= 0.005),),
    )


def _sd() -> Check:
    implied = {m: GAIN * r.visits.sd / paper.LAST_EPISODES for m, r in ROWS.items()}
    return Check(
        "a.sd",
        printed={f"{m}, SD(R)": r.reward.sd for m, r in ROWS.items()},
        recomputed=implied,
        others={"gain": GAIN, "largest difference": max(abs(implied[m] - r.reward.sd) for m, r in ROWS.items())},
        findings=(Part("no row is off by more than its rounding", lambda n: n["largest difference"] <= 0.005),),
    )


def _goal() -> Check:
    left = residuals()
    shift = "shift of the mean by one arrival in 1000 episodes"
    return Check(
        "a.goal",
        recomputed={
            shift: (paper.GOAL_REWARD - paper.STEP_REWARD) / (paper.SEEDS * paper.LAST_EPISODES),
            "largest residual": max(map(abs, left.values())),
        },
        others={"UARD's residual": left["UARD"], "episodes": paper.LAST_EPISODES},
        claims=(Part("UARD's row leaves room for one arrival", lambda n: abs(n["UARD's residual"]) >= n[shift]),),
        findings=(Part("no row leaves room for one arrival", lambda n: n["largest residual"] < n[shift]),),
    )


def _ceiling() -> Check:
    grids = [*paper.HORIZON.items(), (10, horizon())]
    highest = {f"{n}x{n}, T = {t}": float(most_visits(paper_grid(n, horizon=t))) for n, t in grids}
    visits = {m: VISITS[m] for m in BASELINES}
    return Check(
        "a.ceiling",
        printed=visits,
        recomputed=highest,
        others={"fewest": min(visits.values()), "most": max(visits.values()), "T": paper.HORIZON[10]}
        | {"ceiling at T": highest[f"10x10, T = {paper.HORIZON[10]}"]},
        claims=(
            Part(
                "the visits of every baseline are possible at the T of L901", lambda n: n["most"] <= n["ceiling at T"]
            ),
        ),
        findings=(Part("the visits of no baseline are possible at it", lambda n: n["fewest"] > n["ceiling at T"]),),
    )


def _hacker() -> Check:
    hacker = episode_moments(_grid(), hacker_policy(_grid()), LAST_EPSILONS)
    other = episode_moments(_grid(), hacker_policy(_grid(), spread_ties=False), LAST_EPSILONS)
    total, sd = float(hacker.visits.sum()), float(np.sqrt(hacker.visits_variance.sum()))
    methods = ("CQL", "TRPO", "CPO", "DQN")
    return Check(
        "a.hacker",
        printed={f"{m}, visits": ROWS[m].visits.mean for m in methods},
        recomputed={
            "visits in 100 episodes": total,
            "SD": sd,
            "visits, first of tied actions": float(other.visits.sum()),
            "mean reward": float(hacker.observed_return.mean()),
        }
        | {f"z of {m}": (ROWS[m].visits.mean - total) / (sd / math.sqrt(paper.SEEDS)) for m in methods},
        others={"first": paper.EPISODES - paper.LAST_EPISODES + 1, "last": paper.EPISODES, "T": horizon()},
        findings=(
            Part("CQL's row cannot be told from it", lambda n: abs(n["z of CQL"]) < 2),
            Part("TRPO's row cannot be told from it", lambda n: abs(n["z of TRPO"]) < 2),
            Part("CPO hacks less than it", lambda n: n["z of CPO"] < -2),
            Part("DQN hacks less than it", lambda n: n["z of DQN"] < -2),
            Opinion("TRPO has no epsilon", True),
        ),
    )


def _epsilon() -> Check:
    constant = np.linspace(0.05, 0.2, 31)
    curve = episode_moments(_grid(), hacker_policy(_grid()), constant).visits
    schedule = "mean epsilon of the schedule, episodes 401-500"
    return Check(
        "a.epsilon",
        printed={schedule: float(np.mean(LAST_EPSILONS))},
        recomputed={m: float(np.interp(-VISITS[m], -curve, constant)) for m in ("DQN", "CPO")},
        findings=(
            Part("DQN's epsilon is above the schedule", lambda n: n["DQN"] > n[schedule]),
            Part("CPO's epsilon is above the schedule", lambda n: n["CPO"] > n[schedule]),
        ),
    )


def _random() -> Check:
    random, uard = episode_moments(_grid(), hacker_policy(_grid()), 1.0), ROWS["UARD"]
    walker = float(random.visits[0])
    return Check(
        "a.random",
        printed={"UARD's visits": VISITS["UARD"], "UARD's reduction %": uard.reduction}
        | {"UARD's reward": uard.reward.mean, "UARD's goal %": 0.0},
        recomputed={
            "visits": walker,
            "reduction %": 100.0 * (1.0 - walker / VISITS["DQN"]),
            "reward": float(random.observed_return[0]),
            "goal %": 100.0 * float(random.success_rate[0]),
        },
        others={"T": horizon()},
        claims=(
            Part("UARD visits fewer traps than the walker", lambda n: n["UARD's visits"] < n["visits"]),
            Part("UARD reaches the goal more often than the walker", lambda n: n["UARD's goal %"] > n["goal %"]),
            Part("UARD has more observed reward than the walker", lambda n: n["UARD's reward"] > n["reward"]),
        ),
    )


def _cost_limit() -> Check:
    return Check(
        "a.cost-limit",
        printed={"limit": paper.CPO_COST_LIMIT},
        recomputed={"visits": VISITS["CPO"], "times the limit": VISITS["CPO"] / paper.CPO_COST_LIMIT},
        claims=(Part("CPO keeps its cost limit", lambda n: n["visits"] <= n["limit"]),),
    )


def reductions() -> dict[str, float]:
    """Return each method's reduction of visits against DQN in %."""
    return {m: 100.0 * (1.0 - v / VISITS["DQN"]) for m, v in VISITS.items()}


def _percent() -> Check:
    return Check(
        "a.percent",
        printed={f"{m}, printed": r.reduction for m, r in ROWS.items()},
        recomputed=reductions(),
        claims=tuple(
            Part(f"{m}'s reduction follows", lambda n, m=m: round(n[m], 1) == n[f"{m}, printed"])
            for m in ROWS
            if m != "DQN"
        ),
    )


def _optimum() -> Check:
    uard, dqn = ROWS["UARD"].reward, ROWS["DQN"].reward
    return Check(
        "a.optimum",
        printed={"UARD": uard.mean, "UARD, SD": uard.sd, "DQN, SD": dqn.sd},
        recomputed={"walking to the goal": straight_return(10)},
        claims=(
            Part("UARD's reward varies no more over seeds than DQN's", lambda n: n["UARD, SD"] <= n["DQN, SD"]),
            Part("UARD's reward is that of walking to the goal", lambda n: n["UARD"] >= n["walking to the goal"]),
        ),
    )
