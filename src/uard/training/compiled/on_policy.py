"""Training of agents that learn from what they just did, as one compiled program.

One lane steps several copies of its world side by side. After each rollout the raters are asked about its steps, the
model of ratings is fitted, what is usual is measured, and then the mitigation gives the reward of every step, before
advantages are computed from it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from uard.agents import networks
from uard.agents.policy import Experience, PolicyGradient
from uard.envs.world import Step
from uard.method.mitigations import Evidence, as_column
from uard.training.compiled import common as deep
from uard.training.compiled.common import CHUNK, FeedbackSource, Lane, Outcome, Program
from uard.training.episode_log import LOG


class _Place(NamedTuple):
    """Where the copies of the world are, leaves (E, ...): state, time in the episode, its sums so far."""

    state: Any
    time: Array
    sums: Array


class _Row(NamedTuple):
    """One transition. ``sums`` are the episode's, this step included; ``cost`` is an oracle's, see ``CPO``."""

    state: Any
    action: Array
    after: Step
    cost: Array
    done: Array
    sums: Array


class _Carry(NamedTuple):
    agent: Any
    place: _Place
    known: Any
    model: Any
    visits: Array
    episode: Array
    log: Array
    steps: Array


def run(one: Lane, program: Program) -> Outcome:
    """Train one lane (pure; jit and vmap it at will).

    Episodes are logged in the order in which they ended, whichever copy of the world they were in; those that end
    together, in the order of the copies. What ends beyond ``program.episodes`` in the last rollout is dropped, though
    it was learned from. ``program.steps`` counts the steps of all copies.
    """
    world, agent, mitigation = one.world, one.agent, one.mitigation
    assert isinstance(agent, PolicyGradient)
    source = FeedbackSource(one, program)
    copies, length = agent.envs, agent.rollout
    total = copies * length
    # As many fits of the rating model per environment step as the replay loop makes.
    fits = -(-total // CHUNK)

    def one_world(place: _Place, action: Array, key: Array) -> tuple[_Place, _Row]:
        step_key, reset_key = jax.random.split(key)
        after = world.step(place.state, action, step_key)
        verdict = world.judge(place.state, action, after)
        done = deep.is_over(world, place.time, after)
        sums = place.sums + deep.counted(verdict, after)
        cost = jnp.asarray(verdict.hack, jnp.float32) if agent.needs_cost else jnp.float32(0.0)
        fresh = _Place(world.reset(reset_key), jnp.int32(0), jnp.zeros(len(LOG), jnp.float32))
        going = _Place(after.state, place.time + 1, sums)
        following = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, going)
        return following, _Row(place.state, action, after, cost, done, sums)

    def rollout(c: _Carry, act_key: Array, world_key: Array) -> tuple[_Place, _Row]:
        def one_step(place: _Place, keys: tuple[Array, Array]) -> tuple[_Place, _Row]:
            action = agent.act(c.agent, jax.vmap(world.observe)(place.state), keys[0])
            return jax.vmap(one_world)(place, action, keys[1])

        keys = jax.random.split(act_key, length), jax.random.split(world_key, (length, copies))
        return lax.scan(one_step, c.place, keys)

    def experience(c: _Carry, rows: _Row, usual: Any, key: Array) -> Experience:
        """Judge a rollout; all in it is (T E,) but what is returned."""
        flat: _Row = _flat(rows)
        after = flat.after
        here, there = jax.vmap(world.observe)(flat.state), jax.vmap(world.observe)(after.state)
        both = agent.values(c.agent, jnp.concatenate([here, there]), key)
        values, following = both[:, :total], both[:, total:]
        # There are no action values to disagree about: one step ahead, what the members say of the state it led to.
        ahead = jnp.where(after.terminated, 0.0, agent.gamma * networks.mean_and_deviation(following)[1])
        feedback = source.of(c.known, c.model, flat.state, flat.action)
        signal = mitigation.signal(Evidence(after.reward, jnp.hypot(ahead, after.doubt), feedback), usual)
        slots = jax.vmap(world.slot)(flat.state, flat.action)
        bonus = agent.count_bonus / jnp.sqrt(c.visits[slots])
        alone = as_column(feedback)

        def prefer(q: Array) -> Array:
            scores = mitigation.score(q.reshape(total, 1), ahead[:, None], alone, usual)
            return scores.reshape(q.shape)

        def shaped(x: Array) -> Array:
            return x.reshape(length, copies, *x.shape[1:])

        return Experience(
            observation=shaped(here),
            action=rows.action,
            following=shaped(there),
            reward=shaped(signal.reward + bonus),
            weight=shaped(jnp.broadcast_to(jnp.asarray(signal.sample_weight, jnp.float32), (total,))),
            cost=rows.cost,
            terminated=rows.after.terminated,
            done=rows.done,
            values=jax.vmap(shaped)(values),
            following_values=jax.vmap(shaped)(following),
            horizon=jnp.asarray(world.horizon),
            prefer=prefer,
        )

    def chunk(loop: tuple[_Carry, Array, deep.Watch]) -> tuple[_Carry, Array, deep.Watch]:
        c, number, watch = loop
        own, of_world, of_panel, of_model = (
            jax.random.fold_in(deep.key_of(one.seed, stream), number)
            for stream in (deep.OWN, deep.WORLD, deep.PANEL, deep.MODEL)
        )
        act_key, value_key, learn_key = jax.random.split(own, 3)
        place, rows = rollout(c, act_key, of_world)
        flat: _Row = _flat(rows)

        def record(known: Any, x: tuple[_Row, Array]) -> tuple[Any, None]:
            row, key = x
            return source.record(known, row.state, row.action, row.after, key), None

        known, _ = lax.scan(record, c.known, (flat, jax.random.split(of_panel, total)))
        model, _ = lax.scan(
            lambda model, key: (source.fit(known, model, key), None), c.model, jax.random.split(of_model, fits)
        )
        usual = source.usual(known, model)
        visits = c.visits.at[jax.vmap(world.slot)(flat.state, flat.action)].add(1.0)
        ended = jnp.cumsum(flat.done.astype(jnp.int32))
        line = jnp.where(flat.done, jnp.minimum(c.episode + ended - 1, program.episodes), program.episodes)
        c = c._replace(
            place=place,
            known=known,
            model=model,
            visits=visits,
            episode=c.episode + ended[-1],
            log=c.log.at[line].set(flat.sums),
            steps=c.steps + total,
        )
        lived = experience(c, rows, usual, value_key)
        learner, watched = agent.update(c.agent, lived, learn_key)
        c = c._replace(agent=learner)
        reward = jnp.stack([flat.after.reward.sum(), lived.reward.sum()])
        scale = jnp.asarray(agent.network.value_scale, jnp.float32)
        watch = watch.after(c.steps, learner, watched.loss, watched.largest, model, reward, scale)
        return c, number + 1, watch

    known, model = source.init()
    first = jax.random.fold_in(deep.key_of(one.seed, deep.WORLD), deep.FIRST)
    learner = agent.init(deep.key_of(one.seed, deep.INIT), world.features, world.actions)
    start = _Carry(
        agent=learner,
        place=_Place(
            jax.vmap(world.reset)(jax.random.split(first, copies)),
            jnp.zeros(copies, jnp.int32),
            jnp.zeros((copies, len(LOG)), jnp.float32),
        ),
        known=known,
        model=model,
        visits=jnp.zeros(world.slots, jnp.float32),
        episode=jnp.int32(0),
        log=jnp.zeros((program.episodes + 1, len(LOG)), jnp.float32),
        steps=jnp.int32(0),
    )

    def unfinished(loop: tuple[_Carry, Array, deep.Watch]) -> Array:
        c, _, watch = loop
        return deep.goes_on(program, c.episode, c.steps, watch)

    c, _, watch = lax.while_loop(unfinished, chunk, (start, jnp.uint32(0), deep.Watch.start(learner)))

    def greedy(state: Any, key: Array) -> Array:
        return agent.greedy(c.agent, world.observe(state))

    def read(states: Any) -> tuple[Array, ...]:
        """Return mean, deviation and lowest of the members' V, the same for all actions: (S, A) each."""
        v = agent.values(c.agent, jax.vmap(world.observe)(states), deep.key_of(one.seed, deep.INIT))
        of_state = *networks.mean_and_deviation(v), v.min(0)
        return tuple(jnp.broadcast_to(x[:, None], (*x.shape, world.actions)) for x in of_state)

    return deep.outcome(one, program, source, c, watch, greedy, read)


def _flat(rows: Any) -> Any:
    """Merge the two leading axes (T, E) into one, in the order of time."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
