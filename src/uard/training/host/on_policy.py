"""PPO, TRPO and CPO in MuJoCo: a piece of the run is one rollout and its update."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from uard.agents import heads, networks
from uard.agents.networks import Network
from uard.agents.policy import Experience, PolicyGradient
from uard.envs.locomotion.physics import Moved, Physics
from uard.method.mitigations import Evidence, as_column
from uard.training.compiled.common import all_finite
from uard.training.episode_log import LOG
from uard.training.feedback import transition_model as transitions
from uard.training.host import loop as host
from uard.training.host.loop import Book, Fixed, Job, Live, Loop, Norm


def bind(job: Job) -> Loop:
    """Return a run's loop; a piece is a rollout."""
    agent, spec = job.agent, job.spec
    copies, length = agent.envs, agent.rollout
    width = transitions.width(spec.features, spec.actions)

    def start(physics: Physics) -> Live:
        model, reservoir = host.unheard(job)
        return Live(
            agent=agent.init(host.key_of(job.seed, host.INIT), spec.features, spec.actions, continuous=True),
            norm=Norm.start(spec.features),
            model=model,
            reservoir=reservoir,
            extra=(),
            physics=physics.save(),
            sums=np.zeros((copies, len(LOG))),
            log=np.zeros((0, len(LOG) + 1)),
            steps=np.int64(0),
        )

    def advance(live: Live, physics: Physics) -> Live:
        number = int(live.steps) // (copies * length)
        keys = jax.random.split(host.key_of(job.seed, host.ACT, number), length)
        book = Book(live.sums, int(live.steps))
        here, actions, steps = [physics.observe()], [], []
        for t in range(length):
            action = np.asarray(_act(live.agent.policy, live.norm.of(here[-1]), keys, t, network=agent.network))
            moved = physics.step(np.clip(action, -1.0, 1.0))
            book.write(moved)
            steps.append(moved)
            actions.append(action)
            here.append(physics.observe())
        moved = Moved(*(np.stack(column) for column in zip(*steps, strict=True)))
        action = np.stack(actions)
        observation = live.norm.of(np.stack(here[:-1]))
        following = live.norm.of(moved.observation)
        # What raters see is what was done: actions within their bounds, in the units of the world.
        told = transitions.features(
            np.stack(here[:-1]), np.clip(action, -1.0, 1.0), moved.observation, moved.reward
        ).astype(np.float32)
        model, reservoir = live.model, live.reservoir
        if job.listens:
            host.record(job, live, steps, told, number)
            key = host.key_of(job.seed, host.MODEL, number + 1)
            model = transitions.fit(job.feedback, model, *reservoir[:2], reservoir.seen[0], key)
        learner, fine = _learn(
            live.agent,
            model,
            reservoir[0] if job.listens else np.zeros((1, width), np.float32),
            np.asarray(reservoir.seen[0] if job.listens else 0),
            observation,
            action,
            following,
            told,
            (moved.reward, moved.hack, moved.terminated, moved.truncated),
            host.key_of(job.seed, host.LEARN, number),
            job=job.fixed,
        )
        if not fine:
            raise FloatingPointError("the agent's parameters or its reward left the finite numbers")
        return Live(
            agent=learner,
            norm=live.norm.after(np.concatenate(here[:-1])),
            model=model,
            reservoir=reservoir,
            extra=(),
            physics=physics.save(),
            sums=book.sums,
            log=book.all(live.log),
            steps=np.int64(book.steps),
        )

    def act(live: Live, observations: np.ndarray) -> np.ndarray:
        return np.asarray(_likeliest(live.agent.policy, live.norm.of(observations), network=agent.network))

    def values(live: Live, observations: np.ndarray) -> np.ndarray:
        key = host.key_of(job.seed, host.EVALUATION)  # of dropout
        return np.asarray(_values(live.agent, live.norm.of(observations), key, agent=agent))

    return Loop(copies, start, advance, act, values)


@partial(jax.jit, static_argnames="network")
def _act(policy: Any, observations: Array, keys: Array, t: int, *, network: Network) -> Array:
    # The key is taken here: outside, that costs more than the policy.
    return heads.draw(heads.say(network, policy, observations), keys[t])


@partial(jax.jit, static_argnames="network")
def _likeliest(policy: Any, observations: Array, *, network: Network) -> Array:
    return heads.likeliest(heads.say(network, policy, observations))


@partial(jax.jit, static_argnames="agent")
def _values(state: Any, observations: Array, key: Array, *, agent: PolicyGradient) -> Array:
    return agent.values(state, observations, key)


@partial(jax.jit, static_argnames="job")
def _learn(
    state: Any,
    model: Any,
    kept: Array,
    seen: Array,
    observation: Array,
    action: Array,
    following: Array,
    told: Array,
    outcome: Any,
    key: Array,
    *,
    job: Fixed,
) -> tuple[Any, Array]:
    """Judge a rollout (T, E, ...) and learn from it; also say whether all is finite."""
    agent, mitigation, model_spec, listens, raters, horizon = job
    reward, hack, terminated, truncated = (jnp.asarray(x) for x in outcome)
    reward = reward.astype(jnp.float32)
    value_key, learn_key = jax.random.split(key)
    shape = reward.shape
    total = reward.size

    def flat(x: Array) -> Array:
        return x.reshape(total, *x.shape[2:])

    both = agent.values(state, jnp.concatenate([flat(observation), flat(following)]), value_key)
    values, after = both[:, :total], both[:, total:]
    ahead = jnp.where(flat(terminated), 0.0, agent.gamma * networks.mean_and_deviation(after)[1])
    usual = transitions.usual(mitigation, model_spec, model, kept, seen, raters)
    if listens:
        feedback = transitions.read(model_spec, model, flat(told), raters)
    else:
        feedback = transitions.nothing(total, raters)
    usual = transitions.expecting(usual, feedback)
    signal = mitigation.signal(Evidence(flat(reward), ahead, feedback), usual)
    alone = as_column(feedback)

    def prefer(q: Array) -> Array:
        return mitigation.score(q.reshape(total, 1), ahead[:, None], alone, usual).reshape(q.shape)

    learned = jnp.asarray(signal.reward, jnp.float32).reshape(shape)
    lived = Experience(
        observation=observation,
        action=action,
        following=following,
        reward=learned,
        weight=jnp.broadcast_to(jnp.asarray(signal.sample_weight, jnp.float32), (total,)).reshape(shape),
        cost=hack.astype(jnp.float32) if agent.needs_cost else jnp.zeros(shape, jnp.float32),
        terminated=terminated,
        done=terminated | truncated,
        values=values.reshape(-1, *shape),
        following_values=after.reshape(-1, *shape),
        horizon=jnp.asarray(horizon),
        prefer=prefer,
    )
    new, watched = agent.update(state, lived, learn_key)
    return new, all_finite((watched.loss, learned, new))
