"""The Reliability Filter as a function of its uncertainties: propositions, derivation and rival forms (J1-J4, J10-J14, A30)."""

from __future__ import annotations

from typing import Any

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.views.study_results import StudyResults
from uard.method.weights import (
    ReliabilityFilter,
    certainty_equivalent_weight,
    exponential_weight,
    linear_weight,
    reciprocal_weight,
    wiener_weight,
)
from uard.replication import paper
from uard.replication.ledger.claim import Conditions, below_in
from uard.replication.verdicts import Opinion, Part, each


def _draws(n: int = 100_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random mu in [0, 20) and two sigmas in [0, 5)."""
    rng = np.random.default_rng(0)
    return rng.uniform(0, 20, n), rng.uniform(0, 5, n), rng.uniform(0, 5, n)


def _share(true: np.ndarray) -> float:
    return float(np.mean(true))


def _sign(results: StudyResults) -> dict[str, Any]:
    return {"violations": int((ReliabilityFilter().score(*_draws()) < 0).sum())}


J1 = Conditions((Part("J >= 0 in every draw with mu >= 0", lambda n: n["violations"] == 0),), _sign)

_RAISED = {  # which sigma is raised, and the filter: at the paper's parameters, and where the proposition also holds
    "sigma_m, all parameters positive": ("m", ReliabilityFilter()),
    "sigma_h, all parameters positive": ("h", ReliabilityFilter()),
    "sigma_m, alpha = 0": ("m", ReliabilityFilter(alpha=0.0)),
    "sigma_h, beta = 0": ("h", ReliabilityFilter(beta=0.0)),
    "sigma_m, lambda = 0": ("m", ReliabilityFilter(lam=0.0)),
    "sigma_h, lambda = 0": ("h", ReliabilityFilter(lam=0.0)),
}


def _falling(results: StudyResults) -> dict[str, Any]:
    mu, m, h = _draws()

    def falls(which: str, reliability: ReliabilityFilter) -> float:
        raised = (m + 0.1, h) if which == "m" else (m, h + 0.1)
        return _share(reliability.score(mu + 0.01, *raised) < reliability.score(mu + 0.01, m, h))

    return {"falls": {name: falls(*what) for name, what in _RAISED.items()}}


J2 = Conditions(
    each("J falls strictly with {}", _RAISED, lambda n, setting: n["falls"][setting] == 1),
    _falling,
)


def _penalised(results: StudyResults) -> dict[str, Any]:
    mu, m, h = _draws()
    mu, f = mu + 0.01, ReliabilityFilter()
    return {
        "positive": _share(f.score(mu, m, h) > 0),
        "falls_above": _share(f.score(mu, m + 0.1, h) < f.score(mu, m, h)),
        "falls_below": _share(f.score(-mu, m + 0.1, h) < f.score(-mu, m, h)),
        "sure": float(f.score(-1.0, 0.1, 0.1)),
        "unsure": float(f.score(-1.5, 1.5, 1.5)),
    }


J3 = Conditions(
    (
        Part("the sign of a positive value is never inverted", lambda n: n["positive"] == 1),
        Part("mu > 0: J falls with uncertainty in every draw", lambda n: n["falls_above"] == 1),
        Part("mu < 0: J falls with uncertainty in every draw", lambda n: n["falls_below"] == 1),
    ),
    _penalised,
)

READINGS = {"as printed": "uard-paper", "consistent backup": "uard-consistent"}


def _jumps() -> dict[str, float]:
    """Return by how much the slope of each weight changes at most from one point to the next, mu = 1, steps of .001."""
    u = np.linspace(0.0, 2.0, 2001)
    weights = {
        "reciprocal": reciprocal_weight(u, paper.LAMBDA),
        "exponential": exponential_weight(u, paper.LAMBDA),
        "linear": linear_weight(u, np.ones_like(u), paper.LAMBDA),
    }
    return {form: float(np.abs(np.diff(np.diff(w) / np.diff(u))).max()) for form, w in weights.items()}


def _early(results: StudyResults, form: str) -> dict[str, Summary]:
    """Return the goal rate in the first 100 episodes, by reading."""
    return {
        name: results.window("filters", "success", 1, 100, form=form, reading=reading)
        for name, reading in READINGS.items()
    }


def _late(results: StudyResults, metric: str, form: str) -> dict[str, Summary]:
    """Return a metric of the last episodes, by reading."""
    return {name: results.get("filters", metric, form=form, reading=reading) for name, reading in READINGS.items()}


def _smooth(results: StudyResults) -> dict[str, Any]:
    jumps = _jumps()
    return {
        "jump": jumps["reciprocal"],
        "jump_linear": jumps["linear"],
        "early": _early(results, "reciprocal"),
        "early_linear": _early(results, "linear"),
    }


J4 = Conditions(
    (
        Part(
            "smooth: its slope jumps by less than a hundredth of the linear form's",
            lambda n: 100 * n["jump"] < n["jump_linear"],
        ),
        *each(
            "{}: in the first 100 episodes the goal is reached more often than with the linear form (beyond noise)",
            READINGS,
            lambda n, reading: below_in(n["early_linear"], n["early"], reading),
        ),
    ),
    _smooth,
)


def _rivals(results: StudyResults) -> dict[str, Any]:
    jumps = _jumps()
    return {
        "jump": jumps["reciprocal"],
        "jump_linear": jumps["linear"],
        "visits": _late(results, "hacks", "reciprocal"),
        "visits_linear": _late(results, "hacks", "linear"),
        "goal": _late(results, "success_rate", "reciprocal"),
        "goal_exponential": _late(results, "success_rate", "exponential"),
    }


J14 = Conditions(
    (
        Part(
            "linear subtraction is abrupt: its slope jumps by more than a hundred times the reciprocal form's",
            lambda n: n["jump_linear"] > 100 * n["jump"],
        ),
        *each(
            "{}: linear subtraction collapses: more visits than with the reciprocal form (beyond noise)",
            READINGS,
            lambda n, reading: below_in(n["visits"], n["visits_linear"], reading),
        ),
        *each(
            "{}: exponential decay suppresses too much: fewer goals than with the reciprocal form (beyond noise)",
            READINGS,
            lambda n, reading: below_in(n["goal_exponential"], n["goal"], reading),
        ),
    ),
    _rivals,
)


def _properties(results: StudyResults) -> dict[str, Any]:
    _, u, v = _draws()
    w, x = (np.asarray(reciprocal_weight(z, paper.LAMBDA)) for z in (u, v))
    apart = u != v
    return {
        "lowest": float(w.min()),
        "highest": float(w.max()),
        "at_zero": float(reciprocal_weight(0.0, paper.LAMBDA)),
        "falls": _share(((u < v) == (w > x))[apart]),
        "steepest": float((np.abs(w - x)[apart] / np.abs(u - v)[apart]).max()),
        "lam": paper.LAMBDA,
    }


J10 = Conditions(
    (
        Part("positive", lambda n: n["lowest"] > 0),
        Part("decreasing", lambda n: n["falls"] == 1),
        Part("at most 1", lambda n: n["highest"] <= 1),
        Part("1 at U = 0", lambda n: n["at_zero"] == 1),
        Part("Lipschitz in U with constant lambda", lambda n: n["steepest"] <= n["lam"]),
    ),
    _properties,
)


def _derivation(results: StudyResults) -> dict[str, Any]:
    kappa, u, mu = paper.LAMBDA, 1.0, 2.0
    z = kappa * u * u / (2 * mu)
    return {
        "certainty": (mu - kappa / 2 * u * u) / mu,
        "linear": 1 - z,
        "replaced": float(reciprocal_weight(z, 1.0)),
        "used": float(reciprocal_weight(u, paper.LAMBDA)),
    }


J11 = Conditions(
    (
        Part(
            "the certainty equivalent, divided by mu, is 1 - z",
            lambda n: abs(n["certainty"] - n["linear"]) < 1e-9,
        ),
        Part("1/(1 + z), put in its place, is equal to it", lambda n: abs(n["replaced"] - n["linear"]) < 1e-9),
        Part(
            "1/(1 + lambda U), used in practice, is equal to 1/(1 + z)", lambda n: abs(n["used"] - n["replaced"]) < 1e-9
        ),
    ),
    _derivation,
)


def _wiener(results: StudyResults) -> dict[str, Any]:
    _, u, _ = _draws(1000)
    gain = wiener_weight(np.ones_like(u), paper.LAMBDA * u)
    return {"difference": float(np.abs(gain - reciprocal_weight(u, paper.LAMBDA)).max())}


J12 = Conditions(
    (
        Part("the filter is a Wiener gain of noise-to-signal ratio lambda U", lambda n: n["difference"] < 1e-9),
        Opinion("the text derives that the ratio of the two powers is lambda U, a deviation", False),
        Opinion("the text derives the filter from the Information Bottleneck", False),
    ),
    _wiener,
)

FAR = 5.0  # lambda U of what is certainly high uncertainty: w = 1/6


def _slopes(x: float) -> tuple[float, float]:
    return float(np.exp(-x)), 1 / (1 + x) ** 2


def _gradients(results: StudyResults) -> dict[str, Any]:
    from scipy.optimize import brentq

    trap = paper.LAMBDA * paper.BETA * paper.SIGMA_H_AT_TRAP
    crossing: Any = brentq(lambda x: _slopes(x)[0] - _slopes(x)[1], 1.0, 5.0)
    names = ("exponential", "reciprocal")
    return {
        "trap": trap,
        "far": FAR,
        "at_trap": dict(zip(names, _slopes(trap), strict=True)),
        "at_far": dict(zip(names, _slopes(FAR), strict=True)),
        "crossing": float(crossing),
    }


J13 = Conditions(
    (
        Part(
            "at the paper's own trap its slope is larger than the exponential form's",
            lambda n: n["at_trap"]["reciprocal"] > n["at_trap"]["exponential"],
        ),
        Part(
            "at far higher uncertainty its slope is larger than the exponential form's",
            lambda n: n["at_far"]["reciprocal"] > n["at_far"]["exponential"],
        ),
    ),
    _gradients,
)

_REWARDS = {"trap": 4.0, "goal": 10.0}


def _spread(results: StudyResults, form: str) -> dict[str, Summary]:
    """Return the SD of the true return over the last episodes, by reading."""

    def curves(reading: str) -> np.ndarray:
        return results.curves("filters", "true_return", form=form, reading=reading)[:, -paper.LAST_EPISODES :]

    return {name: statistics.summarise(curves(reading).std(1, ddof=1)) for name, reading in READINGS.items()}


def _squared(results: StudyResults) -> dict[str, Any]:
    squared = "certainty-equivalent"
    return {
        "weight": {name: float(reciprocal_weight(r, paper.LAMBDA)) for name, r in _REWARDS.items()},
        "weight_squared": {name: float(certainty_equivalent_weight(r, r)) for name, r in _REWARDS.items()},
        "crossing": {name: 2 * r for name, r in _REWARDS.items()},  # 2 lambda mu / kappa
        "trap": paper.BETA * paper.SIGMA_H_AT_TRAP,
        "early": _early(results, "reciprocal"),
        "early_squared": _early(results, squared),
        "visits": _late(results, "hacks", "reciprocal"),
        "visits_squared": _late(results, "hacks", squared),
        "spread": _spread(results, "reciprocal"),
        "spread_squared": _spread(results, squared),
    }


A30 = Conditions(
    (
        *each(
            "{}: where U is as large as the reward itself, the squared form leaves less of it",
            _REWARDS,
            lambda n, reward: n["weight_squared"][reward] < n["weight"][reward],
        ),
        *each(
            "{}: squared uncertainty suppresses exploration: in the first 100 episodes it reaches the goal less often "
            "(paired, Holm)",
            READINGS,
            lambda n, reading: below_in(n["early_squared"], n["early"], reading),
        ),
        *each(
            "{}: squared uncertainty is unstable: a larger SD of the true return over the last hundred episodes "
            "(paired, Holm)",
            READINGS,
            lambda n, reading: below_in(n["spread"], n["spread_squared"], reading),
        ),
        *each(
            "{}: the linear form discounts what it should: fewer visits of the trap (paired, Holm)",
            READINGS,
            lambda n, reading: below_in(n["visits"], n["visits_squared"], reading),
        ),
        Opinion("the paper shows a comparison of both, discrete or continuous", False),
    ),
    _squared,
)

CONDITIONS = {
    "J1": J1,
    "J2": J2,
    "J3": J3,
    "J4": J4,
    "J10": J10,
    "J11": J11,
    "J12": J12,
    "J13": J13,
    "J14": J14,
    "A30": A30,
}
