"""DeepQ's arithmetic against values worked out in NumPy."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from uard._checks import InvalidValueError
from uard.agents.off_policy import Batch, OffPolicy
from uard.agents.value import DeepQ, State, backup_weight, conservative_gap
from uard.mitigation import LearningSignal
from uard.networks import SINGLE, Ensemble, Network, Weights

FEATURES, ACTIONS, SCALE, RATE = 5, 3, 4.0, 1e-2
NETWORK = Network(hidden=8, learning_rate=RATE, value_scale=SCALE)
KEY = jax.random.key(0)


def agent(**changes: Any) -> DeepQ:
    return DeepQ(**({"network": NETWORK, "gamma": 0.9, "batch": 4, "bootstrap": 1.0} | changes))


def batch(members: int, size: int = 4, terminated: bool | np.ndarray = False, mask: Any = None) -> Batch:
    here, after, act = (jax.random.key(i) for i in (1, 2, 3))
    return Batch(
        jax.random.normal(here, (size, FEATURES)),
        jax.random.randint(act, (size,), 0, ACTIONS),
        jax.random.normal(after, (size, FEATURES)),
        jnp.broadcast_to(jnp.asarray(terminated), (size,)),
        jnp.ones((size, members)) if mask is None else jnp.asarray(mask, jnp.float32),
    )


REWARD = jnp.array([0.5, -7.0, 30.0, 1.0])


def plain(mu: Any, sigma: Any, observations: Any) -> Any:
    return mu


def updated(
    learner: DeepQ, state: State, some: Batch, prefer: Any = plain, backup: Any = "greedy", weight: Any = 1.0
) -> tuple[State, float]:
    size = some.action.shape[0]
    after, watched = learner.update(
        state, some, lambda sigma: LearningSignal(REWARD[:size], weight), prefer, plain, backup, KEY
    )
    return after, float(watched.loss)


def huber(x: np.ndarray) -> np.ndarray:
    return np.where(abs(x) <= 1, 0.5 * x**2, abs(x) - 0.5)


def loss_by_hand(learner: DeepQ, state: State, some: Batch, best: Any = None) -> np.ndarray:
    """The loss of every member and transition (N, B), from the values alone."""
    q = np.asarray(learner.values(state, some.observation), float)
    target = State(Weights(state.target, state.weights.prior), *state[1:])
    following = np.asarray(learner.values(target, some.following), float)
    rows = np.arange(len(some.action))
    taken = q[:, rows, np.asarray(some.action)]
    value = following.max(-1) if best is None else following[:, rows, best]
    goal = np.asarray(REWARD[: len(rows)]) + 0.9 * value * ~np.asarray(some.terminated)
    gap = np.log(np.exp(q).sum(-1)) - taken
    sigma = value.std(0, ddof=1) if len(value) > 1 else 0.0 * value[0]
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
    following = jnp.array([[1.0, 5.0], [3.0, 5.0]])  # deviations sqrt(2) and 0
    expected = [1 / (1 + np.exp(2 * np.sqrt(2))) + 0.5, 1.0]
    np.testing.assert_allclose(backup_weight(following, 2.0), expected, rtol=1e-6)
    np.testing.assert_array_equal(backup_weight(following, 0.0), [1.0, 1.0])
    np.testing.assert_array_equal(backup_weight(following[:1], 9.0), [1.0, 1.0], err_msg="one member never disagrees")


SETTINGS = {
    "dqn": {"ensemble": SINGLE},
    "cql": {"ensemble": SINGLE, "conservative": 0.7},
    "ensemble": {"ensemble": Ensemble("full", 3)},
    "shared": {"ensemble": Ensemble("shared", 3)},
    "sunrise": {"ensemble": Ensemble("full", 3), "temperature": 5.0, "ucb": 1.0},
    "all": {"ensemble": Ensemble("shared", 3), "temperature": 5.0, "conservative": 0.3},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_the_loss_of_one_transition(name: str):
    learner = agent(**SETTINGS[name])
    for terminated in (False, True):
        state = learner.init(KEY, FEATURES, ACTIONS)
        some = batch(learner.members, 1, terminated)
        _, loss = updated(learner, state, some)
        np.testing.assert_allclose(loss, loss_by_hand(learner, state, some).mean(), rtol=2e-5)


@pytest.mark.parametrize("name", SETTINGS)
def test_the_loss_of_a_batch(name: str):
    learner = agent(**SETTINGS[name])
    state = learner.init(KEY, FEATURES, ACTIONS)
    mask = np.random.default_rng(0).integers(0, 2, (4, learner.members))
    some = batch(learner.members, terminated=np.array([False, True, False, False]), mask=mask)
    each = loss_by_hand(learner, state, some)
    weight = np.array([1.0, 0.5, 0.0, 1.0], np.float32)
    _, loss = updated(learner, state, some, weight=jnp.asarray(weight))
    np.testing.assert_allclose(loss, (mask.T * weight * each).mean(), rtol=2e-5, atol=1e-7)


def test_one_step_by_hand():
    """The gradient of the last layer's bias, and Adam's first step: the rate times the gradient's sign."""
    learner = agent(ensemble=SINGLE)
    state = learner.init(KEY, FEATURES, ACTIONS)
    some = batch(1, 1)
    after, _ = updated(learner, state, some)
    action = int(some.action[0])
    taken = np.asarray(learner.values(state, some.observation))[0, 0, action]
    goal = 0.5 + 0.9 * np.asarray(learner.values(state, some.following)).max()
    # d huber(error) / d bias = error (|error| < 1) times d output / d bias = 1
    gradient = np.zeros(ACTIONS)
    gradient[action] = (taken - goal) / SCALE
    step = -RATE * gradient / (abs(gradient) + 1e-8)
    moved = np.asarray(after.weights.layers[-1].bias - state.weights.layers[-1].bias)
    np.testing.assert_allclose(moved, step, rtol=1e-4, atol=1e-9)
    first_moment = jax.tree.leaves(optax.tree_utils.tree_get(after.optimiser, "mu"))[-1]
    np.testing.assert_allclose(first_moment, 0.1 * gradient, rtol=1e-4, atol=1e-9)


def test_repeated_updates_reach_the_target():
    learner = agent(ensemble=Ensemble("full", 2), target_every=10_000)
    state = learner.init(KEY, FEATURES, ACTIONS)
    some = batch(2, 1, True)
    step = jax.jit(lambda s: learner.update(s, some, lambda _: LearningSignal(REWARD[:1], 1.0), plain, plain, "greedy", KEY))
    for _ in range(200):
        state, _ = step(state)
    taken = np.asarray(learner.values(state, some.observation))[:, 0, int(some.action[0])]
    np.testing.assert_allclose(taken, 0.5, atol=0.05)


def test_a_member_that_is_masked_out_learns_nothing():
    learner = agent(ensemble=Ensemble("full", 3), conservative=0.5)
    state = learner.init(KEY, FEATURES, ACTIONS)
    mask = np.ones((4, 3))
    mask[:, 1] = 0
    after, _ = updated(learner, state, batch(3, mask=mask))
    for new, old in zip(jax.tree.leaves(after.weights.layers), jax.tree.leaves(state.weights.layers), strict=True):
        moved = (np.asarray(new) != np.asarray(old)).reshape(3, -1).any(1)
        np.testing.assert_array_equal(moved, [True, False, True])


def test_priors_never_change():
    learner = agent(ensemble=Ensemble("shared", 3))
    state = learner.init(KEY, FEATURES, ACTIONS)
    after, _ = updated(learner, state, batch(3))
    jax.tree.map(np.testing.assert_array_equal, after.weights.prior, state.weights.prior)


def test_a_step_without_weight_is_skipped():
    learner = agent(ensemble=SINGLE, conservative=1.0)
    state = learner.init(KEY, FEATURES, ACTIONS)
    after, loss = updated(learner, state, batch(1), weight=0.0)
    assert loss == 0
    jax.tree.map(np.testing.assert_array_equal, after.weights.layers, state.weights.layers)


@pytest.mark.parametrize("ensemble", [SINGLE, Ensemble("full", 3), Ensemble("shared", 3)], ids=str)
def test_the_consistent_backup_takes_the_value_at_the_best_score(ensemble: Ensemble):
    learner = agent(ensemble=ensemble)
    state = learner.init(KEY, FEATURES, ACTIONS)
    some = batch(learner.members)
    asked = {}

    def worst(mu: Any, sigma: Any, observations: Any) -> Any:
        asked["observations"] = observations
        return -mu

    _, loss = updated(learner, state, some, worst, "consistent")
    np.testing.assert_array_equal(asked["observations"], some.following)
    mu = np.asarray(learner.values(state, some.following)).mean(0)
    np.testing.assert_allclose(loss, loss_by_hand(learner, state, some, mu.argmin(-1)).mean(), rtol=2e-5)
    _, greedy = updated(learner, state, some, worst, "greedy")
    np.testing.assert_allclose(greedy, loss_by_hand(learner, state, some).mean(), rtol=2e-5)
    assert abs(loss - greedy) > 1e-4


def test_the_judge_hears_the_disagreement_about_what_was_done():
    learner = agent(ensemble=Ensemble("full", 3, prior_scale=1.0))
    state = learner.init(KEY, FEATURES, ACTIONS)
    some = batch(3)
    heard = {}

    def judge(sigma: Any) -> LearningSignal:
        heard["sigma"] = sigma
        return LearningSignal(REWARD, 1.0)

    with jax.disable_jit():
        learner.update(state, some, judge, plain, plain, "greedy", KEY)
    spread = np.asarray(learner.values(state, some.observation)).std(0, ddof=1)
    expected = spread[np.arange(4), np.asarray(some.action)]
    sigma = heard["sigma"]
    sigma = sigma.primal if hasattr(sigma, "primal") else sigma
    np.testing.assert_allclose(jax.lax.stop_gradient(sigma), expected, rtol=1e-4)


def test_the_target_is_copied_now_and_then():
    learner = agent(ensemble=SINGLE, target_every=3)
    state = learner.init(KEY, FEATURES, ACTIONS)
    first = state.target
    for count in (1, 2, 3):
        state, _ = updated(learner, state, batch(1))
        assert int(state.updates) == count
        expected = state.weights.layers if count == 3 else first
        jax.tree.map(np.testing.assert_array_equal, state.target, expected)


def test_dropout_disagrees_and_learns():
    learner = agent(ensemble=Ensemble("dropout", 5, dropout=0.3))
    state = learner.init(KEY, FEATURES, ACTIONS)
    _, sigma = learner.read(state, batch(5).observation, KEY)
    assert (np.asarray(sigma) > 0).all()
    after, loss = updated(learner, state, batch(5))
    assert np.isfinite(loss)
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in zip(*map(jax.tree.leaves, (after, state)), strict=True))


def test_epsilon_decays_with_the_episodes():
    learner = agent(ensemble=SINGLE, epsilon=1.0, epsilon_decay=0.5, epsilon_min=0.125)
    state = learner.init(KEY, FEATURES, ACTIONS)
    here = batch(1).observation[0]
    best = int(learner.greedy(state, here, plain, KEY))
    act = jax.jit(jax.vmap(lambda e, k: learner.act(state, here, plain, e, k), (None, 0)))
    for episode, rate in ((0, 1.0), (1, 0.5), (2, 0.25), (3, 0.125), (50, 0.125)):
        chosen = np.asarray(act(jnp.int32(episode), jax.random.split(KEY, 4000)))
        expected = 1 - rate * (1 - 1 / ACTIONS)
        assert abs((chosen == best).mean() - expected) < 0.035


def test_the_bonus_explores_what_members_disagree_about():
    learner = agent(ensemble=Ensemble("full", 3, prior_scale=1.0), ucb=1e6, epsilon=0.0, epsilon_min=0.0)
    state = learner.init(KEY, FEATURES, ACTIONS)
    for here in batch(3).observation:
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
