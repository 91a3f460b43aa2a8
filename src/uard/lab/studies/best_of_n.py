"""Best-of-n against a gold reward: does scoring by K reward models survive choosing the best of very many?

The setting of Gao et al. (2023) and Coste et al. (2024), small and synthetic, in NumPy. An answer is a vector x of
normal features. Its gold reward grows along one direction and falls with distance from what is typical. K reward
models (logistic regression on random ReLU features of their own: Bradley-Terry) are fitted to noisy preferences between
typical answers, so they extrapolate, each in its own way, to the answers that best-of-n finds. Scores are standardised
on the pool, and ``uard`` is the library's own mitigation: the K scores are the ratings, their mean is the observed
reward.

Panels:

* ``independent``: every model has its own preferences;
* ``contested``: the same, but the people behind 2 of 5 models also like flattery, which is worth nothing;
* ``colluding``: all models are fitted to the same preferences, of people who all like flattery. No method that listens
  to them can help: a should-fail control.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from uard import _checks
from uard.lab.statistics import summarise
from uard.method.mitigations import Evidence, Mitigation, named
from uard.ratings.aggregate import aggregate

PANELS = ("independent", "contested", "colluding")
LARGEST = 10_000
SIZES = tuple(sorted({round(10 ** (e / 6)) for e in range(25)}))  # 1 to 10 000


@dataclass(frozen=True)
class Problem:
    """What is drawn for one seed.

    Examples:
        >>> Problem(models=3, pairs=100)  # a smaller panel that has been asked less
        Problem(features=8, pool=20000, models=3, pairs=100, width=64, ridge=1.0, curvature=0.2, flattery=1.5)

    Attributes:
        features: Dimension of an answer, >= 2; the last one is flattery.
        pool: Answers from which the best of n is chosen, >= 10 000.
        models: Number K of reward models, >= 2.
        pairs: Preferences per model, >= 2.
        width: Random ReLU features per model, >= 1.
        ridge: Penalty on the squared weights, > 0.
        curvature: How much gold falls with the squared distance from the typical.
        flattery: What those who like flattery add for it.
    """

    features: int = 8
    pool: int = 20_000
    models: int = 5
    pairs: int = 300
    width: int = 64
    ridge: float = 1.0
    curvature: float = 0.2
    flattery: float = 1.5

    def __post_init__(self) -> None:
        """Check the sizes.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.whole("features", self.features, low=2)
        _checks.whole("pool", self.pool, low=LARGEST)
        _checks.whole("models", self.models, low=2)
        _checks.whole("pairs", self.pairs, low=2)
        _checks.whole("width", self.width, low=1)
        _checks.number("ridge", self.ridge, low=0, open_low=True)
        _checks.number("curvature", self.curvature)
        _checks.number("flattery", self.flattery)


class Drawn(NamedTuple):
    """A pool of answers: their gold reward (N,) and the K models' scores (N, K), each of mean 0 and sd 1."""

    gold: np.ndarray
    scores: np.ndarray


def expected_best(value: np.ndarray, score: np.ndarray, n: int) -> float:
    """Return what the best of n by ``score`` is worth on average, over all subsets of n of a pool.

    The unbiased estimator of Gao et al. (2023), Nakano et al. (2021): with the pool sorted by score,
    sum_i C(i - 1, n - 1) / C(N, n) value_i. Ties are broken at random: each value counts as the mean of its ties.

    Examples:
        >>> round(expected_best(np.array([5.0, 2.0, 8.0]), np.array([1.0, 2.0, 3.0]), n=2), 6)  # (2 + 8 + 8) / 3
        6.0

    Args:
        value: What each of the pool is worth, (N,).
        score: By what the best is chosen, (N,).
        n: Size of the subsets, in 1..N.

    Raises:
        InvalidValueError: for values that are not finite, arrays of two shapes, or n outside 1..N.
    """
    _checks.finite("value", value)
    _checks.finite("score", score)
    _checks.same_shape("value", value, "score", score)
    _checks.whole("n", n, low=1, high=score.size)
    return float(_chances(score.size, n) @ _in_order(value, score))


def _in_order(value: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Return values by rising score, each as the mean of its ties."""
    _, tie = np.unique(score, return_inverse=True)
    return (np.bincount(tie, value) / np.bincount(tie))[np.sort(tie)]


@cache
def _chances(pool: int, n: int) -> np.ndarray:
    """Return each rank's chance to be the best of n, from the lowest: C(i - 1, n - 1) / C(N, n)."""
    # From the highest down: n / N, and each next (i - n) / (i - 1) times the last for rank i = N, N - 1, ...
    rank = np.arange(pool, 1, -1.0)
    falling = np.concatenate([[n / pool], n / pool * np.cumprod(np.maximum(rank - n, 0.0) / (rank - 1.0))])
    return falling[::-1]


def divergence(n: int) -> float:
    """KL of best-of-n from the policy that it samples, in nats: log n - (n - 1) / n, for n >= 1.

    Examples:
        >>> round(divergence(100), 3)
        3.615
    """
    return math.log(n) - (n - 1) / n


def draw(problem: Problem, panel: str, seed: int) -> Drawn:
    """Draw a gold reward, a pool of answers and preferences, and fit the reward models.

    Examples:
        >>> drawn = draw(Problem(pool=10_000, models=3, width=8), "independent", seed=0)
        >>> drawn.gold.shape, drawn.scores.shape
        ((10000,), (10000, 3))

    Args:
        problem: The sizes.
        panel: One of ``PANELS``.
        seed: Everything random comes from it; >= 0.

    Raises:
        UnknownNameError: for another panel, with the nearest name.
    """
    _checks.choose("panel", panel, PANELS)
    random = np.random.default_rng([seed, PANELS.index(panel)])
    direction = random.normal(size=problem.features)
    direction[-1] = 0.0
    direction /= np.linalg.norm(direction)

    def gold(x: np.ndarray) -> np.ndarray:
        return x @ direction - problem.curvature * (x * x).sum(-1)

    def flattered(x: np.ndarray) -> np.ndarray:
        return gold(x) + problem.flattery * x[:, -1]

    pool = random.normal(size=(problem.pool, problem.features))
    likes = {"independent": 0, "contested": 2 * problem.models // 5, "colluding": problem.models}[panel]
    shared = _preferences(problem, flattered, random)
    scores = np.empty((problem.pool, problem.models))
    for k in range(problem.models):
        preferred = shared if panel == "colluding" else _preferences(problem, flattered if k < likes else gold, random)
        scores[:, k] = _fitted(problem, preferred, random)(pool)
    worth = gold(pool)
    return Drawn((worth - worth.mean()) / worth.std(), (scores - scores.mean(0)) / scores.std(0))


Reward = Callable[[np.ndarray], np.ndarray]
Preferences = tuple[np.ndarray, np.ndarray]


def _preferences(problem: Problem, reward: Reward, random: np.random.Generator) -> Preferences:
    """Return pairs of which the first was preferred, with the chance of Bradley and Terry."""
    a, b = random.normal(size=(2, problem.pairs, problem.features))
    first = random.random(problem.pairs) < 1.0 / (1.0 + np.exp(reward(b) - reward(a)))
    return np.where(first[:, None], a, b), np.where(first[:, None], b, a)


def _fitted(problem: Problem, preferences: Preferences, random: np.random.Generator) -> Reward:
    """Fit a reward model: logistic regression on differences of random ReLU features, by Newton's method."""
    weights = random.normal(size=(problem.features, problem.width)) / math.sqrt(problem.features)
    bias = random.normal(size=problem.width)

    def represented(x: np.ndarray) -> np.ndarray:
        return np.maximum(x @ weights + bias, 0.0)

    better, worse = preferences
    difference = represented(better) - represented(worse)
    theta = np.zeros(problem.width)
    for _ in range(20):
        wrong = 1.0 / (1.0 + np.exp(difference @ theta))  # chance of the other preference
        gradient = difference.T @ wrong - problem.ridge * theta
        curvature = (difference.T * (wrong * (1.0 - wrong))) @ difference + problem.ridge * np.eye(problem.width)
        theta = theta + np.linalg.solve(curvature, gradient)
    return lambda x: represented(x) @ theta


def _one(scores: np.ndarray) -> np.ndarray:
    return scores[:, 0]


def _mean(scores: np.ndarray) -> np.ndarray:
    return scores.mean(1)


def _worst(scores: np.ndarray) -> np.ndarray:
    return scores.min(1)


def _penalised(scores: np.ndarray) -> np.ndarray:
    return scores.mean(1) - 0.5 * scores.var(1)


def filtered(scores: np.ndarray, mitigation: Mitigation, proxy: np.ndarray | None = None) -> np.ndarray:
    """Return the reward that a mitigation makes of K scores per answer, (N,).

    The scores are the ratings and their mean is the observed reward, if no other proxy is given. Every answer is
    rated once by all models, so a mitigation that has a pseudo-count should have it at 0.

    Examples:
        >>> filtered(np.array([[1.0, 1.0], [0.0, 4.0]]), named("worst-of-annotations")).tolist()
        [1.0, 0.0]

    Args:
        scores: (N, K), finite.
        mitigation: Ours, or your own.
        proxy: (N,), what is believed or doubted.
    """
    reward = scores.mean(1) if proxy is None else proxy
    feedback = aggregate(scores, reward)
    statistics = mitigation.fit(feedback, np.ones(len(scores), bool))
    return np.asarray(mitigation.signal(Evidence(reward, np.zeros(len(scores)), feedback), statistics).reward)


def _uard(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("uard"))


def _uard_of_median(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("uard"), np.median(scores, axis=1))


def _median(scores: np.ndarray) -> np.ndarray:
    return np.median(scores, axis=1)


def _log_mean_exp(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("log-mean-exp"))


def _lcb(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("lcb"))


def _excess(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("excess"))


def _uard_0_1(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("uard-0.1", prior_count=0.0))


def _printed(scores: np.ndarray) -> np.ndarray:
    return filtered(scores, named("uard-operator"))


METHODS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "one model": _one,
    "mean": _mean,
    "median": _median,
    "worst case (WCO)": _worst,
    "mean - variance / 2 (UWO)": _penalised,
    "log-mean-exp": _log_mean_exp,
    "lcb": _lcb,
    "excess": _excess,
    "uard-operator": _printed,
    "uard-0.1": _uard_0_1,
    "uard, median as proxy": _uard_of_median,
    "uard": _uard,
}


@dataclass(frozen=True)
class Result:
    """Curves of every method.

    Examples:
        >>> curves = {("independent", "uard"): np.array([[0.0, 1.0], [0.0, 3.0]])}  # two seeds, n = 1 and n = 10
        >>> result = Result(Problem(), seeds=(0, 1), sizes=(1, 10), gold=curves, proxy=curves)
        >>> result.as_data()["curves"][0]["gold"]["mean"]
        [0.0, 2.0]

    Attributes:
        problem: The sizes.
        seeds: The seeds.
        sizes: Each n.
        gold: (panel, method) to what the best of n is worth in gold, (seeds, sizes), in deviations of the pool.
        proxy: The same in the score by which it was chosen.
    """

    problem: Problem
    seeds: tuple[int, ...]
    sizes: tuple[int, ...]
    gold: dict[tuple[str, str], np.ndarray]
    proxy: dict[tuple[str, str], np.ndarray]

    def as_data(self) -> dict[str, Any]:
        """Return summaries over seeds as plain data that JSON can hold.

        Per curve: ``gold`` and ``proxy``, and ``over_uard``, by how much gold is above that of ``uard``, seed by seed.
        """
        curves = [
            {
                "panel": panel,
                "method": method,
                "gold": _summaries(gold),
                "proxy": _summaries(self.proxy[panel, method]),
                "over_uard": _summaries(gold - self.gold[panel, "uard"]),
            }
            for (panel, method), gold in self.gold.items()
        ]
        sizes = {"n": list(self.sizes), "kl": [round(divergence(n), 4) for n in self.sizes]}
        return {"problem": asdict(self.problem), "seeds": list(self.seeds), **sizes, "curves": curves}


def _summaries(values: np.ndarray) -> dict[str, list[Any]]:
    columns = [summarise(column) for column in values.T]
    return {
        "mean": [round(c.mean, 4) for c in columns],
        "sd": [round(c.sd, 4) for c in columns],
        "ci95": [c.ci95 and [round(x, 4) for x in c.ci95] for c in columns],
    }


def run(seeds: Sequence[int], problem: Problem | None = None, panels: Sequence[str] = PANELS) -> Result:
    """Draw every seed of every panel and follow every method from n = 1 to 10 000.

    Examples:
        >>> small = Problem(pool=10_000, models=3, pairs=60, width=8)
        >>> result = run([0], small, panels=["independent"])
        >>> result.sizes[-1], result.gold["independent", "uard"].shape
        (10000, (1, 24))

    Args:
        seeds: Seeds >= 0, at least one; all methods see the same draws.
        problem: The sizes; the default ones if left out.
        panels: Some of ``PANELS``.

    Raises:
        InvalidValueError: there is no seed.
        UnknownNameError: for another panel, with the nearest name.
    """
    problem = problem or Problem()
    _checks.whole("number of seeds", len(seeds), low=1)
    shape = (len(seeds), len(SIZES))
    gold = {(panel, method): np.empty(shape) for panel in panels for method in METHODS}
    proxy = {key: np.empty(shape) for key in gold}
    chances = np.stack([_chances(problem.pool, n) for n in SIZES])
    for panel in panels:
        for i, seed in enumerate(seeds):
            drawn = draw(problem, panel, seed)
            for method, score in METHODS.items():
                scored = score(drawn.scores)
                gold[panel, method][i] = chances @ _in_order(drawn.gold, scored)
                proxy[panel, method][i] = chances @ np.sort(scored)
    return Result(problem, tuple(seeds), SIZES, gold, proxy)
