"""The continuous actor-critic family on small cases that can be done by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from uard._checks import InvalidValueError, UnknownNameError
from uard.agents import continuous
from uard.agents.continuous import ContinuousActorCritic, Transitions, cql, edac, ensemble_sac, sac, sunrise
from uard.agents.heads import Normal
from uard.agents.networks import Ensemble, Network

SMALL = {"network": Network(16, 1e-2, 1.0), "batch": 32, "buffer": 64, "warmup": 32}
FAMILY = {"sac": sac, "cql": cql, "edac": edac, "sunrise": sunrise, "ensemble": ensemble_sac}


def batch_of(rows=32, features=3, motors=2, members=2, seed=0):
    r = np.random.default_rng(seed)
    put = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Transitions(
        put(r.normal(size=(rows, features))),
        put(r.uniform(-1, 1, (rows, motors))),
        put(r.normal(size=(rows, features))),
        jnp.asarray(r.random(rows) < 0.5),
        jnp.ones((rows, members), jnp.float32),
    )


def plain(reward):
    """A reward function that has no doubts."""
    return lambda sigma: (reward, 1.0)


def own(mu, sigma):
    """A score function that changes nothing."""
    return mu


def test_density_of_a_squashed_normal_is_the_change_of_variables_and_integrates_to_one():
    distribution = Normal(jnp.array([[0.4]]), jnp.log(jnp.array([[0.7]])))
    for seed in range(5):
        action, log_density = continuous.draw(distribution, jax.random.key(seed))
        x = np.arctanh(float(action[0, 0]))
        expected = stats.norm(0.4, 0.7).logpdf(x) - math.log(1 - float(action[0, 0]) ** 2)
        assert float(log_density[0]) == pytest.approx(expected, abs=1e-4)
    total, _ = integrate.quad(lambda a: stats.norm(0.4, 0.7).pdf(np.arctanh(a)) / (1 - a * a), -1, 1)
    assert total == pytest.approx(1.0, abs=1e-6)


def test_density_is_finite_far_out():
    action, log_density = continuous.draw(Normal(jnp.array([[30.0, -30.0]]), jnp.zeros((1, 2))), jax.random.key(0))
    assert np.isfinite(log_density).all()
    assert (np.abs(action) <= 1).all()


@pytest.mark.parametrize("name", FAMILY)
def test_critics_learn_a_known_reward_and_nothing_becomes_nan(name):
    agent = FAMILY[name](gamma=0.0, **SMALL)
    batch = batch_of(members=agent.members)
    reward = batch.observation[:, 0] - batch.action[:, 1]
    state = agent.init(jax.random.key(0), 3, 2)
    update = jax.jit(lambda s, k: agent.update(s, batch, plain(reward), own, k))

    def error(s):
        return float(jnp.abs(agent.values(s, batch.observation, batch.action) - reward).mean())

    before = error(state)
    for i in range(300):
        state, info = update(state, jax.random.key(i))
        assert np.isfinite(info.loss)
    assert error(state) < (0.7 if name in ("cql", "edac") else 0.2) * before  # the other two have further terms


def test_the_actor_climbs_the_critics_to_the_best_action():
    agent = sac(gamma=0.0, temperature=1e-3, entropy=-4.0, **SMALL)
    r = np.random.default_rng(1)
    rows = 256
    action = jnp.asarray(r.uniform(-1, 1, (rows, 1)), jnp.float32)
    blank = jnp.zeros((rows, 2), jnp.float32)
    batch = Transitions(blank, action, blank, jnp.ones(rows, bool), jnp.ones((rows, 2), jnp.float32))
    reward = -((action[:, 0] - 0.5) ** 2)
    state = agent.init(jax.random.key(0), 2, 1)
    update = jax.jit(lambda s, k: agent.update(s, batch, plain(reward), own, k)[0])
    for i in range(600):
        state = update(state, jax.random.key(i))
    assert float(agent.greedy(state, blank[:1])[0, 0]) == pytest.approx(0.5, abs=0.1)


def test_an_actor_that_climbs_a_score_of_sigma_survives_critics_that_agree_to_the_bit():
    agent = sac(**SMALL)
    state = agent.init(jax.random.key(0), 3, 2)
    alike = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), state.trained.critics)
    state = state._replace(trained=state.trained._replace(critics=alike), target=alike)
    batch, key = batch_of(), jax.random.key(0)
    new, info = jax.jit(lambda s: agent.update(s, batch, plain(jnp.ones(32)), lambda mu, s: mu - s, key))(state)
    assert np.isfinite(info.loss)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(new.trained))


def test_an_end_has_no_future_and_a_step_of_weight_zero_teaches_nothing():
    agent = sac(**SMALL)
    batch = batch_of()
    state = agent.init(jax.random.key(0), 3, 2)
    far = batch._replace(next_observation=batch.next_observation + 100.0)
    ended = jnp.ones_like(batch.terminated)
    update = jax.jit(lambda b, w: agent.update(state, b, lambda _: (jnp.ones(32), w), own, jax.random.key(0))[0])
    a, b = (update(rows._replace(terminated=ended), jnp.ones(32)) for rows in (batch, far))
    for x, y in zip(jax.tree.leaves(a.trained.critics), jax.tree.leaves(b.trained.critics), strict=True):
        np.testing.assert_array_equal(x, y)
    still = update(batch, jnp.zeros(32))
    for x, y in zip(jax.tree.leaves(still.trained.critics), jax.tree.leaves(state.trained.critics), strict=True):
        np.testing.assert_array_equal(x, y)


def test_cql_lowers_values_of_actions_that_were_not_taken():
    gaps = {}
    batch = batch_of(rows=128)._replace(action=jnp.full((128, 2), 0.9))
    elsewhere = jnp.full((128, 2), -0.9)
    for alpha in (0.0, 5.0):
        agent = cql(alpha, gamma=0.0, **SMALL)
        state = agent.init(jax.random.key(0), 3, 2)
        update = jax.jit(lambda s, k, agent=agent: agent.update(s, batch, plain(jnp.zeros(128)), own, k)[0])
        for i in range(200):
            state = update(state, jax.random.key(i))
        taken, not_taken = (agent.values(state, batch.observation, a).mean() for a in (batch.action, elsewhere))
        gaps[alpha] = float(taken - not_taken)
    assert gaps[5.0] > gaps[0.0] + 1.0


def test_edac_makes_gradients_less_alike():
    from uard.agents.actor_critic import gradient_similarity

    alike = {}
    for diversity in (0.0, 10.0):
        agent = edac(3, diversity, gamma=0.0, **SMALL)
        batch = batch_of(members=3)
        state = agent.init(jax.random.key(0), 3, 2)
        update = jax.jit(
            lambda s, k, agent=agent, batch=batch: agent.update(s, batch, plain(batch.action.sum(1)), own, k)[0]
        )
        for i in range(200):
            state = update(state, jax.random.key(i))
        slope = jax.vmap(
            lambda n, state=state, agent=agent, batch=batch: jax.grad(
                lambda a: agent.values(state, batch.observation, a)[n].sum()
            )(batch.action)
        )(jnp.arange(3))
        alike[diversity] = float(gradient_similarity(slope))
    assert alike[10.0] < alike[0.0] - 0.5


def test_sunrise_takes_the_action_with_the_best_mean_plus_deviation():
    agent = sunrise(**SMALL)
    state = agent.init(jax.random.key(0), 3, 2)
    observation = jnp.ones((4, 3))
    action = agent.act(state, observation, jax.random.key(1))
    assert action.shape == (4, 2)
    distribution = continuous.action_distribution(agent.network, state.trained.actor, observation)
    keys = jax.random.split(jax.random.key(1), continuous.UCB_ACTIONS)
    offered = jax.vmap(lambda k: continuous.draw(distribution, k)[0])(keys)
    values = jnp.stack([agent.values(state, observation, a) for a in offered], 1)
    score = values.mean(0) + values.std(0, ddof=1)
    for i in range(4):
        np.testing.assert_allclose(action[i], offered[int(score[:, i].argmax()), i], rtol=1e-6)


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        ({"gamma": 1.0}, "gamma"),
        ({"tau": 0.0}, "tau"),
        ({"batch": 512, "buffer": 256}, "buffer"),
        ({"warmup": 1}, "warmup"),
        ({"conservative": -1.0}, "conservative"),
        ({"ensemble": Ensemble("full", 1)}, "ensemble.members"),
        ({"ensemble": Ensemble("dropout", 5)}, "ensemble.kind"),
    ],
)
def test_bad_parameters_name_the_field(bad, says):
    with pytest.raises((InvalidValueError, UnknownNameError), match=says):
        ContinuousActorCritic(**bad)
