"""Training of agents that learn from a replay buffer, as one compiled program."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from uard.agents.networks import mean_and_deviation
from uard.agents.off_policy import Batch, OffPolicy, Watched
from uard.method.mitigations import Evidence
from uard.training.compiled import common as deep
from uard.training.compiled.common import CHUNK, FeedbackSource, Lane, Outcome, Program
from uard.training.episode_log import LOG


class _Carry(NamedTuple):
    agent: Any
    buffer: Any
    known: Any
    model: Any
    usual: Any
    state: Any
    time: Array
    episode: Array
    sums: Array
    log: Array
    steps: Array
    loss: Array
    largest: Array


class _Row(NamedTuple):
    """One transition, as kept: compact states, from which observations are made when it is drawn."""

    state: Any
    action: Array
    reward: Array
    doubt: Array
    following: Any
    terminated: Array
    mask: Array


def run(one: Lane, program: Program) -> Outcome:
    """Train one lane (pure; jit and vmap it at will)."""
    world, agent, mitigation = one.world, one.agent, one.mitigation
    assert isinstance(agent, OffPolicy)
    source = FeedbackSource(one, program)
    observe = jax.vmap(world.observe)

    def prefer_in(c: _Carry, states: Any) -> Any:
        def prefer(mu: Array, sigma: Array, observations: Array) -> Array:
            return mitigation.score(mu, sigma, source.of_all(c.known, c.model, states), c.usual)

        return prefer

    def learn(c: _Carry, buffer: Any, draw_key: Array, learn_key: Array) -> tuple[Any, Watched]:
        filled = jnp.minimum(c.steps + 1, agent.buffer)
        places = jax.random.randint(draw_key, (agent.batch,), 0, filled)
        drawn: _Row = jax.tree.map(lambda x: x[places], buffer)

        feedback = source.of(c.known, c.model, drawn.state, drawn.action)

        def judge(sigma_m: Array) -> Any:
            return mitigation.signal(Evidence(drawn.reward, jnp.hypot(sigma_m, drawn.doubt), feedback), c.usual)

        batch = Batch(observe(drawn.state), drawn.action, observe(drawn.following), drawn.terminated, drawn.mask)
        after_it, here = prefer_in(c, drawn.following), prefer_in(c, drawn.state)
        return agent.update(c.agent, batch, judge, after_it, here, mitigation.backup, learn_key)

    def one_step(c: _Carry, keys: Any, learns: bool) -> tuple[_Carry, None]:
        own, of_world, of_panel = keys
        act_key, mask_key, draw_key, learn_key = jax.random.split(own, 4)
        alone = jax.tree.map(lambda x: x[None], c.state)
        observation = world.observe(c.state)
        action = agent.act(c.agent, observation, prefer_in(c, alone), c.episode, act_key)
        step_key, reset_key = jax.random.split(of_world)
        after = world.step(c.state, action, step_key)
        verdict = world.judge(c.state, action, after)
        known = source.record(c.known, c.state, action, after, of_panel)

        mask = (jax.random.uniform(mask_key, (agent.members,)) < agent.bootstrap).astype(jnp.float32)
        row = _Row(c.state, action, after.reward, after.doubt, after.state, after.terminated, mask)
        buffer = _put(c.buffer, row, c.steps % agent.buffer)
        learner, watched = c.agent, Watched(jnp.float32(0.0), jnp.float32(0.0))
        if learns:
            learner, watched = learn(c._replace(known=known), buffer, draw_key, learn_key)

        done = deep.is_over(world, c.time, after)
        sums = c.sums + deep.counted(verdict, after)
        log = c.log.at[jnp.minimum(c.episode, program.episodes)].set(sums)
        fresh = world.reset(reset_key)
        state = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, after.state)
        return _Carry(
            agent=learner,
            buffer=buffer,
            known=known,
            model=c.model,
            usual=c.usual,
            state=state,
            time=jnp.where(done, 0, c.time + 1),
            episode=c.episode + done.astype(jnp.int32),
            sums=jnp.where(done, 0.0, sums),
            log=log,
            steps=c.steps + 1,
            loss=c.loss + watched.loss,
            largest=jnp.maximum(c.largest, watched.largest),
        ), None

    def chunk(loop: tuple[_Carry, Array, deep.Watch]) -> tuple[_Carry, Array, deep.Watch]:
        c, number, watch = loop
        streams = (deep.OWN, deep.WORLD, deep.PANEL)
        keys = [jax.random.split(jax.random.fold_in(deep.key_of(one.seed, s), number), CHUNK) for s in streams]
        c = c._replace(usual=source.usual(c.known, c.model))
        # Chosen once a chunk: to take an update back at every step of the warm-up would copy the networks each time.
        idle, busy = (
            lambda c, keys, learns=x: lax.scan(partial(one_step, learns=learns), c, keys)[0] for x in (False, True)
        )
        c = lax.cond(c.steps < agent.warmup, idle, busy, c, tuple(keys))
        model = source.fit(c.known, c.model, jax.random.fold_in(deep.key_of(one.seed, deep.MODEL), number))
        c = c._replace(model=model)
        watch = watch.after(c.steps, c.agent, c.loss, c.largest, model, c.sums, agent.network.value_scale)
        return c._replace(loss=jnp.float32(0.0), largest=jnp.float32(0.0)), number + 1, watch

    known, model = source.init()
    first = world.reset(jax.random.fold_in(deep.key_of(one.seed, deep.WORLD), deep.FIRST))
    learner = agent.init(deep.key_of(one.seed, deep.INIT), world.features, world.actions)
    row = _Row(
        first,
        jnp.int32(0),
        jnp.float32(0.0),
        jnp.float32(0.0),
        first,
        jnp.asarray(False),
        jnp.zeros(agent.members, jnp.float32),
    )
    start = _Carry(
        agent=learner,
        buffer=jax.tree.map(lambda x: jnp.zeros((agent.buffer, *jnp.shape(x)), jnp.asarray(x).dtype), row),
        known=known,
        model=model,
        usual=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(source.usual, known, model)),
        state=first,
        time=jnp.int32(0),
        episode=jnp.int32(0),
        sums=jnp.zeros(len(LOG), jnp.float32),
        log=jnp.zeros((program.episodes + 1, len(LOG)), jnp.float32),
        steps=jnp.int32(0),
        loss=jnp.float32(0.0),
        largest=jnp.float32(0.0),
    )

    def unfinished(loop: tuple[_Carry, Array, deep.Watch]) -> Array:
        c, _, watch = loop
        return deep.goes_on(program, c.episode, c.steps, watch)

    c, _, watch = lax.while_loop(unfinished, chunk, (start, jnp.uint32(0), deep.Watch.start(learner)))

    def greedy(state: Any, key: Array) -> Array:
        alone = jax.tree.map(lambda x: x[None], state)
        return agent.greedy(c.agent, world.observe(state), prefer_in(c, alone), key)

    def read(states: Any) -> tuple[Array, Array, Array]:
        opinions = agent.values(c.agent, observe(states), deep.key_of(one.seed, deep.INIT))
        return *mean_and_deviation(opinions), opinions.min(0)

    return deep.outcome(one, program, source, c, watch, greedy, read)


def _put(buffer: Any, row: _Row, place: Array) -> Any:
    """Return the buffer with a transition at a place.

    In a loop of its own, once round, of which the compiler does not know that it is once: it would otherwise read the
    batch from the old buffer beside the write, and for that copy the buffer at every step, a third of a DQN's time.
    """

    def write(_: Array, kept: Any) -> Any:
        return jax.tree.map(lambda rows, new: rows.at[place].set(new), kept, row)

    return lax.fori_loop(0, jnp.minimum(place + 1, 1), write, buffer)
