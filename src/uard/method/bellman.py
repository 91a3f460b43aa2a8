"""T_lambda, the paper's Bellman operator on tables (A21-A23): fixed points, contraction, what its greedy policy does.

(T_lambda Q)(s, a) = b + w(s, a) (r(s, a) - b) + gamma max_a' Q(s', a'), without the last term where (s, a) ends the
episode. With w = 1 it is the standard operator (A22); with the anchor b = 0 it is the paper's. Everything is a pure
NumPy function of (S, A) tables of a deterministic task. Rewards, values, anchors and sigmas share the reward's unit;
weights are dimensionless; gamma lies in [0, 1).

The examples are of one task: from state 0 action 0 leads to state 1 for nothing, action 1 ends the episode for a reward
of 1; from state 1 both actions end it for 2.

    >>> next_state = np.array([[1, 0], [1, 1]])
    >>> reward = np.array([[0.0, 1.0], [2.0, 2.0]])
    >>> terminal = np.array([[False, True], [True, True]])
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from uard import _checks
from uard.method.weights import Form, ReliabilityFilter, discount

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Integer, Real

_TIE = 1e-9  # values closer than this count as equal, and then the first action is taken


class TabularTask(Protocol):
    """What is needed of a task: (S, A) tables, a start and a horizon (``uard.envs.tables.Task`` has them)."""

    @property
    def next_state(self) -> Any:
        """States that are entered, (S, A) integers in 0..S-1."""
        ...

    @property
    def reward(self) -> Any:
        """Observed reward, (S, A)."""
        ...

    @property
    def terminal(self) -> Any:
        """Whether the step ends the episode, (S, A) booleans."""
        ...

    @property
    def start(self) -> Any:
        """Starting state, an integer."""
        ...

    @property
    def horizon(self) -> Any:
        """Steps after which an episode is cut off, an integer."""
        ...


class FixedPoint(NamedTuple):
    """A fixed point by value iteration.

    Attributes:
        q: Values.
        residuals: Largest change of a value in each sweep; one entry per sweep.
    """

    q: Float[np.ndarray, "S A"]
    residuals: Float[np.ndarray, " sweeps"]


class GreedyPath(NamedTuple):
    """What the greedy policy does from the start.

    Attributes:
        states: States visited, the start first.
        actions: Actions taken, one fewer than states.
        visits: Times each contested state was entered, by state; 0 for those never entered.
        reached_goal: Whether the episode ended by a terminal step (and not by the horizon).
    """

    states: tuple[int, ...]
    actions: tuple[int, ...]
    visits: dict[int, int]
    reached_goal: bool

    @property
    def total_visits(self) -> int:
        """Entries of all contested states together."""
        return sum(self.visits.values())


class Expansion(NamedTuple):
    """A pair of ensembles that the ensemble map drives apart.

    Attributes:
        ratio: ||F(Q1) - F(Q2)|| / ||Q1 - Q2|| (largest absolute entry), measured by applying the map.
        supremum: Its limit for a vanishing gap: lambda alpha |r - b| s + gamma, with s the largest standard
            deviation of N numbers in [-1, 1] (and no gamma where the step is terminal).
        place: The (state, action) at which the heads are made to disagree.
        first: Ensemble of N heads that all agree.
        second: Ensemble at distance ``gap`` from it.
    """

    ratio: float
    supremum: float
    place: tuple[int, int]
    first: Float[np.ndarray, "S A N"]
    second: Float[np.ndarray, "S A N"]


def _tables(
    next_state: Any, reward: Any, terminal: Any, gamma: float, weight: Any = 1.0, anchor: Any = 0.0
) -> tuple[Integer[np.ndarray, "S A"], Float[np.ndarray, "S A"], Float[np.ndarray, "S A"]]:
    """Check the tables; return (next_state, b + w (r - b), gamma where the episode goes on and 0 elsewhere)."""
    _checks.number("gamma", gamma, low=0, high=1)
    if gamma == 1:
        raise _checks.InvalidValueError("gamma", gamma, "less than 1, or there is no contraction")
    _checks.finite("reward", reward)
    r = _checks.as_numpy("reward", reward)
    if r.ndim != 2 or 0 in r.shape:
        raise _checks.InvalidValueError("reward.shape", r.shape, "(S, A) with at least one state and one action")
    entered, ends = np.asarray(next_state), np.asarray(terminal)
    _checks.same_shape("next_state", entered, "reward", r)
    _checks.same_shape("terminal", ends, "reward", r)
    if not np.issubdtype(entered.dtype, np.integer):
        raise _checks.InvalidValueError("next_state.dtype", entered.dtype.name, "an integer type")
    wrong = (entered < 0) | (entered >= r.shape[0])
    if wrong.any():
        s, a = (int(i) for i in np.argwhere(wrong)[0])
        raise _checks.InvalidValueError(f"next_state[{s}, {a}]", int(entered[s, a]), f"a state in 0..{r.shape[0] - 1}")
    if ends.dtype != np.bool_:
        raise _checks.InvalidValueError("terminal.dtype", ends.dtype.name, "bool")
    _checks.nonnegative("weight", weight)
    _checks.finite("anchor", anchor)
    learned = discount(r, _like("weight", weight, r), _like("anchor", anchor, r))
    return entered, learned, np.where(ends, 0.0, gamma)


def _like(field: str, value: Any, table: Float[np.ndarray, "S A"]) -> Float[np.ndarray, "*any"]:
    """Return a number or an (S, A) table as a float array that broadcasts to ``table``."""
    array = _checks.as_numpy(field, value)
    if array.ndim != 0:
        _checks.same_shape(field, array, "reward", table)
    return array


def _apply(
    q: Float[np.ndarray, "*batch S A"],
    learned: Float[np.ndarray, "S A"],
    entered: Integer[np.ndarray, "S A"],
    onwards: Float[np.ndarray, "S A"],
) -> Float[np.ndarray, "*batch S A"]:
    return learned + onwards * q.max(axis=-1)[..., entered]


def backup(
    q: Float[np.ndarray, "*batch S A"],
    reward: Real[np.ndarray, "S A"],
    weight: float | Float[np.ndarray, "S A"],
    next_state: Integer[np.ndarray, "S A"],
    terminal: Bool[np.ndarray, "S A"],
    gamma: float,
    anchor: float | Float[np.ndarray, "S A"] = 0.0,
) -> Float[np.ndarray, "*batch S A"]:
    """Apply T_lambda once (A21); with ``weight`` 1 the standard operator (A22).

    Examples:
        >>> backup(np.zeros((2, 2)), reward, 0.5, next_state, terminal, gamma=0.9).tolist()
        [[0.0, 0.5], [1.0, 1.0]]

    Args:
        q: Values; leading axes are independent tables.
        reward: Observed reward.
        weight: The filter's weight, >= 0.
        next_state: States that are entered, in 0..S-1.
        terminal: Whether the step ends the episode.
        gamma: Discount in [0, 1).
        anchor: The pessimistic reward b; 0 is the paper's form.

    Returns:
        A new array of the shape of ``q``.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    entered, learned, onwards = _tables(next_state, reward, terminal, gamma, weight, anchor)
    _checks.finite("q", q)
    values = _checks.as_numpy("q", q)
    if values.shape[-2:] != learned.shape:
        raise _checks.InvalidValueError("q.shape", values.shape, f"(..., {learned.shape[0]}, {learned.shape[1]})")
    return _apply(values, learned, entered, onwards)


def fixed_point(
    reward: Real[np.ndarray, "S A"],
    weight: float | Float[np.ndarray, "S A"],
    next_state: Integer[np.ndarray, "S A"],
    terminal: Bool[np.ndarray, "S A"],
    gamma: float,
    anchor: float | Float[np.ndarray, "S A"] = 0.0,
    start: Float[np.ndarray, "S A"] | None = None,
    tolerance: float = 1e-10,
    max_sweeps: int = 100_000,
) -> FixedPoint:
    """Return Q^lambda (A23) by value iteration from ``start`` (zeros if left out).

    The residuals fall at least by the factor gamma per sweep, and the result is within
    ``tolerance`` / (1 - gamma) of the fixed point. For the values alone ``solve`` is faster and exact.

    Examples:
        >>> fixed_point(reward, 1.0, next_state, terminal, gamma=0.9).q.tolist()
        [[1.8, 1.0], [2.0, 2.0]]

    Args:
        reward: Observed reward.
        weight: The filter's weight, >= 0, held constant ("frozen").
        next_state: States that are entered, in 0..S-1.
        terminal: Whether the step ends the episode.
        gamma: Discount in [0, 1).
        anchor: The pessimistic reward b.
        start: Values to start from.
        tolerance: Stop when no value changes by more than this, > 0.
        max_sweeps: Give up after so many sweeps, >= 1.

    Raises:
        InvalidValueError: for bad arguments, or if ``max_sweeps`` were not enough.
    """
    entered, learned, onwards = _tables(next_state, reward, terminal, gamma, weight, anchor)
    _checks.number("tolerance", tolerance, low=0, open_low=True)
    _checks.whole("max_sweeps", max_sweeps, low=1)
    if start is None:
        q = np.zeros_like(learned)
    else:
        _checks.finite("start", start)
        q = _checks.as_numpy("start", start)
        _checks.same_shape("start", q, "reward", learned)
    residuals: list[float] = []
    for _ in range(max_sweeps):
        new = _apply(q, learned, entered, onwards)
        residuals.append(float(np.abs(new - q).max()))
        q = new
        if residuals[-1] <= tolerance:
            return FixedPoint(q, np.array(residuals))
    raise _checks.InvalidValueError("max_sweeps", max_sweeps, f"more: the residual is still {residuals[-1]:.2g}")


def solve(
    reward: Real[np.ndarray, "S A"],
    weight: float | Float[np.ndarray, "S A"],
    next_state: Integer[np.ndarray, "S A"],
    terminal: Bool[np.ndarray, "S A"],
    gamma: float,
    anchor: float | Float[np.ndarray, "S A"] = 0.0,
) -> Float[np.ndarray, "S A"]:
    """Return the same fixed point by policy iteration: exact to rounding, and much faster than sweeps.

    Examples:
        >>> solve(reward, 1.0, next_state, terminal, gamma=0.9).tolist()
        [[1.8, 1.0], [2.0, 2.0]]

    Args:
        reward: Observed reward.
        weight: The filter's weight, >= 0, held constant.
        next_state: States that are entered, in 0..S-1.
        terminal: Whether the step ends the episode.
        gamma: Discount in [0, 1).
        anchor: The pessimistic reward b.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    entered, learned, onwards = _tables(next_state, reward, terminal, gamma, weight, anchor)
    return _solve(entered, learned, onwards, np.zeros(len(learned), int))[0]


def _solve(
    entered: Integer[np.ndarray, "S A"],
    learned: Float[np.ndarray, "S A"],
    onwards: Float[np.ndarray, "S A"],
    policy: Integer[np.ndarray, " S"],
) -> tuple[Float[np.ndarray, "S A"], Integer[np.ndarray, " S"]]:
    """Policy iteration from a first guess; returns (values, policy)."""
    rows = np.arange(len(learned))
    slack = 1e-12 * max(1.0, float(np.abs(learned).max()))
    while True:
        q = learned + onwards * _evaluate(entered[rows, policy], learned[rows, policy], onwards[rows, policy])[entered]
        better = q.max(axis=1) > q[rows, policy] + slack
        if not better.any():
            return q, policy
        policy = np.where(better, q.argmax(axis=1), policy)


def _evaluate(
    entered: Integer[np.ndarray, " S"], learned: Float[np.ndarray, " S"], onwards: Float[np.ndarray, " S"]
) -> Float[np.ndarray, " S"]:
    """Return the values of one policy; each round doubles the number of steps that they look ahead."""
    value, factor, ahead = learned, onwards, entered
    gamma = float(onwards.max())
    for _ in range(int(np.ceil(np.log2(np.log(1e-18) / np.log(gamma)))) if gamma > 1e-18 else 0):
        value, factor, ahead = value + factor * value[ahead], factor * factor[ahead], ahead[ahead]
    return value


def contraction_ratio(
    reward: Real[np.ndarray, "S A"],
    weight: float | Float[np.ndarray, "S A"],
    next_state: Integer[np.ndarray, "S A"],
    terminal: Bool[np.ndarray, "S A"],
    gamma: float,
    anchor: float | Float[np.ndarray, "S A"] = 0.0,
    pairs: int = 1000,
    scale: float = 10.0,
    seed: int = 0,
) -> float:
    """Measure how far T_lambda with frozen weights contracts: the largest ||TQ1 - TQ2|| / ||Q1 - Q2|| of random pairs.

    Theorem 1 (J5) says that it is at most gamma. Half of the pairs are independent normal tables, the other half
    differ by one number added everywhere, for which the ratio is gamma itself unless every step is terminal.

    Examples:
        >>> round(contraction_ratio(reward, 0.5, next_state, terminal, gamma=0.9), 6)
        0.9

    Args:
        reward: Observed reward.
        weight: The filter's weight, >= 0, held constant.
        next_state: States that are entered, in 0..S-1.
        terminal: Whether the step ends the episode.
        gamma: Discount in [0, 1).
        anchor: The pessimistic reward b.
        pairs: Number of pairs, >= 1.
        scale: Standard deviation of the values, > 0.
        seed: Seed of the random tables.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    entered, learned, onwards = _tables(next_state, reward, terminal, gamma, weight, anchor)
    _checks.whole("pairs", pairs, low=1)
    _checks.number("scale", scale, low=0, open_low=True)
    rng = np.random.default_rng(seed)
    first = rng.normal(0.0, scale, (pairs, *learned.shape))
    second = rng.normal(0.0, scale, (pairs, *learned.shape))
    second[::2] = first[::2] + rng.normal(0.0, scale, (len(second[::2]), 1, 1))
    before = np.abs(first - second).max(axis=(1, 2))
    apart = np.abs(_apply(first, learned, entered, onwards) - _apply(second, learned, entered, onwards))
    return float((apart.max(axis=(1, 2)) / before).max())


def ensemble_backup(
    heads: Float[np.ndarray, "S A N"],
    reward: Real[np.ndarray, "S A"],
    next_state: Integer[np.ndarray, "S A"],
    terminal: Bool[np.ndarray, "S A"],
    gamma: float,
    sigma_h: float | Float[np.ndarray, "S A"] = 0.0,
    reliability: ReliabilityFilter | None = None,
    anchor: float | Float[np.ndarray, "S A"] = 0.0,
    ddof: int = 1,
) -> Float[np.ndarray, "S A N"]:
    """Apply T_lambda with *live* weights: every head is backed up with w(sigma_m(heads), sigma_h).

    Examples:
        >>> ensemble_backup(np.zeros((2, 2, 3)), reward, next_state, terminal, gamma=0.9)[1, 0].tolist()
        [2.0, 2.0, 2.0]

    Args:
        heads: Values of N heads.
        reward: Observed reward.
        next_state: States that are entered, in 0..S-1.
        terminal: Whether the step ends the episode.
        gamma: Discount in [0, 1).
        sigma_h: The annotators' disagreement, >= 0.
        reliability: The filter; the paper's if left out.
        anchor: The pessimistic reward b.
        ddof: 1 for 1/(N-1) as the paper prints (A17), 0 for 1/N.

    Returns:
        Values of N heads, a new array.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    _checks.finite("heads", heads)
    values = _checks.as_numpy("heads", heads)
    if values.ndim != 3:
        raise _checks.InvalidValueError("heads.shape", values.shape, "(S, A, N)")
    _checks.whole("ddof", ddof, low=0, high=values.shape[2] - 1)
    r = _checks.as_numpy("reward", reward)
    _checks.same_shape("heads[..., 0]", values[..., 0], "reward", r)
    chosen = ReliabilityFilter() if reliability is None else reliability
    sigma_m = values.std(axis=-1, ddof=ddof)
    weight = np.asarray(chosen.weight(sigma_m, _like("sigma_h", sigma_h, r), mu=r - _like("anchor", anchor, r)))
    entered, learned, onwards = _tables(next_state, r, terminal, gamma, weight, anchor)
    return np.moveaxis(_apply(np.moveaxis(values, -1, 0), learned, entered, onwards), 0, -1)


def live_weight_expansion(
    reward: Real[np.ndarray, "S A"],
    next_state: Integer[np.ndarray, "S A"],
    terminal: Bool[np.ndarray, "S A"],
    gamma: float,
    lam: float = 2.0,
    alpha: float = 0.5,
    heads: int = 5,
    gap: float = 1e-3,
    place: tuple[int, int] | None = None,
    anchor: float = 0.0,
    ddof: int = 1,
) -> Expansion:
    """Find two ensembles that T_lambda with live weights drives apart: Theorem 1 does not cover w(sigma_m(Q)).

    In the first ensemble all heads are 0. In the second they disagree by +-gap at one state-action, which lowers its
    weight, and all values of the state that follows move by gap in the same direction as the filtered reward. The
    reward's part of the step then grows as lambda alpha |r - b| sigma_m with sigma_m up to 1.095 gap (N = 5).

    Examples:
        >>> round(live_weight_expansion(reward, next_state, terminal, gamma=0.9, lam=2.0, alpha=0.5).supremum, 2)
        2.19

    Args:
        reward: Observed reward.
        next_state: States that are entered, in 0..S-1.
        terminal: Whether the step ends the episode.
        gamma: Discount in [0, 1).
        lam: lambda >= 0 of the reciprocal filter.
        alpha: Weight of sigma_m in [0, 1].
        heads: Number of heads N >= 2.
        gap: Distance of the two ensembles, > 0, in the reward's unit; the ratio falls as it grows.
        place: The (state, action) to disagree at; the worst one if left out.
        anchor: The pessimistic reward b.
        ddof: 1 for 1/(N-1), 0 for 1/N.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    _, learned, onwards = _tables(next_state, reward, terminal, gamma, 1.0, anchor)
    _checks.whole("heads", heads, low=2)
    _checks.whole("ddof", ddof, low=0, high=1)
    _checks.number("gap", gap, low=0, open_low=True)
    reliability = ReliabilityFilter(lam, alpha, 0.0)
    split = np.where(np.arange(heads) < (heads + 1) // 2, 1.0, -1.0)
    slope = lam * alpha * np.abs(learned - anchor) * split.std(ddof=ddof)
    if place is None:
        state, action = (int(i) for i in np.unravel_index(int((slope + onwards).argmax()), slope.shape))
    else:
        state, action = place
        _checks.whole("place[0]", state, high=len(learned) - 1)
        _checks.whole("place[1]", action, high=learned.shape[1] - 1)
    first = np.zeros((*learned.shape, heads))
    second = first.copy()
    towards = -np.sign(learned[state, action] - anchor) or 1.0
    second[int(np.asarray(next_state)[state, action])] = towards * gap
    second[state, action] = split * gap
    images = [
        ensemble_backup(x, reward, next_state, terminal, gamma, 0.0, reliability, anchor, ddof) for x in (first, second)
    ]
    ratio = float(np.abs(images[0] - images[1]).max() / gap)
    return Expansion(ratio, float((slope + onwards)[state, action]), (state, action), first, second)


def greedy_actions(q: Float[np.ndarray, "*batch A"]) -> Integer[np.ndarray, "*batch"]:
    """Return the best action of every state; of equally good ones (to 1e-9) the first.

    Examples:
        >>> greedy_actions(np.array([[1.8, 1.0], [2.0, 2.0]])).tolist()
        [0, 0]

    Args:
        q: Values or scores.
    """
    return np.argmax(q >= q.max(axis=-1, keepdims=True) - _TIE, axis=-1)


def greedy_path(
    q: Float[np.ndarray, "S A"],
    task: TabularTask,
    hack: Bool[np.ndarray, "S A"] | None = None,
    horizon: int | None = None,
) -> GreedyPath:
    """Follow the greedy policy from the start until a terminal step or the horizon.

    Examples:
        >>> from types import SimpleNamespace
        >>> task = SimpleNamespace(next_state=next_state, reward=reward, terminal=terminal, start=0, horizon=10)
        >>> greedy_path(np.array([[1.8, 1.0], [2.0, 2.0]]), task).states
        (0, 1, 1)

    Args:
        q: Values or scores.
        task: The task.
        hack: The contested steps to count; none if left out.
        horizon: Steps at most, >= 1; the task's if left out.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    _checks.finite("q", q)
    values = _checks.as_numpy("q", q)
    entered, ends = np.asarray(task.next_state), np.asarray(task.terminal)
    _checks.same_shape("q", values, "task.next_state", entered)
    steps = int(task.horizon) if horizon is None else horizon
    _checks.whole("horizon", steps, low=1)
    contested = np.zeros(entered.shape, bool) if hack is None else np.asarray(hack)
    _checks.same_shape("hack", contested, "task.next_state", entered)
    return _follow(greedy_actions(values), entered, ends, contested, int(task.start), steps)


def _follow(
    policy: Integer[np.ndarray, " S"],
    entered: Integer[np.ndarray, "S A"],
    ends: Bool[np.ndarray, "S A"],
    contested: Bool[np.ndarray, "S A"],
    start: int,
    steps: int,
) -> GreedyPath:
    states, done = [start], False
    actions: list[int] = []
    visits = dict.fromkeys(np.unique(entered[contested]).tolist(), 0)
    while len(actions) < steps and not done:
        s, a = states[-1], int(policy[states[-1]])
        actions.append(a)
        states.append(int(entered[s, a]))
        done = bool(ends[s, a])
        if contested[s, a]:
            visits[states[-1]] += 1
    return GreedyPath(tuple(states), tuple(actions), visits, done)


def critical_lambda(
    task: TabularTask,
    hack: Bool[np.ndarray, "S A"],
    sigma_h: float | Float[np.ndarray, "S A"],
    *,
    gamma: float = 0.95,
    beta: float = 0.5,
    form: Form = "reciprocal",
    anchor: float | Float[np.ndarray, "S A"] = 0.0,
    visits_allowed: int | None = None,
    high: float = 1e4,
    precision: float = 1e-5,
) -> float | None:
    """Return the smallest lambda at which the fixed point of T_lambda stops hacking, or None.

    It stops hacking when its greedy policy goes from the start to a terminal step instead of circling for ever (the
    horizon plays no part). On the way it may still cross contested states: with a positive reward and w > 0 crossing
    pays. sigma_m is 0, its limit at the fixed point (audit f).

    Lambda = 0 and 4 values per decade from 0.01 to ``high`` are tried in turn; the first that works is refined by
    bisection. An island of success narrower than that grid can be missed.

    Examples:
        >>> from types import SimpleNamespace
        >>> trap = np.array([[4.0, 2.0]])  # action 0 stays for ever at a contested 4, action 1 ends the episode
        >>> stay, end = np.array([[0, 0]]), np.array([[False, True]])
        >>> task = SimpleNamespace(next_state=stay, reward=trap, terminal=end, start=0, horizon=10)
        >>> sigma_h = np.array([[1.0, 0.0]])
        >>> round(critical_lambda(task, ~end, sigma_h, gamma=0.5), 2)  # 4 w / (1 - gamma) = 2: w = 1/4, lambda / 2 = 3
        6.0

    Args:
        task: The task.
        hack: Contested steps.
        sigma_h: The annotators' disagreement, >= 0.
        gamma: Discount in [0, 1).
        beta: Weight of sigma_h in [0, 1].
        form: Which weight, a name in ``uard.method.weights.FORMS``.
        anchor: The pessimistic reward b.
        visits_allowed: Contested steps that the path may still contain; any number if left out.
        high: Largest lambda tried, > 0.01.
        precision: Relative precision of the result, > 0.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    _checks.number("high", high, low=0.01, open_low=True)
    _checks.number("precision", precision, low=0, open_low=True)
    if visits_allowed is not None:
        _checks.whole("visits_allowed", visits_allowed)
    stops = _stopper(task, hack, sigma_h, gamma, beta, form, anchor, visits_allowed)
    if stops(0.0):
        return 0.0
    below = 0.0
    for lam in np.geomspace(0.01, high, int(np.ceil(4 * np.log10(high / 0.01))) + 1):
        if stops(float(lam)):
            return _bisect(stops, below, float(lam), precision)
        below = float(lam)
    return None


def _stopper(
    task: TabularTask,
    hack: Bool[np.ndarray, "S A"],
    sigma_h: float | Float[np.ndarray, "S A"],
    gamma: float,
    beta: float,
    form: Form,
    anchor: float | Float[np.ndarray, "S A"],
    visits_allowed: int | None,
) -> Callable[[float], bool]:
    """Return the question "does the fixed point at this lambda stop hacking?"; it remembers the last policy."""
    reward = _checks.as_numpy("task.reward", task.reward)
    entered, _, onwards = _tables(task.next_state, reward, task.terminal, gamma, 1.0, anchor)
    sigma, b = _like("sigma_h", sigma_h, reward), _like("anchor", anchor, reward)
    ends, contested, start = np.asarray(task.terminal), np.asarray(hack), int(task.start)
    _checks.same_shape("hack", contested, "task.reward", reward)
    reliability = ReliabilityFilter(1.0, 0.0, beta, form)
    policy = np.zeros(len(reward), int)

    def stops(lam: float) -> bool:
        nonlocal policy
        weight = np.asarray(reliability.weight(0.0, sigma, mu=reward - b, lam=lam))
        q, policy = _solve(entered, discount(reward, weight, b), onwards, policy)
        path = _follow(greedy_actions(q), entered, ends, contested, start, len(reward) + 1)
        return path.reached_goal and (visits_allowed is None or path.total_visits <= visits_allowed)

    return stops


def _bisect(stops: Callable[[float], bool], below: float, above: float, precision: float) -> float:
    while above - below > precision * above:
        middle = (below + above) / 2.0
        if stops(middle):
            above = middle
        else:
            below = middle
    return above
