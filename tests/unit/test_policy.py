"""PPO, TRPO and CPO in their parts, and the loop that trains them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import torch
from gymnasium import spaces
from jax.flatten_util import ravel_pytree
from stable_baselines3.common.buffers import RolloutBuffer

from uard._checks import InvalidValueError
from uard.agents import networks, policy
from uard.agents.networks import Ensemble, Network
from uard.agents.off_policy import UpdateInfo
from uard.agents.policy import CPO, PPO, TRPO, Batch, Experience
from uard.envs.tables import HiddenTruth, Task
from uard.envs.world import TableWorld
from uard.method.mitigations import Evidence, named
from uard.ratings.panels import RatingLaw
from uard.training.compiled import common, on_policy
from uard.training.compiled.common import Program
from uard.training.episode_log import LOG
from uard.training.tracing import traceable

FEATURES, ACTIONS, BATCH = 5, 3, 64
SMALL = Network(hidden=8)

# Agents are arguments, so that those that differ in numbers only share a program.
improved = jax.jit(lambda agent, *arguments: agent.improved(*arguments))
constrained = jax.jit(lambda agent, *arguments: agent.constrained(*arguments))
constrained_step = jax.jit(policy.constrained_step)
train = jax.jit(on_policy.train_one, static_argnums=1)


def numbers(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


# --- generalised advantage estimate ---------------------------------------------------------------------------------


def test_gae_by_hand():
    reward, values, next_values = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, 1.0, 1.5]), jnp.array([1.0, 7.0, 2.0])
    terminated, done = jnp.array([False, False, True]), jnp.array([False, True, True])
    got = policy.gae(reward, values, next_values, terminated, done, 0.9, 0.8)
    # The second step is cut off: the value after the cut counts, what comes later does not.
    last, cut = 3 - 1.5, 2 + 0.9 * 7 - 1.0
    first = (1 + 0.9 * 1 - 0.5) + 0.9 * 0.8 * cut
    np.testing.assert_allclose(got, [first, cut, last], rtol=1e-6)


@pytest.mark.parametrize("lam", [0.0, 0.95, 1.0])
def test_gae_agrees_with_stable_baselines(lam):
    rng = numbers(1)
    length, copies, gamma = 40, 3, 0.97
    reward, value, final = rng.normal(size=(3, length, copies)).astype(np.float32)
    last = rng.normal(size=copies).astype(np.float32)
    done = rng.random((length, copies)) < 0.2
    cut = done & (rng.random(done.shape) < 0.5)
    next_values = np.where(done, final, np.concatenate([value[1:], last[None]]))

    space = spaces.Box(-1, 1, (1,))
    theirs = RolloutBuffer(length, space, space, "cpu", lam, gamma, copies)
    for t in range(length):
        start = done[t - 1] if t else np.ones(copies, bool)
        bootstrapped = reward[t] + gamma * np.where(cut[t], final[t], 0.0)  # as OnPolicyAlgorithm.collect_rollouts does
        zero = np.zeros((copies, 1), np.float32)
        theirs.add(zero, zero, bootstrapped, start, torch.tensor(value[t]), torch.zeros(copies))
    theirs.compute_returns_and_advantage(torch.tensor(last), done[-1])

    ours = policy.gae(*map(jnp.asarray, (reward, value, next_values, done & ~cut, done)), gamma, lam)
    np.testing.assert_allclose(ours, theirs.advantages, rtol=1e-4, atol=1e-5)


def test_standardised_ignores_what_has_no_weight():
    advantage, weight = jnp.array([1.0, 3.0, 1000.0]), jnp.array([1.0, 1.0, 0.0])
    np.testing.assert_allclose(policy.standardised(advantage, weight)[:2], [-1, 1], rtol=1e-5)
    assert np.isfinite(policy.standardised(advantage, 0.0 * weight)).all()


# --- PPO ------------------------------------------------------------------------------------------------------------


def test_clipped_surrogate_by_hand():
    ratio = jnp.array([1.0, 1.5, 1.5, 0.5, 0.5, 1.1])
    advantage = jnp.array([2.0, 2.0, -2.0, 2.0, -2.0, -1.0])
    expected = [2.0, 1.2 * 2, 1.5 * -2, 0.5 * 2, 0.8 * -2, -1.1]
    np.testing.assert_allclose(policy.clipped_surrogate(jnp.log(ratio), advantage, 0.2), expected, rtol=1e-6)
    slope = jax.vmap(jax.grad(lambda x, a: policy.clipped_surrogate(x, a, 0.2)))(jnp.log(ratio), advantage)
    # Gradients vanish just where a step has already moved too far in the direction of its advantage.
    np.testing.assert_array_equal(np.asarray(slope) == 0, [False, True, False, False, True, False])


def test_probabilities_by_hand():
    logits = jnp.log(jnp.array([[0.2, 0.3, 0.5], [1.0, 1.0, 2.0]]))
    action = jnp.array([2, 0])
    np.testing.assert_allclose(policy.log_probability(logits, action), np.log([0.5, 0.25]), rtol=1e-6)
    p = np.array([[0.2, 0.3, 0.5], [0.25, 0.25, 0.5]])
    np.testing.assert_allclose(policy.entropy(logits), -(p * np.log(p)).sum(1), rtol=1e-6)
    kl = (p[0] * np.log(p[0] / p[1])).sum()
    np.testing.assert_allclose(policy.divergence(logits[:1], logits[1:]), kl, rtol=1e-5)


def experience(seed: int, agent: Any, state: Any, **changes: Any) -> Experience:
    rng = numbers(seed)
    shape = (8, 8)
    observation, next_observation = rng.normal(size=(2, *shape, FEATURES)).astype(np.float32)
    done = rng.random(shape) < 0.1
    key = jax.random.key(seed)
    values = jax.vmap(lambda o: agent.values(state, o, key), out_axes=1)
    one = Experience(
        jnp.asarray(observation),
        jnp.asarray(rng.integers(ACTIONS, size=shape), jnp.int32),
        jnp.asarray(next_observation),
        jnp.asarray(rng.normal(size=shape), jnp.float32),
        jnp.ones(shape, jnp.float32),
        jnp.asarray(rng.random(shape) < 0.3, jnp.float32),
        jnp.asarray(done),
        jnp.asarray(done),
        values(jnp.asarray(observation)),
        values(jnp.asarray(next_observation)),
        jnp.int32(10),
        lambda q: q,
    )
    return one._replace(**changes)


@pytest.mark.parametrize(
    ("make", "kind"), [(PPO, "shared"), (PPO, "full"), (PPO, "dropout"), (TRPO, "dropout"), (CPO, "shared")]
)
def test_an_update_moves_policy_and_critic(make, kind):
    agent = make(network=SMALL, ensemble=Ensemble(kind, 3))
    state = agent.init(jax.random.key(0), FEATURES, ACTIONS)
    after, info = jax.jit(lambda s, k: agent.update(s, experience(0, agent, s), k))(state, jax.random.key(1))
    assert isinstance(info, UpdateInfo)
    assert np.isfinite(info.loss)
    assert info.largest > 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after[:2]))
    for old, new in ((state.policy, after.policy), (state.value.layers, after.value.layers)):
        assert not np.allclose(ravel_pytree(old)[0], ravel_pytree(new)[0])
    assert jax.tree.structure(state) == jax.tree.structure(after)


@pytest.mark.parametrize("make", [PPO, TRPO])
def test_skipped_steps_change_nothing_but_the_shuffle(make):
    agent = make(network=SMALL, minibatches=1)
    state = agent.init(jax.random.key(0), FEATURES, ACTIONS)
    one = experience(0, agent, state)
    # The last row of a rollout touches no other step's advantage if it begins an episode.
    done = one.done.at[-2].set(True)
    weight = one.weight.at[-1].set(0.0)
    one = one._replace(done=done, terminated=done, weight=weight)
    other = one._replace(reward=one.reward.at[-1].add(50.0), action=one.action.at[-1].set(0))

    @jax.jit
    def updated(e):
        return agent.update(state, e._replace(score_fn=lambda q: q), jax.random.key(1))[0]

    a, b = (updated(e._replace(score_fn=None)) for e in (one, other))
    # TRPO's line search and PPO's minibatches average over all steps, and skipped ones contribute nothing.
    np.testing.assert_allclose(ravel_pytree(a.policy)[0], ravel_pytree(b.policy)[0], atol=1e-5)
    np.testing.assert_allclose(ravel_pytree(a.value)[0], ravel_pytree(b.value)[0], atol=1e-5)


def test_the_score_of_q_less_v_is_climbed():
    agent = PPO(network=SMALL)
    state = agent.init(jax.random.key(0), FEATURES, ACTIONS)
    plain, halved = experience(0, agent, state), experience(0, agent, state, score_fn=lambda q: 0.5 * q)
    a, b = agent._batch(plain), agent._batch(halved)
    v = np.asarray(plain.values.mean(0)).reshape(-1)
    q = np.asarray(a.target.mean(0))
    np.testing.assert_array_equal(a.target, b.target)
    for batch, climbed in ((a, q - v), (b, 0.5 * q - v)):
        np.testing.assert_allclose(batch.advantage, (climbed - climbed.mean()) / climbed.std(), rtol=1e-4, atol=1e-5)


# --- TRPO -----------------------------------------------------------------------------------------------------------


def random_batch(seed: int) -> Batch:
    rng = numbers(seed)
    f = partial(jnp.asarray, dtype=jnp.float32)
    return Batch(
        f(rng.normal(size=(BATCH, FEATURES))),
        jnp.asarray(rng.integers(ACTIONS, size=BATCH), jnp.int32),
        f(rng.normal(size=BATCH)),
        f(rng.normal(size=(5, BATCH))),
        f(rng.random(BATCH)),
    )


def sharp_policy(seed: int, gain: float) -> Any:
    return networks.mlp(jax.random.key(seed), (FEATURES, 8, 8, ACTIONS), last_gain=gain)


def logits(layers: Any, batch: Batch) -> Any:
    return networks.through(layers, batch.observation)


@pytest.mark.parametrize("gain", [0.01, 1.0, 5.0])
@pytest.mark.parametrize("delta", [0.01, 0.1])
def test_trpo_stays_within_the_trust_region_and_improves(gain, delta):
    agent = traceable(TRPO(network=SMALL, delta=delta))
    moved = 0
    for seed in range(10):
        batch, old = random_batch(seed), sharp_policy(seed, gain)
        new = improved(agent, old, batch)
        before, after = logits(old, batch), logits(new, batch)
        assert policy.divergence(before, after) <= delta * (1 + 1e-5)
        better = policy.surrogate(after, before, batch.action, batch.weight * batch.advantage)
        worse = policy.surrogate(before, before, batch.action, batch.weight * batch.advantage)
        assert better >= worse
        moved += bool(better > worse)
    assert moved >= 9


def test_fisher_product_is_the_fisher_matrix():
    batch, layers = random_batch(0), networks.mlp(jax.random.key(0), (FEATURES, 4, ACTIONS))
    theta, shape = ravel_pytree(layers)

    def logits_of(theta):
        return logits(shape(theta), batch)

    # By its definition: the mean, over states and the policy's own actions, of the score's outer product.
    p = np.asarray(jax.nn.softmax(logits_of(theta)), np.float64)
    score = np.asarray(jax.jit(jax.jacobian(lambda t: jax.nn.log_softmax(logits_of(t))))(theta), np.float64)
    fisher = np.einsum("ba,bai,baj->ij", p, score, score) / BATCH
    product = policy.fisher_product(logits_of, theta, 0.1)
    got = jax.jit(jax.vmap(product))(jnp.eye(theta.size))
    np.testing.assert_allclose(got, fisher + 0.1 * np.eye(theta.size), atol=2e-6)
    # And it is the curvature of the divergence.
    curvature = jax.jit(jax.hessian(lambda t: policy.divergence(logits_of(theta), logits_of(t))))(theta)
    np.testing.assert_allclose(curvature, fisher, atol=1e-5)


@pytest.mark.parametrize("size", [1, 5, 20])
def test_conjugate_gradient_solves(size):
    rng = numbers(size)
    root = rng.normal(size=(size, size))
    matrix = root @ root.T / size + np.eye(size)
    b = rng.normal(size=size)
    product = lambda v: jnp.asarray(matrix, jnp.float32) @ v  # noqa: E731
    got = policy.conjugate_gradient(product, jnp.asarray(b, jnp.float32), 3 * size)
    np.testing.assert_allclose(got, np.linalg.solve(matrix, b), rtol=1e-3, atol=1e-4)
    assert (policy.conjugate_gradient(product, jnp.zeros(size), 10) == 0).all()


def test_line_search_takes_the_first_step_that_is_accepted():
    theta, step = jnp.array([1.0]), jnp.array([8.0])
    np.testing.assert_allclose(policy.line_search(theta, step, lambda t: t[0] < 4, 10, 0.5), 3.0)
    np.testing.assert_allclose(policy.line_search(theta, step, lambda t: t[0] < 100, 10, 0.5), 9.0)
    np.testing.assert_allclose(policy.line_search(theta, step, lambda t: t[0] < 1, 10, 0.5), 1.0)


# --- CPO ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(40))
def test_constrained_step_is_the_optimum(seed):
    rng = numbers(seed)
    size, delta = 4, 0.02
    root = rng.normal(size=(size, size))
    metric = root @ root.T + 0.5 * np.eye(size)
    g, b = rng.normal(size=(2, size))
    to_gain, to_price = np.linalg.solve(metric, np.stack([g, b], 1)).T
    q, r, s = g @ to_gain, g @ to_price, b @ to_price
    reach = np.sqrt(2 * delta * s)  # how far b'x goes in the trust region
    excess = reach * rng.uniform(-1.5, 1.5)
    args = [jnp.float32(x) for x in (q, r, s, excess, delta)]
    along, against, feasible = constrained_step(*args)
    x = float(along) * to_gain - float(against) * to_price
    assert x @ metric @ x <= 2 * delta * (1 + 1e-4)
    assert bool(feasible) == (excess <= reach)
    if not feasible:
        assert b @ x == pytest.approx(-reach, rel=1e-4)
        return
    assert b @ x + excess <= 1e-4
    conditions = [
        {"type": "ineq", "fun": lambda y: -(b @ y + excess), "jac": lambda y: -b},
        {"type": "ineq", "fun": lambda y: 2 * delta - y @ metric @ y, "jac": lambda y: -2 * metric @ y},
    ]
    start = -to_price * max(excess, 0) / s
    best = scipy.optimize.minimize(lambda y: -g @ y, start, jac=lambda y: -g, constraints=conditions, method="SLSQP")
    assert g @ x == pytest.approx(-best.fun, rel=1e-3, abs=1e-4)


def test_without_a_cost_cpo_is_trpo():
    batch, old = random_batch(3), sharp_policy(3, 1.0)
    free = constrained(traceable(CPO(network=SMALL)), old, batch, jnp.zeros(BATCH), jnp.float32(-0.01))
    plain = improved(traceable(TRPO(network=SMALL)), old, batch)
    np.testing.assert_allclose(ravel_pytree(free)[0], ravel_pytree(plain)[0], atol=2e-5)


@pytest.mark.parametrize("excess", [-0.02, 0.0, 0.001, 0.5])
def test_cpo_keeps_region_and_budget(excess):
    agent = traceable(CPO(network=SMALL))
    for seed in range(10):
        batch, old = random_batch(seed), sharp_policy(seed, 1.0)
        cost = jnp.asarray(numbers(seed + 100).normal(size=BATCH), jnp.float32)
        new = constrained(agent, old, batch, cost, jnp.float32(excess))
        before, after = logits(old, batch), logits(new, batch)
        assert policy.divergence(before, after) <= agent.delta * (1 + 1e-5)
        change = policy.surrogate(after, before, batch.action, cost) - policy.surrogate(
            before, before, batch.action, cost
        )
        assert change <= max(-excess, 0) + 1e-6
        if excess == 0.5:  # nothing in the region is within the budget
            assert change < -0.01


@pytest.mark.parametrize(
    ("make", "field", "value"),
    [
        (PPO, "gamma", 1.0),
        (PPO, "gae_lambda", 1.1),
        (PPO, "envs", 0),
        (PPO, "rollout", 0),
        (PPO, "epochs", 0),
        (PPO, "minibatches", 257),
        (PPO, "max_grad_norm", 0),
        (PPO, "count_bonus", -1),
        (PPO, "clip", 0),
        (PPO, "entropy", -1),
        (TRPO, "delta", 0),
        (TRPO, "damping", 0),
        (TRPO, "conjugate_steps", 0),
        (TRPO, "backtracks", 0),
        (TRPO, "shrink", 1.0),
        (CPO, "limit", -0.1),
    ],
)
def test_wrong_parameters_are_named(make, field, value):
    with pytest.raises(InvalidValueError, match=field):
        make(**{field: value})


# --- the loop -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Spy(PPO):
    """Walks on until its copy's own length is reached, learns nothing and keeps the experience that it was given."""

    def init(self, key, features, actions, continuous=False):
        pair = (self.rollout, self.envs)
        experience = {
            "observation": jnp.zeros(pair, jnp.int32),
            "next_observation": jnp.zeros(pair, jnp.int32),
            "reward": jnp.zeros(pair),
            "weight": jnp.zeros(pair),
            "cost": jnp.zeros(pair),
            "terminated": jnp.zeros(pair, bool),
            "done": jnp.zeros(pair, bool),
            "scores": jnp.zeros(pair),
        }
        return policy.State((), (), (), (), experience)  # type: ignore[arg-type]

    def greedy(self, state, observation):
        return jnp.int32(1)

    def values(self, state, observations, key):
        return jnp.zeros((1, observations.shape[0]))

    def act(self, state, observations, key):
        return (observations >= jnp.arange(self.envs)).astype(jnp.int32)

    def update(self, state, experience, key):
        kept = {name: getattr(experience, name) for name in state.costs if name != "scores"}
        kept["scores"] = experience.score_fn(jnp.ones_like(experience.reward))
        return state._replace(costs=kept), UpdateInfo(jnp.float32(0), jnp.float32(0))


@dataclass(frozen=True)
class Oracle(Spy):
    @property
    def needs_cost(self):
        return True


def corridor(horizon: int) -> TableWorld:
    """Cells 0..3; action 0 walks on (the last cell stays), 1 ends, paying the cell's number; ending at 1 is a hack."""
    cells = np.arange(4)
    next_state = np.stack([np.minimum(cells + 1, 3), cells], 1).astype(np.int32)
    reward = np.stack([0.1 * cells - 1.0, cells], 1).astype(np.float32)
    terminal = np.zeros((4, 2), bool)
    terminal[:, 1] = True
    hack = np.zeros((4, 2), bool)
    hack[1, 1] = True
    law = RatingLaw(np.stack([reward, reward - hack, reward], -1), np.zeros((4, 2, 3), np.float32))
    return TableWorld(
        Task(next_state, reward, terminal, np.int32(0), np.int32(horizon)),
        HiddenTruth(reward, hack, hack),
        law,
    )


def run_of(agent: Any, world: Any, mitigation: str = "raw", seed: int = 0) -> common.Run:
    return jax.tree.map(jnp.asarray, common.make_run(world, agent, named(mitigation), seed))


def trained(agent: Any, world: Any, program: Program, mitigation: str = "raw") -> common.TrainedAgent:
    return train(run_of(agent, world, mitigation), program)


TALL, COPIES = 4, 3
SPY = {"network": SMALL, "envs": COPIES, "rollout": TALL, "minibatches": 1}


def test_episodes_are_logged_in_the_order_of_their_ends():
    out = trained(Spy(**SPY), corridor(50), Program(episodes=17))
    ended = [(t, e + 1) for t in range(1, 100) for e in range(COPIES) if t % (e + 1) == 0]
    lengths = [length for _, length in ended[:17]]
    log = np.asarray(out.log)
    np.testing.assert_array_equal(log[:, LOG.index("length")], lengths)
    np.testing.assert_array_equal(log[:, LOG.index("hacks")], [n == 2 for n in lengths])
    np.testing.assert_allclose(
        log[:, LOG.index("observed_return")], [(0, -1 + 1, -1 - 0.9 + 2)[n - 1] for n in lengths], atol=1e-6
    )
    assert out.episodes == 17
    # In whole rollouts: that of step 12 brings the 17 full.
    assert out.steps == -(-ended[16][0] // TALL) * TALL * COPIES


def test_steps_end_the_run_and_leave_empty_rows():
    out = trained(Spy(**SPY), corridor(50), Program(episodes=100, steps=20))
    assert out.steps == 24
    assert out.episodes == 8 + 4 + 2
    assert (np.asarray(out.log)[14:] == 0).all()
    assert (np.asarray(out.log)[:14, 4] > 0).all()


def test_a_cut_shows_the_state_after_it_and_does_not_terminate():
    out = trained(Spy(**{**SPY, "envs": 5}), corridor(3), Program(episodes=1000, steps=20))
    given = jax.tree.map(np.asarray, out.good.costs)
    walked = given["observation"], given["next_observation"]
    # The last copy never ends its episode: it is cut after its third step, in cell 3, and starts again in 0.
    np.testing.assert_array_equal(walked[0][:, 4], [0, 1, 2, 0])
    np.testing.assert_array_equal(walked[1][:, 4], [1, 2, 3, 1])
    np.testing.assert_array_equal(given["done"][:, 4], [False, False, True, False])
    assert not given["terminated"][:, 4].any()
    np.testing.assert_array_equal(given["terminated"][:, 0], [True] * 4)


def test_the_count_bonus_is_added_after_the_mitigation():
    plain, curious = (trained(Spy(**SPY, count_bonus=b), corridor(50), Program(100, 20)) for b in (0.0, 0.5))
    given = jax.tree.map(np.asarray, (plain.good.costs, curious.good.costs))
    cells = given[0]["observation"]
    ends = given[0]["terminated"]
    np.testing.assert_allclose(given[0]["reward"], np.where(ends, cells, 0.1 * cells - 1), atol=1e-6)
    # Of 8 times: copy 0 ended in cell 0 each time, copy 1 every second time in 1, copy 2 twice in cell 2.
    visits = {(0, True): 8, (0, False): 4 + 3, (1, True): 4, (1, False): 3, (2, True): 2}
    expected = [[0.5 / visits[c, e] ** 0.5 for c, e in zip(*row, strict=True)] for row in zip(cells, ends, strict=True)]
    np.testing.assert_allclose(given[1]["reward"] - given[0]["reward"], expected, atol=1e-6)


def test_only_an_oracle_is_shown_hacks():
    blind, seeing = (trained(make(**SPY), corridor(50), Program(100, 20)).good.costs for make in (Spy, Oracle))
    assert (np.asarray(blind["cost"]) == 0).all()
    hacks = np.asarray(seeing["terminated"]) & (np.asarray(seeing["observation"]) == 1)
    assert hacks.any()
    np.testing.assert_array_equal(seeing["cost"], hacks)
    assert CPO().needs_cost
    assert not CPO(oracle=False).needs_cost
    assert not PPO().needs_cost
    assert not TRPO().needs_cost


@pytest.mark.parametrize("name", ["uard-0.1", "screening", "uard-paper"])
def test_the_mitigation_filters_the_whole_rollout(name):
    out = trained(Spy(**SPY, count_bonus=0.0), corridor(50), Program(100, 48), name)
    given = jax.tree.map(np.asarray, out.good.costs)
    mitigation = named(name)
    world = corridor(50)
    cells, ends = given["observation"], given["terminated"].astype(int)
    feedback = jax.tree.map(np.asarray, out.feedback)
    here = feedback.map(lambda x: x[cells, ends])
    every = feedback.map(lambda x: x.reshape(-1, *x.shape[2:]))
    statistics = mitigation.fit(every, every.count > 0)
    zero = np.zeros(cells.shape, np.float32)
    signal = mitigation.signal(Evidence(world.task.reward[cells, ends], zero, here), statistics)
    np.testing.assert_allclose(given["reward"], signal.reward, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(given["weight"], np.broadcast_to(signal.sample_weight, cells.shape), atol=1e-6)
    alone = here.map(lambda x: x[:, :, None])
    scores = mitigation.score(np.ones((*cells.shape, 1), np.float32), zero[..., None], alone, statistics)[..., 0]
    np.testing.assert_allclose(given["scores"], scores, rtol=1e-4, atol=1e-5)
    assert feedback.count.sum() == 48
    np.testing.assert_array_equal(feedback.by_rater.count.sum((0, 1)), [48, 48, 48])
    np.testing.assert_array_equal(feedback.raters, 3 * (feedback.count > 0))


def test_cpo_side_by_side_steps_as_alone():
    agent = traceable(CPO(network=SMALL))
    excess = jnp.array([-0.02, 0.0, 0.5], jnp.float32)
    cases = [
        (sharp_policy(i, 1.0), random_batch(i), jnp.sin(jnp.arange(BATCH, dtype=jnp.float32) + i)) for i in range(3)
    ]
    both = jax.jit(jax.vmap(agent.constrained))(*jax.tree.map(lambda *x: jnp.stack(x), *cases), excess)
    for i, case in enumerate(cases):
        alone = constrained(agent, *case, excess[i])
        for a, b in zip(jax.tree.leaves(both), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-3, atol=1e-4)


TINY = PPO(network=SMALL, envs=4, rollout=16)
SHORT = Program(episodes=40, steps=1024, walk=8)


def test_a_seed_gives_one_run_alone_or_side_by_side():
    runs = [run_of(TINY, corridor(10), "uard-0.1", seed) for seed in (3, 4)]
    first, again, other = (train(run, SHORT) for run in (runs[0], runs[0], runs[1]))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first.log, other.log)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *runs)
    both = jax.jit(jax.vmap(lambda run: on_policy.train_one(run, SHORT)))(stacked)
    for i, one in enumerate((first, other)):
        np.testing.assert_array_equal(both.log[i], one.log)
        np.testing.assert_array_equal(both.steps[i], one.steps)
        for a, b in zip(jax.tree.leaves(both.good), jax.tree.leaves(one.good), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=2e-3, atol=2e-4)


def test_a_reward_beyond_all_measure_is_caught():
    world = corridor(10)
    world = replace(world, task=world.task._replace(reward=world.task.reward * np.float32(1e38)))
    out = trained(TINY, world, SHORT, "uard-0.1")
    assert common.QUANTITIES[int(out.fault)] != "nothing"
    assert out.episodes < 40
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(out.good) if np.asarray(x).dtype.kind == "f")


def test_values_are_read_for_all_actions():
    out = trained(TINY, corridor(10), SHORT, "uard-0.1")
    mean, deviation, lowest = (np.asarray(x) for x in out.values)
    assert mean.shape == (4, 2)
    assert (deviation > 0).all()
    assert (lowest < mean).all()
    for x in (mean, deviation, lowest):
        np.testing.assert_array_equal(x[:, 0], x[:, 1])
