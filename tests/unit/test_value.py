"""DeepQ's arithmetic against values worked out in NumPy."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from uard._checks import InvalidValueError
from uard.agents.networks import SINGLE, Ensemble, Network
from uard.agents.off_policy import OffPolicy, Transitions
from uard.agents.value import DeepQ, State, backup_weight, conservative_gap
from uard.method.mitigations import LearningSignal

FEATURES, ACTIONS, SCALE, RATE = 5, 3, 4.0, 1e-2
NETWORK = Network(hidden=8, learning_rate=RATE, value_scale=SCALE)
KEY = jax.random.key(0)


def agent(**changes: Any) -> DeepQ:
    return DeepQ(**({"network": NETWORK, "gamma": 0.9, "batch": 4, "bootstrap": 1.0} | changes))


def batch(members: int, terminated: Any = (False, True, False, False), mask: Any = None) -> Transitions:
    """Four transitions."""
    rng = np.random.default_rng(1)
    return Transitions(
        rng.normal(size=(4, FEATURES)).astype(np.float32),
        rng.integers(0, ACTIONS, 4).astype(np.int32),
        rng.normal(size=(4, FEATURES)).astype(np.float32),
        np.array(terminated),
        np.ones((4, members), np.float32) if mask is None else np.float32(mask),
    )  # type: ignore[arg-type]


REWARD = np.array([0.5, -7.0, 30.0, 1.0], np.float32)


def plain(mu: Any, sigma: Any, observations: Any) -> Any:
    return mu


def negated(mu: Any, sigma: Any, observations: Any) -> Any:
    return -mu


@cache
def begun(learner: DeepQ) -> State:
    """A fresh state with other weights, which unlike the drawn ones need not be compiled."""
    rng = np.random.default_rng(0)

    def other(x: Any) -> Any:
        return jnp.asarray(rng.normal(scale=0.4, size=x.shape), jnp.float32)

    shape = jax.eval_shape(lambda: learner.init(KEY, FEATURES, ACTIONS))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    return zeros._replace(weights=jax.tree.map(other, shape.weights), target=jax.tree.map(other, shape.target))


ALL = np.ones(4)


@cache
def step(learner: DeepQ, score_fn: Any = plain, backup: Any = "greedy") -> Any:
    """A compiled update; ``doubt`` times the sigma_m that the reward function is given is added to the reward."""

    def update(state: State, some: Transitions, weight: Any, doubt: Any) -> tuple[State, Any]:
        def reward_fn(sigma: Any) -> LearningSignal:
            return LearningSignal(jnp.asarray(REWARD) + doubt * sigma, weight)

        after, info = learner.update(state, some, reward_fn, score_fn, plain, backup, KEY)
        return after, info.loss

    # Level 0 of XLA's optimiser compiles fastest.
    compiled = jax.jit(update, compiler_options={"xla_backend_optimization_level": 0})
    return lambda state, some, weight=ALL, doubt=0.0: compiled(state, some, np.float32(weight), np.float32(doubt))


def values(learner: DeepQ, state: State, observations: Any) -> np.ndarray:
    return np.asarray(learner.values(state, observations), float)


def targets(learner: DeepQ, state: State, observations: Any) -> np.ndarray:
    return values(learner, state._replace(weights=state.weights._replace(layers=state.target)), observations)


def huber(x: np.ndarray) -> np.ndarray:
    return np.where(abs(x) <= 1, 0.5 * x**2, abs(x) - 0.5)


def loss_by_hand(learner: DeepQ, some: Transitions, best: Any = None, doubt: float = 0.0) -> np.ndarray:
    """The loss of every member and transition (N, B) in the first update, from the values alone."""
    state = begun(learner)
    q, next_values = values(learner, state, some.observation), targets(learner, state, some.next_observation)
    rows = np.arange(4)
    taken = q[:, rows, np.asarray(some.action)]
    value = next_values.max(-1) if best is None else next_values[:, rows, best]
    many = len(q) > 1
    reward = REWARD + (doubt * taken.std(0, ddof=1) if many else 0.0)
    goal = reward + 0.9 * value * ~np.asarray(some.terminated)
    gap = np.log(np.exp(q).sum(-1)) - taken
    sigma = value.std(0, ddof=1) if many else 0.0 * value[0]
    weight = np.where(some.terminated, 1.0, 1 / (1 + np.exp(learner.temperature * sigma)) + 0.5)
    return weight * huber((taken - goal) / SCALE) + learner.conservative * gap / SCALE**2


def test_it_is_an_off_policy_learner():
    assert isinstance(DeepQ(), OffPolicy)


def test_the_conservative_gap():
    values = jnp.array([[[0.0, 0.0], [1.0, 3.0]], [[np.log(3.0), 0.0], [-1.0, -1.0]]])
    gap = conservative_gap(values, jnp.array([0, 1]))
    expected = [[np.log(2), np.log(np.e + np.e**3) - 3], [np.log(4 / 3), np.log(2)]]
    np.testing.assert_allclose(gap, expected, rtol=1e-5)
    assert (np.asarray(gap) > 0).all()
    huge = conservative_gap(jnp.array([[[1e30, -1e30]]]), jnp.array([0]))
    assert np.isfinite(np.asarray(huge)).all()


def test_the_backup_weight():
    next_values = jnp.array([[1.0, 5.0], [3.0, 5.0]])  # deviations sqrt(2) and 0
    expected = [1 / (1 + np.exp(2 * np.sqrt(2))) + 0.5, 1.0]
    np.testing.assert_allclose(backup_weight(next_values, 2.0), expected, rtol=1e-6)
    np.testing.assert_array_equal(backup_weight(next_values, 0.0), [1.0, 1.0])
    np.testing.assert_array_equal(backup_weight(next_values[:1], 9.0), [1.0, 1.0], err_msg="one never disagrees")


SETTINGS: dict[str, dict[str, Any]] = {
    "dqn": {"ensemble": SINGLE},
    "cql": {"ensemble": SINGLE, "conservative": 0.7},
    "ensemble": {"ensemble": Ensemble("full", 3)},
    "shared": {"ensemble": Ensemble("shared", 3)},
    "sunrise": {"ensemble": Ensemble("full", 3), "temperature": 5.0, "ucb": 1.0},
    "all": {"ensemble": Ensemble("shared", 3), "temperature": 5.0, "conservative": 0.3},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_the_loss(name: str):
    learner = agent(**SETTINGS[name])
    some = batch(learner.members)
    each = loss_by_hand(learner, some)
    for row in range(4):
        alone = np.eye(4)[row]
        _, loss = step(learner)(begun(learner), some, alone)
        np.testing.assert_allclose(loss, each[:, row].mean() / 4, rtol=2e-5, err_msg="one transition")
    mask = np.random.default_rng(0).integers(0, 2, (4, learner.members))
    weight = np.array([1.0, 0.5, 0.0, 1.0])
    _, loss = step(learner)(begun(learner), batch(learner.members, mask=mask), weight)
    np.testing.assert_allclose(loss, (mask.T * weight * each).mean(), rtol=2e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["dqn", "ensemble", "shared"])
def test_the_reward_function_is_given_sigma_m_of_the_action_taken(name: str):
    learner = agent(**SETTINGS[name])
    some = batch(learner.members)
    _, loss = step(learner)(begun(learner), some, doubt=10.0)
    np.testing.assert_allclose(loss, loss_by_hand(learner, some, doubt=10.0).mean(), rtol=2e-5)


def test_one_step_by_hand():
    """The gradient of the last layer's bias, and Adam's first step: the rate times the gradient's sign."""
    learner = agent(**SETTINGS["dqn"])
    state, some = begun(learner), batch(1)
    after, _ = step(learner)(state, some, np.eye(4)[0])
    action = some.action[0]
    taken = values(learner, state, some.observation)[0, 0, action]
    goal = 0.5 + 0.9 * targets(learner, state, some.next_observation)[0, 0].max()
    # d huber(error) / d bias = error (|error| < 1) times d output / d bias = 1; a mean over four transitions.
    gradient = np.zeros(ACTIONS)
    gradient[action] = (taken - goal) / SCALE / 4
    expected = -RATE * gradient / (abs(gradient) + 1e-8)
    moved = np.asarray(after.weights.layers[-1].bias - state.weights.layers[-1].bias)
    np.testing.assert_allclose(moved, expected, rtol=1e-4, atol=1e-9)
    first_moment = optax.tree_utils.tree_get(after.optimiser, "mu")[-1].bias
    np.testing.assert_allclose(first_moment, 0.1 * gradient, rtol=1e-4, atol=1e-9)


def test_repeated_updates_reach_the_target():
    learner = agent(**SETTINGS["ensemble"])
    state, some = begun(learner), batch(3, [True] * 4)
    for _ in range(300):
        state, _ = step(learner)(state, some, [1, 1, 0, 1])
    taken = values(learner, state, some.observation)[:, np.arange(4), some.action]
    np.testing.assert_allclose(taken[:, [0, 1, 3]], np.broadcast_to(REWARD[[0, 1, 3]], (3, 3)), atol=0.1)


def test_a_member_that_is_masked_out_learns_nothing():
    learner = agent(**SETTINGS["ensemble"])
    state, mask = begun(learner), np.ones((4, 3))
    mask[:, 1] = 0
    after, _ = step(learner)(state, batch(3, mask=mask))
    for new, old in zip(jax.tree.leaves(after.weights.layers), jax.tree.leaves(state.weights.layers), strict=True):
        moved = (np.asarray(new) != np.asarray(old)).reshape(3, -1).any(1)
        np.testing.assert_array_equal(moved, [True, False, True])


def test_priors_never_change():
    learner = agent(**SETTINGS["shared"])
    after, _ = step(learner)(begun(learner), batch(3))
    jax.tree.map(np.testing.assert_array_equal, after.weights.prior, begun(learner).weights.prior)


def test_a_step_without_weight_is_skipped():
    learner = agent(**SETTINGS["cql"])
    state = begun(learner)
    after, loss = step(learner)(state, batch(1), np.zeros(4))
    assert loss == 0
    jax.tree.map(np.testing.assert_array_equal, after.weights.layers, state.weights.layers)


@pytest.mark.parametrize("name", ["dqn", "ensemble", "shared"])
def test_the_consistent_backup_takes_the_value_at_the_best_score(name: str):
    learner = agent(**SETTINGS[name])
    some = batch(learner.members)
    _, loss = step(learner, negated, "consistent")(begun(learner), some)
    mu = targets(learner, begun(learner), some.next_observation).mean(0)
    np.testing.assert_allclose(loss, loss_by_hand(learner, some, mu.argmin(-1)).mean(), rtol=2e-5)
    _, greedy = step(learner)(begun(learner), some)
    assert abs(loss - greedy) > 1e-4


def test_the_target_is_copied_now_and_then():
    learner = agent(**(SETTINGS["dqn"] | {"target_every": 3}))
    state = begun(learner)
    first = state.target
    for count in (1, 2, 3):
        state, _ = step(learner)(state, batch(1))
        assert int(state.updates) == count
        expected = state.weights.layers if count == 3 else first
        jax.tree.map(np.testing.assert_array_equal, state.target, expected)


def test_dropout_disagrees_and_learns():
    learner = agent(ensemble=Ensemble("dropout", 5, dropout=0.3))
    _, sigma = learner.read(begun(learner), jnp.asarray(batch(5).observation), KEY)
    assert (np.asarray(sigma) > 0).all()
    after, loss = step(learner)(begun(learner), batch(5))
    assert np.isfinite(loss)
    for new, old in zip(after.weights.layers, begun(learner).weights.layers, strict=True):
        assert (np.asarray(new.weight) != np.asarray(old.weight)).any()


def test_epsilon_decays_with_the_episodes():
    learner = agent(ensemble=SINGLE, epsilon=1.0, epsilon_decay=0.5, epsilon_min=0.125)
    state, here = begun(learner), jnp.asarray(batch(1).observation[0])
    best = int(learner.greedy(state, here, plain, KEY))
    act = jax.jit(jax.vmap(lambda e, k: learner.act(state, here, plain, e, k), (None, 0)))
    for episode, rate in ((0, 1.0), (1, 0.5), (2, 0.25), (3, 0.125), (50, 0.125)):
        chosen = np.asarray(act(jnp.int32(episode), jax.random.split(KEY, 4000)))
        expected = 1 - rate * (1 - 1 / ACTIONS)
        assert abs((chosen == best).mean() - expected) < 0.035


def test_the_bonus_explores_what_members_disagree_about():
    learner = agent(ensemble=Ensemble("full", 3, prior_scale=1.0), ucb=1e6, epsilon=0.0, epsilon_min=0.0)
    state = begun(learner)
    for here in jnp.asarray(batch(3).observation):
        mu, sigma = learner.read(state, here[None], KEY)
        assert int(learner.act(state, here, plain, jnp.int32(0), KEY)) == int(np.argmax(sigma))
        assert int(learner.greedy(state, here, plain, KEY)) == int(np.argmax(mu))


def test_a_single_network_learns_from_every_transition():
    assert DeepQ(bootstrap=0.3).bootstrap == 1
    assert DeepQ(ensemble=Ensemble("shared", 2), bootstrap=0.3).bootstrap == 0.3


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gamma", 1.0),
        ("epsilon", 1.5),
        ("epsilon_decay", -0.1),
        ("batch", 0),
        ("buffer", 3),
        ("warmup", -1),
        ("target_every", 0),
        ("bootstrap", 0.0),
        ("conservative", -1.0),
        ("ucb", float("nan")),
        ("temperature", -1.0),
    ],
)
def test_what_is_refused(field: str, value: Any):
    with pytest.raises(InvalidValueError, match=f"^{field} = "):
        DeepQ(**{field: value})
