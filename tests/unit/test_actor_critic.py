"""SAC's and EDAC's arithmetic against values worked out in NumPy."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uard._checks import InvalidValueError
from uard.agents import actor_critic
from uard.agents.actor_critic import (
    SoftActorCritic,
    State,
    edac,
    entropy,
    gradient_similarity,
    log_policy,
    lowest,
    polyak,
    simplex_gradient,
    soft_value,
    temperature_loss,
)
from uard.agents.networks import Ensemble, Network
from uard.agents.off_policy import OffPolicy, Transitions
from uard.method.mitigations import LearningSignal

FEATURES, ACTIONS, SCALE, RATE = 5, 3, 4.0, 1e-2
NETWORK = Network(hidden=8, learning_rate=RATE, value_scale=SCALE)
KEY = jax.random.key(0)
REWARD = np.array([0.5, -7.0, 30.0, 1.0], np.float32)
ROWS, ALL = np.arange(4), np.ones(4)


def test_both_are_off_policy_learners():
    assert isinstance(SoftActorCritic(), OffPolicy)
    assert isinstance(edac(), OffPolicy)
    assert SoftActorCritic().members == 2
    assert edac().members >= 5
    assert edac().diversity > 0 == SoftActorCritic().diversity


def test_the_similarity_of_gradients_by_hand():
    """Of three critics two agree and one is at right angles, then opposite."""
    right = np.array([[[1.0, 0.0]], [[5.0, 0.0]], [[0.0, 2.0]]])
    opposite = np.array([[[1.0, 0.0]], [[5.0, 0.0]], [[-3.0, 0.0]]])
    for gradients, pairs in ((right, 2.0), (opposite, 2 - 2 - 2)):
        expected = pairs / 2  # divided by N - 1
        np.testing.assert_allclose(gradient_similarity(jnp.float32(gradients)), expected, atol=1e-5)
    both = np.concatenate([right, opposite], axis=1)
    np.testing.assert_allclose(gradient_similarity(jnp.float32(both)), (1.0 - 1.0) / 2, atol=1e-5)


def test_the_similarity_of_gradients_is_the_double_sum():
    gradients = np.random.default_rng(0).normal(size=(5, 7, 4)).astype(np.float32)
    unit = gradients / np.linalg.norm(gradients, axis=-1, keepdims=True)
    cosines = np.einsum("kbi,jbi->kjb", unit, unit)
    expected = (cosines.sum((0, 1)) - np.trace(cosines)).mean() / 4
    np.testing.assert_allclose(gradient_similarity(jnp.asarray(gradients)), expected, rtol=1e-4)
    np.testing.assert_allclose(gradient_similarity(jnp.ones((5, 2, 3))), 5.0, rtol=1e-5)


def test_gradients_without_length_have_no_direction():
    nothing = jnp.zeros((3, 2, 4))
    assert gradient_similarity(nothing) == 0
    slope = jax.grad(gradient_similarity)(nothing.at[0, 0, 0].set(1e-20))
    assert np.isfinite(np.asarray(slope)).all()


def test_descent_on_the_similarity_pushes_critics_apart():
    gradients = jnp.asarray(np.random.default_rng(0).normal(size=(3, 1, 4)) + 2.0, jnp.float32)
    after = gradients - 0.1 * jax.grad(gradient_similarity)(gradients)
    assert gradient_similarity(after) < gradient_similarity(gradients) - 1e-3


def test_the_gradient_on_the_simplex():
    values = jnp.array([[1.0, 2.0, 6.0]])
    np.testing.assert_allclose(simplex_gradient(values), [[-2.0, -1.0, 3.0]])
    np.testing.assert_allclose(simplex_gradient(values + 50.0), [[-2.0, -1.0, 3.0]], atol=1e-5)

    def along(a: Any) -> Any:  # a relaxed action, moved on the simplex only
        return ((a - a.mean() + 1 / 3) * values[0]).sum()

    np.testing.assert_allclose(jax.grad(along)(jnp.ones(3) / 3), simplex_gradient(values)[0], atol=1e-6)


def test_the_entropy_of_a_policy():
    chances = np.array([[0.5, 0.25, 0.25], [1 / 3, 1 / 3, 1 / 3]])
    np.testing.assert_allclose(entropy(jnp.log(jnp.float32(chances))), [1.5 * np.log(2), np.log(3)], rtol=1e-5)
    certain = jax.nn.log_softmax(jnp.array([200.0, 0.0, -200.0]))
    assert entropy(certain) == 0


def test_the_soft_value():
    log_chances = jnp.log(jnp.array([0.25, 0.75]))
    surprise = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    np.testing.assert_allclose(soft_value(jnp.array([4.0, 8.0]), log_chances, 0.0), 7.0, rtol=1e-6)
    np.testing.assert_allclose(soft_value(jnp.array([4.0, 8.0]), log_chances, 2.0), 7.0 + 2 * surprise, rtol=1e-6)
    best = jax.nn.log_softmax(jnp.array([4.0, 8.0]) / 2.0)
    expected = 2.0 * np.log(np.exp(2.0) + np.exp(4.0))
    np.testing.assert_allclose(soft_value(jnp.array([4.0, 8.0]), best, 2.0), expected, rtol=1e-6)


def test_the_lowest_of_the_critics_is_clipped_action_by_action():
    values = jnp.array([[[1.0, 5.0]], [[3.0, 2.0]], [[2.0, 9.0]]])
    np.testing.assert_array_equal(lowest(values), [[1.0, 2.0]])


@pytest.mark.parametrize("log_temperature", [-5.0, 0.0, 2.0])
def test_the_temperature_rises_where_entropy_is_missing(log_temperature: float):
    slope = jax.grad(temperature_loss)(jnp.float32(log_temperature), jnp.array([0.2, 0.4]), 0.5)
    np.testing.assert_allclose(slope, 0.3 - 0.5, rtol=1e-5)  # descent raises log T, by as much at every T
    assert jax.grad(temperature_loss)(jnp.float32(log_temperature), jnp.array([0.9, 0.7]), 0.5) > 0
    assert jax.grad(temperature_loss)(jnp.float32(log_temperature), jnp.array([0.3, 0.7]), 0.5) == 0


def test_polyak_averages():
    old, new = {"a": jnp.array([0.0, 2.0])}, {"a": jnp.array([1.0, 4.0])}
    np.testing.assert_allclose(polyak(old, new, 0.25)["a"], [0.25, 2.5])
    np.testing.assert_array_equal(polyak(old, new, 1.0)["a"], new["a"])


def test_the_target_entropy_shrinks():
    learner = SoftActorCritic(entropy=0.8, entropy_decay=0.5, entropy_min=0.1)
    shares = [float(learner.target_entropy(jnp.int32(n), 4)) / np.log(4) for n in (0, 1, 2, 3, 1000)]
    np.testing.assert_allclose(shares, [0.8, 0.4, 0.2, 0.1, 0.1], rtol=1e-5)


def agent(**changes: Any) -> SoftActorCritic:
    settings = {"network": NETWORK, "gamma": 0.9, "batch": 4, "temperature": 0.3, "tau": 0.25}
    return SoftActorCritic(**(settings | changes))


SETTINGS: dict[str, dict[str, Any]] = {
    "single": {"ensemble": Ensemble("full", 1, 0.0)},
    "edac": {"ensemble": Ensemble("full", 3, 0.2), "diversity": 0.7},
    "shared": {"ensemble": Ensemble("shared", 3, 0.2)},
    "dropout": {"ensemble": Ensemble("dropout", 3)},
}


def plain(mu: Any, sigma: Any, observations: Any) -> Any:
    return mu


def cautious(mu: Any, sigma: Any, observations: Any) -> Any:
    return mu - 3.0 * sigma + observations[:, :1]


@cache
def begun(learner: SoftActorCritic) -> State:
    """A fresh state with other weights, which unlike the drawn ones need not be compiled."""
    rng = np.random.default_rng(0)

    def other(x: Any) -> Any:
        return jnp.asarray(rng.normal(scale=0.4, size=x.shape), jnp.float32)

    shape = jax.eval_shape(lambda: learner.init(KEY, FEATURES, ACTIONS))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    trained = jax.tree.map(other, shape.trained)._replace(log_temperature=jnp.float32(np.log(learner.temperature)))
    target, prior = jax.tree.map(other, (shape.target, shape.prior))
    return zeros._replace(trained=trained, target=target, prior=prior)


@cache
def step(learner: SoftActorCritic, score_fn: Any = plain) -> Any:
    """A compiled update; ``doubt`` times the sigma_m that the reward function is given is added to the reward."""

    def never(*_: Any) -> Any:
        raise AssertionError("the policy itself scores the next actions")

    def update(state: State, some: Transitions, weight: Any, doubt: Any) -> tuple[State, Any]:
        def reward_fn(sigma: Any) -> LearningSignal:
            return LearningSignal(jnp.asarray(REWARD) + doubt * sigma, weight)

        after, info = learner.update(state, some, reward_fn, never, score_fn, "greedy", KEY)
        return after, info.loss

    compiled = jax.jit(update, compiler_options={"xla_backend_optimization_level": 0})
    return lambda state, some, weight=ALL, doubt=0.0: compiled(state, some, np.float32(weight), np.float32(doubt))


def batch(members: int, mask: Any = None, terminated: Any = (False, True, False, False)) -> Transitions:
    """Four transitions."""
    rng = np.random.default_rng(1)
    return Transitions(
        rng.normal(size=(4, FEATURES)).astype(np.float32),
        rng.integers(0, ACTIONS, 4).astype(np.int32),
        rng.normal(size=(4, FEATURES)).astype(np.float32),
        np.array(terminated),
        np.ones((4, members), np.float32) if mask is None else np.float32(mask),
    )  # type: ignore[arg-type]


def loss_by_hand(
    learner: SoftActorCritic, some: Transitions, weight: Any = ALL, doubt: float = 0.0, score_fn: Any = plain
):
    state = begun(learner)
    frozen = state._replace(trained=state.trained._replace(critics=state.target))
    q, next_values = (
        np.asarray(learner.values(s, x), float) for s, x in ((state, some.observation), (frozen, some.next_observation))
    )
    log_here, log_next = (
        np.asarray(learner.policy(state, x), float) for x in (some.observation, some.next_observation)
    )
    heat = learner.temperature * SCALE
    value = (np.exp(log_next) * (next_values.min(0) - heat * log_next)).sum(-1)
    sigma = q.std(0, ddof=1) if len(q) > 1 else 0 * q[0]
    goal = REWARD + doubt * sigma[ROWS, some.action] + 0.9 * value * ~np.asarray(some.terminated)
    error = (q[:, ROWS, some.action] - goal) / SCALE
    huber = np.where(abs(error) <= 1, 0.5 * error**2, abs(error) - 0.5)
    critics = (np.asarray(some.mask).T * weight * huber).mean()
    scores = np.asarray(score_fn(q.min(0), sigma, np.asarray(some.observation)))
    actor = (np.exp(log_here) * (learner.temperature * log_here - scores / SCALE)).sum(-1).mean()
    surprise = -(np.exp(log_here) * log_here).sum(-1)
    tuning = np.log(learner.temperature) * (surprise.mean() - learner.entropy * np.log(ACTIONS))
    alike = float(gradient_similarity(jnp.float32(q - q.mean(-1, keepdims=True)) / SCALE)) if len(q) > 1 else 0.0
    return critics + actor + tuning + learner.diversity * alike


@pytest.mark.parametrize("name", ["single", "edac", "shared"])
def test_the_loss(name: str):
    learner = agent(**SETTINGS[name])
    mask = np.random.default_rng(0).integers(0, 2, (4, learner.members))
    weight = np.array([1.0, 0.5, 0.0, 1.0])
    for some, w in ((batch(learner.members), np.eye(4)[0]), (batch(learner.members, mask), weight)):
        _, loss = step(learner)(begun(learner), some, w)
        np.testing.assert_allclose(loss, loss_by_hand(learner, some, w), rtol=2e-5)
    some = batch(learner.members)
    _, loss = step(learner)(begun(learner), some, doubt=5.0)
    np.testing.assert_allclose(loss, loss_by_hand(learner, some, doubt=5.0), rtol=2e-5)


def test_the_actor_climbs_the_mitigations_scores_here():
    learner = agent(**SETTINGS["edac"])
    some = batch(3)
    after, loss = step(learner, cautious)(begun(learner), some)
    np.testing.assert_allclose(loss, loss_by_hand(learner, some, score_fn=cautious), rtol=2e-5)
    other, _ = step(learner)(begun(learner), some)
    for a, b in zip(after.trained.critics, other.trained.critics, strict=True):
        np.testing.assert_allclose(a.weight, b.weight, atol=1e-6, err_msg="no critic learns from the scores")
    actors = (s.trained.actor[-1].weight for s in (after, other))
    assert (np.asarray(next(actors)) != np.asarray(next(actors))).any()


def test_repeated_updates_learn_values_and_policy():
    learner = agent(**SETTINGS["edac"] | {"temperature": 0.02})
    state, some = begun(learner), batch(3, terminated=[True] * 4)
    for _ in range(1000):
        state, _ = step(learner)(state, some, [1, 1, 0, 1])
    q = np.asarray(learner.values(state, some.observation))
    np.testing.assert_allclose(q[:, ROWS, some.action][:, [0, 1, 3]], np.tile(REWARD[[0, 1, 3]], (3, 1)), atol=0.3)
    low, chosen = q.min(0), np.asarray(learner.policy(state, some.observation)).argmax(-1)
    assert (low[ROWS, chosen] >= low.max(-1) - 0.3).all()
    for i, observation in enumerate(jnp.asarray(some.observation)):
        assert int(learner.greedy(state, observation, plain, KEY)) == chosen[i]


def test_a_critic_that_is_masked_out_learns_nothing():
    learner = agent(**SETTINGS["edac"] | {"diversity": 0.0})
    mask = np.ones((4, 3))
    mask[:, 1] = 0
    after, _ = step(learner)(begun(learner), batch(3, mask))
    layers = (jax.tree.leaves(s.trained.critics) for s in (after, begun(learner)))
    for new, old in zip(*layers, strict=True):
        moved = (np.asarray(new) != np.asarray(old)).reshape(3, -1).any(1)
        np.testing.assert_array_equal(moved, [True, False, True])


def test_the_target_follows_and_the_prior_stays():
    learner = agent(**SETTINGS["edac"])
    state = begun(learner)
    after, _ = step(learner)(state, batch(3))
    jax.tree.map(np.testing.assert_array_equal, after.prior, state.prior)
    expected = jax.tree.map(lambda t, new: 0.75 * t + 0.25 * new, state.target, after.trained.critics)
    for got, want in zip(jax.tree.leaves(after.target), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)
    assert int(after.updates) == 1


@pytest.mark.parametrize(("share", "sign"), [(1.0, 1), (0.0, -1)])
def test_the_temperature_follows_the_target_entropy(share: float, sign: int):
    learner = agent(**SETTINGS["single"] | {"entropy": share, "entropy_min": 0.0})
    after, _ = step(learner)(begun(learner), batch(1))
    moved = float(after.trained.log_temperature) - np.log(0.3)
    np.testing.assert_allclose(moved, sign * RATE, rtol=1e-3)


def test_dropout_critics_learn():
    learner = agent(**SETTINGS["dropout"])
    _, sigma = learner.read(begun(learner), jnp.asarray(batch(3).observation), KEY)
    assert (np.asarray(sigma) > 0).all()
    after, loss = step(learner)(begun(learner), batch(3))
    assert np.isfinite(loss)
    for new, old in zip(after.trained.critics, begun(learner).trained.critics, strict=True):
        assert (np.asarray(new.weight) != np.asarray(old.weight)).any()


def test_actions_are_drawn_from_the_policy():
    learner = agent(**SETTINGS["single"])
    here = jnp.asarray(batch(1).observation[0])
    state = begun(learner)
    act = jax.jit(jax.vmap(lambda k: learner.act(state, here, plain, jnp.int32(0), k)))
    share = np.bincount(np.asarray(act(jax.random.split(KEY, 8000))), minlength=ACTIONS) / 8000
    np.testing.assert_allclose(share, np.exp(np.asarray(learner.policy(state, here[None]))[0]), atol=0.02)


@pytest.mark.parametrize(
    "ensemble", [Ensemble("full", 1, 0.0), Ensemble("full", 3, 0.5), Ensemble("shared", 3)], ids=str
)
def test_a_fresh_policy_is_almost_uniform(ensemble: Ensemble):
    learner = agent(ensemble=ensemble)
    state = jax.jit(lambda key: learner.init(key, FEATURES, ACTIONS))(KEY)
    some = jnp.asarray(batch(1).observation)
    assert learner.values(state, some).shape == (ensemble.members, 4, ACTIONS)
    assert entropy(log_policy(learner.network, state.trained.actor, some)).min() > 0.95 * np.log(ACTIONS)
    jax.tree.map(np.testing.assert_array_equal, state.target, state.trained.critics)
    np.testing.assert_allclose(np.exp(state.trained.log_temperature), 0.3, rtol=1e-5)
    if ensemble == Ensemble("full", 3, 0.5):
        first = np.asarray(state.trained.critics[0].weight)
        drawn = [*first, np.asarray(state.trained.actor[0].weight)]
        assert all(abs(drawn[i] - drawn[j]).max() > 0.1 for i in range(4) for j in range(i))
        assert [layer.weight.shape[-1] for layer in state.prior] == [16, 9]


def test_the_temperature_stays_within_bounds():
    learner = agent(**SETTINGS["single"] | {"entropy": 0.0, "entropy_min": 0.0})
    low = begun(learner)._replace(trained=begun(learner).trained._replace(log_temperature=jnp.float32(-10.0)))
    after, _ = step(learner)(low, batch(1))
    assert after.trained.log_temperature == actor_critic.LOG_TEMPERATURES[0]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gamma", 1.0),
        ("entropy", 1.1),
        ("entropy_decay", -0.1),
        ("entropy_min", 2.0),
        ("temperature", 0.0),
        ("diversity", -1.0),
        ("tau", 0.0),
        ("batch", 0),
        ("buffer", 3),
        ("warmup", -1),
        ("bootstrap", 0.0),
    ],
)
def test_what_is_refused(field: str, value: Any):
    with pytest.raises(InvalidValueError, match=f"^{field} = "):
        SoftActorCritic(**{field: value})
