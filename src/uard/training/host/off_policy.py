"""SAC and its family in MuJoCo: a piece of the run is some steps, and as many updates in one call."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from uard.agents.continuous import Batch, ContinuousActorCritic
from uard.envs.locomotion.physics import Physics
from uard.method.mitigations import Evidence, as_column
from uard.training.episode_log import LOG
from uard.training.feedback import transition_model as transitions
from uard.training.host import loop as host
from uard.training.host.loop import Book, Fixed, Job, Live, Loop, Norm

PIECE = 32  # steps between calls of the compiled update
FIT_EVERY = 64  # pieces between fits of the model of ratings: 2048 steps


class Buffer(NamedTuple):
    """Transitions, on the device: (M, F) observations and what followed, (M, D) actions, (M,) reward and end."""

    observation: Any
    action: Any
    following: Any
    reward: Any
    terminated: Any


class Kept(NamedTuple):
    """What the loop keeps besides: the buffer, and what is usual of the ratings."""

    buffer: Buffer
    usual: Any


def bind(job: Job) -> Loop:
    """Return a run's loop; a piece is ``PIECE`` steps."""
    agent, spec = job.agent, job.spec
    width = transitions.width(spec.features, spec.actions)
    slots = min(agent.buffer, -(-job.steps // PIECE) * PIECE)
    fixed = job.fixed

    def start(physics: Physics) -> Live:
        model, reservoir = host.unheard(job)
        sizes = (spec.features,), (spec.actions,), (spec.features,), ()
        buffer = Buffer(*(jnp.zeros((slots, *size), jnp.float32) for size in sizes), terminated=jnp.zeros(slots, bool))
        return Live(
            agent=agent.init(host.key_of(job.seed, host.INIT), spec.features, spec.actions),
            norm=Norm.start(spec.features),
            model=model,
            reservoir=reservoir,
            extra=Kept(buffer, _usual(model, *_known(reservoir, width), job=fixed)),
            physics=physics.save(),
            sums=np.zeros((1, len(LOG))),
            log=np.zeros((0, len(LOG) + 1)),
            steps=np.int64(0),
        )

    def advance(live: Live, physics: Physics) -> Live:
        done = int(live.steps)
        number = done // PIECE
        random = host.generator(job.seed, host.ACT, number)
        keys = jax.random.split(host.key_of(job.seed, host.ACT, number), PIECE)
        book = Book(live.sums, done)
        here, actions, steps = [], [], []
        for t in range(PIECE):
            observation = physics.observe()
            if done + t < agent.warmup:
                action = random.uniform(-1.0, 1.0, (1, spec.actions))
            else:
                action = np.asarray(_act(live.agent, observation.astype(np.float32), keys, t, agent=agent))
            moved = physics.step(action)
            book.write(moved)
            here.append(observation)
            actions.append(action)
            steps.append(moved)
        reward = np.stack([m.reward for m in steps])
        row = Buffer(
            np.concatenate(here).astype(np.float32),
            np.concatenate(actions).astype(np.float32),
            np.concatenate([m.observation for m in steps]).astype(np.float32),
            reward[:, 0].astype(np.float32),
            np.concatenate([m.terminated for m in steps]),
        )
        model, usual = live.model, live.extra.usual
        if job.listens:
            told = transitions.features(row.observation, row.action, row.following, row.reward)
            host.record(job, live, steps, told[:, None], number)
            if number % FIT_EVERY == FIT_EVERY - 1:
                key = host.key_of(job.seed, host.MODEL, number + 1)
                model = transitions.fit(job.feedback, model, *live.reservoir[:2], live.reservoir.seen[0], key)
                usual = _usual(model, *_known(live.reservoir, width), job=fixed)
        learner, buffer, fine = _learn(
            live.agent,
            live.extra.buffer,
            row,
            np.int32(done),
            model,
            usual,
            host.key_of(job.seed, host.LEARN, number),
            job=fixed,
            learns=done + PIECE > agent.warmup,
        )
        if not fine:
            raise FloatingPointError("the agent's parameters or its values left the finite numbers")
        return live._replace(
            agent=learner,
            model=model,
            extra=Kept(buffer, usual),
            physics=physics.save(),
            sums=book.sums,
            log=book.all(live.log) if book.rows else live.log,
            steps=np.int64(book.steps),
        )

    def act(live: Live, observations: np.ndarray) -> np.ndarray:
        return np.asarray(_greedy(live.agent, observations.astype(np.float32), agent=agent))

    def values(live: Live, observations: np.ndarray) -> np.ndarray:
        return np.asarray(_values(live.agent, observations.astype(np.float32), agent=agent))

    return Loop(1, start, advance, act, values)


def _known(reservoir: Any, width: int) -> tuple[Any, Any]:
    return (reservoir.inputs, reservoir.seen[0]) if reservoir else (np.zeros((1, width), np.float32), np.int64(0))


@partial(jax.jit, static_argnames="agent")
def _act(state: Any, observation: Array, keys: Array, t: int, *, agent: ContinuousActorCritic) -> Array:
    return agent.act(state, observation, keys[t])


@partial(jax.jit, static_argnames="agent")
def _greedy(state: Any, observations: Array, *, agent: ContinuousActorCritic) -> Array:
    return agent.greedy(state, observations)


@partial(jax.jit, static_argnames="agent")
def _values(state: Any, observations: Array, *, agent: ContinuousActorCritic) -> Array:
    return agent.values(state, observations, agent.greedy(state, observations))


@partial(jax.jit, static_argnames="job")
def _usual(model: Any, kept: Array, seen: Array, *, job: Fixed) -> Any:
    return transitions.usual(job.mitigation, job.feedback, model, kept, seen, job.raters)


@partial(jax.jit, static_argnames=("job", "learns"), donate_argnums=(0, 1))
def _learn(
    state: Any,
    buffer: Buffer,
    row: Buffer,
    done: Array,
    model: Any,
    usual: Any,
    key: Array,
    *,
    job: Fixed,
    learns: bool,
) -> tuple[Any, Buffer, Array]:
    """Put a piece's transitions into the buffer, and take as many updates; also say whether all is finite."""
    agent, mitigation, model_spec, listens, raters, _ = job
    slots = buffer.reward.shape[0]
    count = row.reward.shape[0]
    buffer = jax.tree.map(lambda kept, new: lax.dynamic_update_slice_in_dim(kept, new, done % slots, 0), buffer, row)
    if not learns:
        return state, buffer, jnp.asarray(True)
    filled = jnp.minimum(done + count, slots)

    def one(state: Any, key: Array) -> tuple[Any, Array]:
        draw_key, mask_key, learn_key = jax.random.split(key, 3)
        places = jax.random.randint(draw_key, (agent.batch,), 0, filled)
        drawn = jax.tree.map(lambda x: x[places], buffer)
        if listens:
            told = transitions.features(drawn.observation, drawn.action, drawn.following, drawn.reward)
            feedback = transitions.read(model_spec, model, told, raters)
        else:
            feedback = transitions.nothing(agent.batch, raters)
        alone = as_column(feedback)

        expected = transitions.expecting(usual, feedback)

        def judge(sigma: Array) -> Any:
            return mitigation.signal(Evidence(drawn.reward, sigma, feedback), expected)

        def prefer(mu: Array, sigma: Array) -> Array:
            return mitigation.score(mu[:, None], sigma[:, None], alone, expected)[:, 0]

        mask = (jax.random.uniform(mask_key, (agent.batch, agent.members)) < agent.bootstrap).astype(jnp.float32)
        batch = Batch(drawn.observation, drawn.action, drawn.following, drawn.terminated, mask)
        state, watched = agent.update(state, batch, judge, prefer, learn_key)
        return state, watched.loss

    state, losses = lax.scan(one, state, jax.random.split(key, count))
    return state, buffer, jnp.isfinite(losses).all()
