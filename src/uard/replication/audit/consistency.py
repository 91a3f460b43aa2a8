"""Section h: counts, percentages and settings that contradict each other."""

from __future__ import annotations

import math

from scipy import stats
from scipy.optimize import brentq

from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.significance import LEVEL, t_test
from uard.replication.audit.solutions import SIZES, straight_return
from uard.replication.paper import Stat
from uard.replication.verdicts import Opinion, Part

NOISE = paper.FIGURES["G11"]
QUIET, NOISY = NOISE.stat("baseline at 0"), NOISE.stat("baseline at 30")
CARD_KW = 0.35  # board power of an RTX 3090


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [
        _percent(),
        _exceeds(),
        _variance(),
        _gradients(),
        _settings(),
        _nine(),
        _timing(),
        _reference(),
        _energy(),
    ]


def largest_equal(stat: Stat, count: int, n: int = paper.SEEDS) -> float:
    """Return the largest value that ``count`` of n numbers can all reach, given their mean and sample SD."""
    return stat.mean + stat.sd * math.sqrt((n - 1) * (n - count) / (n * count))


def _percent() -> Check:
    uard = NOISE.stat("UARD at 30")
    return Check(
        "h.percent",
        printed={
            "printed rise %": paper.PERCENT["noise-rise"].value,
            "printed lower %": paper.PERCENT["noise-lower"].value,
        },
        recomputed={
            "rise %": 100.0 * (NOISY.mean / QUIET.mean - 1.0),
            "lower %": 100.0 * (1.0 - uard.mean / NOISY.mean),
        },
        claims=(
            Part("the rise follows", lambda n: round(n["rise %"]) == n["printed rise %"]),
            Part(
                "how far UARD's violations are below follows", lambda n: round(n["lower %"], 1) == n["printed lower %"]
            ),
        ),
        findings=(Opinion("baselines that learn from the observed reward (L1088) do not read the ratings", True),),
    )


def _exceeds() -> Check:
    limit = paper.TEXT["seed exceeds"].value
    rounded_up = Stat(NOISY.mean + 0.05, NOISY.sd + 0.05)
    can = [k for k in range(1, paper.SEEDS) if largest_equal(rounded_up, k) > limit]
    several = "seeds that can, rounding in their favour"
    return Check(
        "h.exceeds",
        printed={"exceeds": limit},
        recomputed={f"largest value that {k} can all reach": largest_equal(NOISY, k) for k in (1, 2)}
        | {several: float(max(can, default=0))},
        others={"mean": NOISY.mean, "SD": NOISY.sd, "n": paper.SEEDS},
        claims=(Part("two seeds or more can", lambda n: n[several] >= 2),),
    )


def _variance() -> Check:
    ratio = (NOISY.sd / QUIET.sd) ** 2
    return Check(
        "h.variance",
        printed={"SD at 0 %": QUIET.sd, "SD at 30 %": NOISY.sd},
        recomputed={
            "variance ratio": ratio,
            "p": float(stats.f.sf(ratio, paper.SEEDS - 1, paper.SEEDS - 1)),
            "SD / mean at 0 %": QUIET.sd / QUIET.mean,
            "SD / mean at 30 %": NOISY.sd / NOISY.mean,
            "p of UARD against baseline at 0 % noise": t_test(QUIET, NOISE.stat("UARD at 0"), welch=True)[1],
        },
        others={"level": LEVEL},
        claims=(
            Part("the standard deviation is larger with noise", lambda n: n["SD at 30 %"] > n["SD at 0 %"]),
            Part("it is larger by more than chance", lambda n: n["p"] < n["level"]),
        ),
        findings=(
            Part("relative to the mean it is smaller", lambda n: n["SD / mean at 30 %"] < n["SD / mean at 0 %"]),
        ),
    )


def _gradients() -> Check:
    crossing = float(brentq(lambda x: x - 2.0 * math.log1p(x), 1.0, 10.0))  # type: ignore[arg-type]
    at_trap = paper.LAMBDA * paper.BETA * paper.SIGMA_H_AT_TRAP
    return Check(
        "h.gradients",
        printed={"lambda U at the trap": at_trap},
        recomputed={
            "lambda U": crossing,
            "exponential slope at 1.247": math.exp(-at_trap),
            "reciprocal slope at 1.247": (1.0 + at_trap) ** -2,
        },
        others={"exponential slope": math.exp(-2 * crossing), "reciprocal slope": (1.0 + 2 * crossing) ** -2},
        claims=(
            Part(
                "it has the larger slope at twice the crossing",
                lambda n: n["reciprocal slope"] > n["exponential slope"],
            ),
            Part(
                "it has the larger slope at the trap",
                lambda n: n["reciprocal slope at 1.247"] > n["exponential slope at 1.247"],
            ),
        ),
        findings=(Part("the trap lies below the crossing", lambda n: n["lambda U at the trap"] < n["lambda U"]),),
    )


def _settings() -> Check:
    _, factor, floor = paper.EPSILON
    outside = [n for n in SIZES if max(paper.GOAL_IN_APPENDIX) >= n]
    per_side = {n: paper.HORIZON[n] / n for n in SIZES}
    reached = "episode that reaches the floor"
    return Check(
        "h.settings",
        printed={"goal": str(paper.GOAL_IN_APPENDIX), "epsilon floor": floor},
        recomputed={f"steps per side, {n}": x for n, x in per_side.items()}
        | {
            "sizes that (9, 9) is outside of": ", ".join(map(str, outside)),
            "epsilon in episode 500": factor ** (paper.EPISODES - 1),
            reached: float(1 + math.ceil(math.log(floor) / math.log(factor))),
        },
        others={"episodes": paper.EPISODES, "grids without goal": len(outside)}
        | {"fewest per side": min(per_side.values()), "most per side": max(per_side.values())},
        claims=(
            Part("horizons are proportional to sides", lambda n: n["fewest per side"] == n["most per side"]),
            Part("the goal lies in every grid", lambda n: n["grids without goal"] == 0),
            Part("epsilon reaches its floor", lambda n: n[reached] <= n["episodes"]),
        ),
    )


def _nine() -> Check:
    tabled = [name for name, where in paper.BASELINES.items() if "F3" in where]
    nowhere = [name for name, where in paper.BASELINES.items() if not where]
    return Check(
        "h.nine",
        printed={"baselines": float(len(paper.BASELINES))},
        recomputed={"with numbers in a table": float(len(tabled)), "without any result": ", ".join(nowhere)},
        others={"in figures only": len(paper.BASELINES) - len(tabled) - len(nowhere), "in none": len(nowhere)},
        claims=(
            Part("all have numbers in a table", lambda n: n["with numbers in a table"] == n["baselines"]),
            Part("all are at least named in a figure", lambda n: n["in none"] == 0),
        ),
    )


def _timing() -> Check:
    return Check(
        "h.timing",
        printed={
            "transition to the goal (L1143), episode": paper.TEXT["transition episode"].value,
            "true return stable (L1947), from episode": paper.TEXT["avoidance episode"].value,
            "at": paper.FIGURES["G8"].number("UARD"),
        },
        recomputed={"return of the way to the goal": straight_return(6)},
        others={"return of never arriving": round(paper.STEP_REWARD * paper.HORIZON[6], 6)},
        claims=(
            Part(
                "it settles at the return of the way to the goal",
                lambda n: n["at"] >= n["return of the way to the goal"],
            ),
            Part(
                "it settles after the turn to the goal",
                lambda n: n["true return stable (L1947), from episode"] >= n["transition to the goal (L1143), episode"],
            ),
        ),
        findings=(Part("it settles at that of never arriving", lambda n: n["at"] == n["return of never arriving"]),),
    )


def _reference() -> Check:
    robots = ("Walker2d", "Hopper")
    return Check(
        "h.reference",
        printed={f"{robot} objective": paper.TEXT[f"{robot} objective"].value for robot in robots},
        recomputed={robot: paper.TEXT[f"{robot} reference"].value for robot in robots},
        claims=tuple(Part(f"its mean on {r} does", lambda n, r=r: n[r] >= n[f"{r} objective"]) for r in robots),
    )


def _energy() -> Check:
    hours = paper.TEXT["GPU hours"].value
    low, high = (paper.TEXT[f"kWh {which}"].value for which in ("low", "high"))
    full = "kWh at the card's 350 W"
    return Check(
        "h.energy",
        printed={"kWh low": low, "kWh high": high},
        recomputed={"kW low": low / hours, "kW high": high / hours, full: hours * CARD_KW},
        others={"hours": hours, "W low": 1000 * low / hours, "W high": 1000 * high / hours},
        findings=(Part("the card at full power needs more", lambda n: n[full] > n["kWh high"]),),
    )
