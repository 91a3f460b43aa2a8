"""Training of agents that learn from what they just did, as one compiled program.

One run steps several copies of its world side by side. After each rollout the raters are asked about its steps, the
model of ratings is fitted, the panel's statistics are measured, and then the mitigation gives the reward of every step,
before advantages are computed from it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array, lax

from uard.agents import networks
from uard.agents.policy import Experience, PolicyGradient
from uard.envs.world import Step
from uard.method.mitigations import Evidence
from uard.training.compiled import common
from uard.training.compiled.common import CHUNK, FeedbackSource, Program, Run, TrainedAgent
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


def train_one(run: Run, program: Program) -> TrainedAgent:
    """Train one run (pure; jit and vmap it at will).

    Episodes are logged in the order in which they ended, whichever copy of the world they were in; those that end
    together, in the order of the copies. What ends beyond ``program.episodes`` in the last rollout is dropped, though
    it was learned from. ``program.steps`` counts the steps of all copies.

    Examples:
        >>> from uard.agents.networks import SINGLE, Network
        >>> from uard.agents.policy import PPO
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> from uard.method.mitigations import named
        >>> from uard.ratings.panels import MAIN
        >>> agent = PPO(network=Network(hidden=8), ensemble=SINGLE, envs=2, rollout=16)
        >>> run = common.make_run(TrapGrid(size=3).world(MAIN), agent, named("raw"), seed=0)
        >>> trained = jax.jit(train_one, static_argnames="program")(run, Program(episodes=5))
        >>> trained.log.shape, common.QUANTITIES[trained.fault]
        ((5, 6), 'nothing')

    Args:
        run: Its agent is a ``PolicyGradient``; see ``uard.training.compiled.common.make_run``.
        program: What is fixed when the program is compiled.
    """
    world, agent, mitigation = run.world, cast(PolicyGradient, run.agent), run.mitigation
    source = FeedbackSource(run, program)
    copies, length = agent.envs, agent.rollout
    total = copies * length
    # As many fits of the rating model per environment step as the replay loop makes.
    fits = -(-total // CHUNK)

    def step_world(place: _Place, action: Array, key: Array) -> tuple[_Place, _Row]:
        """Take one step in one copy of the world, and begin a new episode after the last."""
        step_key, reset_key = jax.random.split(key)
        after = world.step(place.state, action, step_key)
        evaluation = world.evaluate(place.state, action, after)
        done = common.is_over(world, place.time, after)
        sums = place.sums + common.counted(evaluation, after)
        cost = jnp.asarray(evaluation.hack, jnp.float32) if agent.needs_cost else jnp.float32(0.0)
        fresh = _Place(world.reset(reset_key), jnp.int32(0), jnp.zeros(len(LOG), jnp.float32))
        going = _Place(after.state, place.time + 1, sums)
        place_after = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, going)
        return place_after, _Row(place.state, action, after, cost, done, sums)

    def roll_out(c: _Carry, act_key: Array, world_key: Array) -> tuple[_Place, _Row]:
        """Let the policy act for a rollout; rows are (T, E, ...)."""

        def one_step(place: _Place, keys: tuple[Array, Array]) -> tuple[_Place, _Row]:
            action = agent.act(c.agent, jax.vmap(world.observe)(place.state), keys[0])
            return jax.vmap(step_world)(place, action, keys[1])

        keys = jax.random.split(act_key, length), jax.random.split(world_key, (length, copies))
        return lax.scan(one_step, c.place, keys)

    def collect_ratings(c: _Carry, flat: _Row, panel_key: Array, model_key: Array) -> tuple[Any, Any, Any]:
        """Put the rollout to the panel; return what is known then, the model fitted to it, and the statistics."""

        def collect(known: Any, x: tuple[_Row, Array]) -> tuple[Any, None]:
            row, key = x
            return source.collect(known, row.state, row.action, row.after, key), None

        # One step after the other: several may be of one state-action, whose running means each of them moves.
        known, _ = lax.scan(collect, c.known, (flat, jax.random.split(panel_key, total)))
        model = source.fit(known, c.model, *jax.random.split(model_key, fits))
        return known, model, source.panel_statistics(known, model)

    def log_episodes(c: _Carry, flat: _Row) -> tuple[Array, Array]:
        """Return the log with the episodes that ended, and how many there are then."""
        ended = jnp.cumsum(flat.done.astype(jnp.int32))
        line = jnp.where(flat.done, jnp.minimum(c.episode + ended - 1, program.episodes), program.episodes)
        return c.log.at[line].set(flat.sums), c.episode + ended[-1]

    def filter_rewards(c: _Carry, rows: _Row, statistics: Any, key: Array) -> Experience:
        """Return the rollout with the rewards to learn from; all in here is (T E,) but what is returned."""
        flat: _Row = _flat(rows)
        after = flat.after
        here, there = jax.vmap(world.observe)(flat.state), jax.vmap(world.observe)(after.state)
        both = agent.values(c.agent, jnp.concatenate([here, there]), key)
        values, next_values = both[:, :total], both[:, total:]
        # There are no action values to disagree about: one step ahead, what the members say of the state it led to.
        ahead = jnp.where(after.terminated, 0.0, agent.gamma * networks.mean_and_deviation(next_values)[1])
        feedback = source.of(c.known, c.model, flat.state, flat.action, after.reward)
        signal = mitigation.signal(Evidence(after.reward, jnp.hypot(ahead, after.doubt), feedback), statistics)
        bonus = agent.count_bonus / jnp.sqrt(c.visits[jax.vmap(world.slot)(flat.state, flat.action)])

        def score_fn(q: Array) -> Array:
            scores = mitigation.score(q.reshape(total), ahead, feedback, statistics, one_action=True)
            return scores.reshape(q.shape)

        def shaped(x: Array) -> Array:
            return x.reshape(length, copies, *x.shape[1:])

        return Experience(
            observation=shaped(here),
            action=rows.action,
            next_observation=shaped(there),
            reward=shaped(signal.reward + bonus),
            weight=shaped(jnp.broadcast_to(jnp.asarray(signal.sample_weight, jnp.float32), (total,))),
            cost=rows.cost,
            terminated=rows.after.terminated,
            done=rows.done,
            values=jax.vmap(shaped)(values),
            next_values=jax.vmap(shaped)(next_values),
            horizon=jnp.asarray(world.horizon),
            score_fn=score_fn,
        )

    def chunk(loop: tuple[_Carry, Array, common.Watch]) -> tuple[_Carry, Array, common.Watch]:
        c, number, watch = loop
        own, of_world, of_panel, of_model = (
            jax.random.fold_in(common.key_of(run.seed, stream), number)
            for stream in (common.OWN, common.WORLD, common.PANEL, common.MODEL)
        )
        act_key, value_key, learn_key = jax.random.split(own, 3)
        place, rows = roll_out(c, act_key, of_world)
        flat: _Row = _flat(rows)
        known, model, statistics = collect_ratings(c, flat, of_panel, of_model)
        log, episode = log_episodes(c, flat)
        c = c._replace(
            place=place,
            known=known,
            model=model,
            # This rollout included: the bonus divides by their root.
            visits=c.visits.at[jax.vmap(world.slot)(flat.state, flat.action)].add(1.0),
            episode=episode,
            log=log,
            steps=c.steps + total,
        )
        experience = filter_rewards(c, rows, statistics, value_key)
        learner, info = agent.update(c.agent, experience, learn_key)
        c = c._replace(agent=learner)
        reward = jnp.stack([flat.after.reward.sum(), experience.reward.sum()])
        scale = jnp.asarray(agent.network.value_scale, jnp.float32)
        watch = watch.after(c.steps, learner, info.loss, info.largest, model, reward, scale)
        return c, number + 1, watch

    def unfinished(loop: tuple[_Carry, Array, common.Watch]) -> Array:
        c, _, watch = loop
        return common.goes_on(program, c.episode, c.steps, watch)

    start = _start(run, program, source)
    c, _, watch = lax.while_loop(unfinished, chunk, (start, jnp.uint32(0), common.Watch.start(start.agent)))

    def greedy(state: Any, key: Array) -> Array:
        return agent.greedy(c.agent, world.observe(state))

    def read(states: Any) -> tuple[Array, ...]:
        """Return mean, deviation and lowest of the members' V, the same for all actions: (S, A) each."""
        v = agent.values(c.agent, jax.vmap(world.observe)(states), common.key_of(run.seed, common.INIT))
        of_state = *networks.mean_and_deviation(v), v.min(0)
        return tuple(jnp.broadcast_to(x[:, None], (*x.shape, world.actions)) for x in of_state)

    return common.finished(run, program, source, c, watch, greedy, read)


def _start(run: Run, program: Program, source: FeedbackSource) -> _Carry:
    world, agent = run.world, run.agent
    known, model = source.init()
    first = jax.random.fold_in(common.key_of(run.seed, common.WORLD), common.FIRST)
    return _Carry(
        agent=agent.init(common.key_of(run.seed, common.INIT), world.features, world.actions),
        place=_Place(
            jax.vmap(world.reset)(jax.random.split(first, agent.envs)),
            jnp.zeros(agent.envs, jnp.int32),
            jnp.zeros((agent.envs, len(LOG)), jnp.float32),
        ),
        known=known,
        model=model,
        visits=jnp.zeros(world.slots, jnp.float32),
        episode=jnp.int32(0),
        log=jnp.zeros((program.episodes + 1, len(LOG)), jnp.float32),
        steps=jnp.int32(0),
    )


def _flat(rows: Any) -> Any:
    """Merge the two leading axes (T, E) into one, in the order of time."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
