import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uard._checks import InvalidValueError, UnknownNameError
from uard.envs.grids.trapgrid import paper_grid
from uard.envs.tables import Task
from uard.method import bellman
from uard.method.weights import ReliabilityFilter

GAMMA = 0.95
# State 0: action 0 stays and pays 1, action 1 ends the episode and pays 3.
STAY_OR_GO = {"next_state": np.array([[0, 0]]), "terminal": np.array([[False, True]]), "gamma": 0.5}
REWARD = np.array([[1.0, 3.0]])


def random_tables(seed: int, states: int = 7, actions: int = 3):
    rng = np.random.default_rng(seed)
    shape = (states, actions)
    tables = {"next_state": rng.integers(0, states, shape), "terminal": rng.random(shape) < 0.1, "gamma": 0.9}
    return rng.normal(0, 3, shape), rng.random(shape), tables, rng


def sigma_table(size: int, trap_reward: float, trap: float, elsewhere: float = 0.0):
    grid = paper_grid(size, trap_reward)
    hack = grid.truth().hack
    return grid.task(), hack, np.where(hack, trap, elsewhere)


def test_backup_by_hand():
    q = np.array([[2.0, 7.0]])
    assert bellman.backup(q, REWARD, 1.0, **STAY_OR_GO).tolist() == [[1 + 0.5 * 7, 3.0]]
    weight = np.array([[1.0, 0.5]])
    assert bellman.backup(q, REWARD, weight, **STAY_OR_GO).tolist() == [[4.5, 1.5]]
    assert bellman.backup(q, REWARD, weight, anchor=-1.0, **STAY_OR_GO).tolist() == [[4.5, 1.0]]


def test_backup_takes_leading_axes():
    reward, weight, tables, rng = random_tables(0)
    q = rng.normal(size=(4, *reward.shape))
    together = bellman.backup(q, reward, weight, **tables)
    for one, many in zip(q, together, strict=True):
        np.testing.assert_array_equal(bellman.backup(one, reward, weight, **tables), many)


@pytest.mark.parametrize(
    ("weight", "anchor", "expected"),
    [
        (1.0, 0.0, [[2.5, 3.0]]),  # going pays 3, staying for ever 2
        (np.array([[1.0, 0.5]]), 0.0, [[2.0, 1.5]]),  # going pays 1.5: staying is better
        (np.array([[1.0, 0.5]]), -1.0, [[2.0, 1.0]]),
        (np.array([[1.0, 0.5]]), 3.0, [[2.5, 3.0]]),  # the anchor is what going pays anyway
        (0.0, 0.0, [[0.0, 0.0]]),
    ],
)
def test_fixed_point_by_hand(weight, anchor, expected):
    swept = bellman.fixed_point(REWARD, weight, anchor=anchor, **STAY_OR_GO)
    np.testing.assert_allclose(swept.q, expected, atol=1e-9)
    np.testing.assert_allclose(bellman.solve(REWARD, weight, anchor=anchor, **STAY_OR_GO), expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_solve_agrees_with_sweeps_from_any_start(seed):
    reward, weight, tables, rng = random_tables(seed)
    exact = bellman.solve(reward, weight, anchor=-1.0, **tables)
    for start in (None, rng.normal(0, 50, reward.shape)):
        swept = bellman.fixed_point(reward, weight, anchor=-1.0, start=start, **tables)
        np.testing.assert_allclose(swept.q, exact, atol=1e-8)
        assert swept.residuals[-1] <= 1e-10
        assert (swept.residuals[1:] <= 0.9 * swept.residuals[:-1] + 1e-12).all()
    np.testing.assert_allclose(bellman.backup(exact, reward, weight, anchor=-1.0, **tables), exact, atol=1e-11)


def test_long_looks_ahead_are_exact():
    tables = {"next_state": np.array([[0]]), "terminal": np.array([[False]]), "gamma": 0.9999}
    assert bellman.solve(np.array([[1.0]]), 1.0, **tables)[0, 0] == pytest.approx(10_000, rel=1e-9)


def test_sweeps_that_do_not_suffice_are_an_error():
    with pytest.raises(InvalidValueError, match=r"max_sweeps = 3: must be more: the residual is still 0\.12"):
        bellman.fixed_point(REWARD, np.array([[1.0, 0.5]]), max_sweeps=3, **STAY_OR_GO)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.99), st.floats(-5, 5))
def test_frozen_weights_contract(seed, gamma, anchor):
    reward, weight, tables, rng = random_tables(seed)
    tables["gamma"] = gamma
    first, second = rng.normal(0, 10, (2, *reward.shape))
    apart = np.abs(
        bellman.backup(first, reward, weight, anchor=anchor, **tables)
        - bellman.backup(second, reward, weight, anchor=anchor, **tables)
    ).max()
    assert apart <= gamma * np.abs(first - second).max() + 1e-12


def test_contraction_ratio_is_gamma():
    reward, weight, tables, _ = random_tables(3)
    assert bellman.contraction_ratio(reward, weight, pairs=50, **tables) == pytest.approx(0.9, abs=1e-9)
    tables["terminal"][:] = True
    assert bellman.contraction_ratio(reward, weight, pairs=50, **tables) == 0.0


@pytest.mark.parametrize(("reward", "least", "supremum"), [(4.0, 5.33, 5.3318), (10.0, 11.9, 11.9045)])
def test_live_weights_expand(reward, least, supremum):
    task, hack, _ = sigma_table(6, reward, 0.0)
    place = tuple(int(i) for i in np.argwhere(hack)[0])
    found = bellman.live_weight_expansion(
        task.reward, task.next_state, task.terminal, GAMMA, gap=1e-4, place=(place[0], place[1])
    )
    assert found.ratio > least
    assert found.ratio < found.supremum
    assert found.supremum == pytest.approx(supremum, abs=1e-4)
    assert np.abs(found.first - found.second).max() == pytest.approx(1e-4)


def test_live_weights_expand_even_on_the_papers_own_goal():
    task, _, _ = sigma_table(6, 4.0, 0.0)
    found = bellman.live_weight_expansion(task.reward, task.next_state, task.terminal, GAMMA)
    assert task.terminal[found.place]
    assert found.ratio > 10.9


@pytest.mark.parametrize(("heads", "ddof", "largest"), [(2, 1, 2**0.5), (2, 0, 1.0), (4, 1, (4 / 3) ** 0.5)])
def test_expansion_follows_the_formula(heads, ddof, largest):
    chain = {"next_state": np.array([[1], [1]]), "terminal": np.array([[False], [False]]), "gamma": 0.5}
    found = bellman.live_weight_expansion(
        np.array([[-6.0], [0.0]]), lam=1.0, alpha=0.25, heads=heads, ddof=ddof, gap=1e-6, **chain
    )
    assert found.supremum == pytest.approx(0.25 * 6 * largest + 0.5)
    assert found.ratio == pytest.approx(found.supremum, rel=1e-4)


def test_expansion_falls_with_the_gap_and_ends_at_the_anchor():
    task, hack, _ = sigma_table(6, 4.0, 0.0)
    place = tuple(int(i) for i in np.argwhere(hack)[0])
    tables = (task.reward, task.next_state, task.terminal, GAMMA)
    ratios = [bellman.live_weight_expansion(*tables, gap=g, place=(place[0], place[1])).ratio for g in (0.01, 1, 100)]
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[-1] < 1
    anchored = bellman.live_weight_expansion(*tables, place=(place[0], place[1]), anchor=4.0)
    assert anchored.ratio == pytest.approx(GAMMA)


def test_ensemble_backup_of_agreeing_heads_is_the_plain_operator():
    reward, _, tables, rng = random_tables(4)
    q = rng.normal(size=reward.shape)
    sigma = rng.random(reward.shape)
    chosen = ReliabilityFilter(lam=3.0, alpha=0.7, beta=0.2)
    heads = np.repeat(q[..., None], 5, axis=-1)
    live = bellman.ensemble_backup(heads, reward, sigma_h=sigma, reliability=chosen, anchor=-2.0, **tables)
    plain = bellman.backup(q, reward, chosen.weight(np.zeros_like(sigma), sigma), anchor=-2.0, **tables)
    np.testing.assert_allclose(live, np.repeat(plain[..., None], 5, axis=-1), atol=1e-12)


def test_greedy_actions_take_the_first_of_equals():
    assert bellman.greedy_actions(np.array([[1.0, 1.0 + 1e-12, 0.0], [0.0, 2.0, 2.0]])).tolist() == [0, 1]


@pytest.mark.parametrize(("size", "visits"), [(6, 18), (8, 28), (10, 38)])
def test_the_fixed_point_hacks_with_and_without_the_papers_filter(size, visits):
    task, hack, sigma = sigma_table(size, 4.0, 1.247)
    for weight in (1.0, 1 / (1 + sigma)):
        q = bellman.solve(task.reward, weight, task.next_state, task.terminal, GAMMA)
        path = bellman.greedy_path(q, task, hack)
        assert path.total_visits == visits
        assert not path.reached_goal
        assert len(path.actions) == task.horizon == len(path.states) - 1


def test_greedy_path_to_the_goal():
    task, hack, _ = sigma_table(6, 4.0, 0.0)
    q = bellman.solve(task.reward, np.where(hack, 1e-3, 1.0), task.next_state, task.terminal, GAMMA)
    path = bellman.greedy_path(q, task, hack)
    assert path.reached_goal
    assert path.visits == {21: 1}
    assert len(path.actions) == 10
    assert path.states[-1] == 35
    cut = bellman.greedy_path(q, task, horizon=9)
    assert not cut.reached_goal
    assert cut.visits == {}


TABLE = [
    (4.0, 1.247, 0.0, "reciprocal", (5.11, 6.05, 8.05)),
    (8.0, 1.247, 0.0, "reciprocal", (11.82, 13.70, 17.71)),
    (4.0, 1.5275, 0.0, "reciprocal", (4.17, 4.94, 6.57)),
    (8.0, 1.5275, 0.0, "reciprocal", (9.65, 11.18, 14.46)),
    (4.0, 1.247, 0.0, "exponential", (2.30, 2.51, 2.88)),
    (8.0, 1.247, 0.0, "exponential", (3.41, 3.62, 3.99)),
    (4.0, 0.412, 0.154, "reciprocal", (None, None, None)),
    (4.0, 0.505, 0.188, "reciprocal", (None, None, None)),
]


@pytest.mark.parametrize(("reward", "trap", "elsewhere", "form", "expected"), TABLE)
def test_critical_lambda(reward, trap, elsewhere, form, expected):
    for size, value in zip((6, 8, 10), expected, strict=True):
        found = bellman.critical_lambda(*sigma_table(size, reward, trap, elsewhere), form=form)
        assert found == (None if value is None else pytest.approx(value, abs=0.006))


def test_critical_lambda_is_where_the_path_changes():
    task, hack, sigma = sigma_table(6, 4.0, 1.247)
    lam = bellman.critical_lambda(task, hack, sigma)
    assert lam is not None
    for factor, arrives in ((0.999, False), (1.001, True)):
        q = bellman.solve(task.reward, 1 / (1 + factor * lam * 0.5 * sigma), task.next_state, task.terminal, GAMMA)
        assert bellman.greedy_path(q, task, hack).reached_goal is arrives


def test_critical_lambda_with_an_anchor_and_without_visits():
    args = sigma_table(6, 4.0, 1.247)
    assert bellman.critical_lambda(*args, anchor=-1.0) == pytest.approx(2.496, abs=1e-3)
    assert bellman.critical_lambda(*args, anchor=-1.0, visits_allowed=0) == pytest.approx(7.3064, abs=1e-3)
    assert bellman.critical_lambda(*args, visits_allowed=0) is None  # w > 0: crossing always pays
    assert bellman.critical_lambda(*args, high=5.0) is None


def test_critical_lambda_of_a_task_that_needs_none():
    task, hack, sigma = sigma_table(6, -1.0, 1.247)
    assert bellman.critical_lambda(task, hack, sigma) == 0.0


GOOD = {"reward": REWARD, "weight": 1.0, **STAY_OR_GO}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gamma": 1.0}, r"gamma = 1\.0: must be less than 1"),
        ({"gamma": -0.1}, r"gamma = -0\.1: must be a finite number in \[0, 1\]"),
        ({"reward": np.array([[1.0, np.nan]])}, r"reward\[0, 1\] = nan: must be finite"),
        ({"reward": np.zeros(2)}, r"reward\.shape = \(2,\): must be \(S, A\)"),
        ({"next_state": np.array([[0, 1]])}, r"next_state\[0, 1\] = 1: must be a state in 0\.\.0"),
        ({"next_state": np.array([[0.0, 0.0]])}, r"next_state\.dtype = 'float64': must be an integer type"),
        ({"terminal": np.array([[0, 1]])}, r"terminal\.dtype = 'int64': must be bool"),
        ({"terminal": np.array([[False]])}, r"terminal\.shape = \(1, 1\): must be \(1, 2\), the shape of reward"),
        ({"weight": np.array([[-1.0, 1.0]])}, r"weight\[0, 0\] = -1\.0: must be finite and >= 0"),
        ({"weight": np.ones((2, 2))}, r"weight\.shape = \(2, 2\): must be \(1, 2\), the shape of reward"),
        ({"anchor": np.inf}, r"anchor = inf: must be finite"),
    ],
)
def test_bad_tables_are_named(changes, message):
    arguments = GOOD | changes
    for call in (bellman.solve, bellman.fixed_point, bellman.contraction_ratio):
        with pytest.raises(InvalidValueError, match=message):
            call(**arguments)
    with pytest.raises(InvalidValueError, match=message):
        bellman.backup(np.zeros((1, 2)), **arguments)


def test_other_bad_arguments_are_named():
    task, hack, sigma = sigma_table(6, 4.0, 1.247)
    tables = (task.reward, task.next_state, task.terminal, GAMMA)
    q = np.zeros_like(sigma)
    for call, message in (
        (lambda: bellman.backup(np.zeros((2, 2)), **GOOD), r"q\.shape = \(2, 2\)"),
        (lambda: bellman.fixed_point(**GOOD, tolerance=0.0), r"tolerance = 0\.0: must be a finite number > 0"),
        (lambda: bellman.fixed_point(**GOOD, start=np.zeros((2, 2))), r"start\.shape"),
        (lambda: bellman.contraction_ratio(**GOOD, pairs=0), r"pairs = 0"),
        (lambda: bellman.ensemble_backup(q, *tables), r"heads\.shape = \(36, 4\): must be \(S, A, N\)"),
        (lambda: bellman.ensemble_backup(q[..., None], *tables), r"ddof = 1: must be a whole number in \[0, 0\]"),
        (lambda: bellman.live_weight_expansion(*tables, heads=1), r"heads = 1: must be a whole number >= 2"),
        (lambda: bellman.live_weight_expansion(*tables, gap=0), r"gap = 0"),
        (lambda: bellman.live_weight_expansion(*tables, place=(99, 0)), r"place\[0\] = 99"),
        (lambda: bellman.greedy_path(q[:3], task), r"q\.shape = \(3, 4\)"),
        (lambda: bellman.greedy_path(q, task, horizon=0), r"horizon = 0"),
        (lambda: bellman.greedy_path(q, task, hack[:3]), r"hack\.shape"),
        (lambda: bellman.critical_lambda(task, hack, -sigma), r"sigma_h\[14, 1\] = -1\.247|sigma_h\[15, 1\] = -1\.247"),
        (lambda: bellman.critical_lambda(task, hack[:3], sigma), r"hack\.shape"),
        (lambda: bellman.critical_lambda(task, hack, sigma, visits_allowed=-1), r"visits_allowed = -1"),
        (lambda: bellman.critical_lambda(task, hack, sigma, beta=2.0), r"beta = 2\.0"),
        (lambda: bellman.critical_lambda(task, hack, sigma, high=0.001), r"high = 0\.001"),
    ):
        with pytest.raises(InvalidValueError, match=message):
            call()
    with pytest.raises(UnknownNameError, match="did you mean 'exponential'"):
        bellman.critical_lambda(task, hack, sigma, form="exponentail")  # type: ignore[arg-type]


def test_integers_and_lists_of_a_plain_task_are_enough():
    task = Task(np.array([[0, 0]]), np.array([[1, 3]]), np.array([[False, True]]), 0, 5)
    q = bellman.solve(task.reward, 1, task.next_state, task.terminal, 0.5)
    assert bellman.greedy_path(q, task).actions == (1,)
