"""Training of agents that learn from a replay buffer, as one compiled program."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array, lax

from uard.agents.networks import mean_and_deviation
from uard.agents.off_policy import OffPolicy, ScoreFn, Transitions, UpdateInfo
from uard.envs.world import Step
from uard.method.mitigations import Evidence, LearningSignal
from uard.training.compiled import common
from uard.training.compiled.common import CHUNK, FeedbackSource, Program, Run, TrainedAgent
from uard.training.episode_log import LOG


class _Carry(NamedTuple):
    agent: Any
    buffer: Any
    known: Any
    model: Any
    statistics: Any
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
    next_state: Any
    terminated: Array
    mask: Array


def train_one(run: Run, program: Program) -> TrainedAgent:
    """Train one run (pure; jit and vmap it at will).

    Examples:
        >>> from uard.agents.networks import Network
        >>> from uard.agents.value import DeepQ
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> from uard.method.mitigations import named
        >>> from uard.ratings.panels import MAIN
        >>> agent = DeepQ(network=Network(hidden=8), batch=8, warmup=8)
        >>> run = common.make_run(TrapGrid(size=3).world(MAIN), agent, named("raw"), seed=0)
        >>> trained = jax.jit(train_one, static_argnames="program")(run, Program(episodes=5))
        >>> trained.log.shape, common.QUANTITIES[trained.fault]
        ((5, 6), 'nothing')

    Args:
        run: Its agent is an ``OffPolicy``; see ``uard.training.compiled.common.make_run``.
        program: What is fixed when the program is compiled.
    """
    world, agent, mitigation = run.world, cast(OffPolicy, run.agent), run.mitigation
    source = FeedbackSource(run, program)
    observe = jax.vmap(world.observe)

    def score_fn_in(c: _Carry, states: Any) -> ScoreFn:
        """Return the mitigation's scores of actions in these states."""

        def score_fn(mu: Array, sigma_m: Array, observations: Array) -> Array:
            return mitigation.score(mu, sigma_m, source.of_all(c.known, c.model, states), c.statistics)

        return score_fn

    def select_action(c: _Carry, key: Array) -> Array:
        alone = jax.tree.map(lambda x: x[None], c.state)
        return agent.act(c.agent, world.observe(c.state), score_fn_in(c, alone), c.episode, key)

    def store_transition(c: _Carry, action: Array, after: Step, mask_key: Array) -> Any:
        """Return the buffer with the step, which each member of the ensemble learns from or not."""
        mask = (jax.random.uniform(mask_key, (agent.members,)) < agent.bootstrap).astype(jnp.float32)
        row = _Row(c.state, action, after.reward, after.doubt, after.state, after.terminated, mask)
        return _put(c.buffer, row, c.steps % agent.buffer)

    def update(c: _Carry, buffer: Any, draw_key: Array, learn_key: Array) -> tuple[Any, UpdateInfo]:
        """Draw a batch, filter its rewards, and let the agent learn from it."""
        filled = jnp.minimum(c.steps + 1, agent.buffer)
        places = jax.random.randint(draw_key, (agent.batch,), 0, filled)
        drawn: _Row = jax.tree.map(lambda x: x[places], buffer)
        feedback = source.of(c.known, c.model, drawn.state, drawn.action, drawn.reward)

        def reward_fn(sigma_m: Array) -> LearningSignal:
            return mitigation.signal(Evidence(drawn.reward, jnp.hypot(sigma_m, drawn.doubt), feedback), c.statistics)

        batch = Transitions(observe(drawn.state), drawn.action, observe(drawn.next_state), drawn.terminated, drawn.mask)
        score_next, score_here = score_fn_in(c, drawn.next_state), score_fn_in(c, drawn.state)
        return agent.update(c.agent, batch, reward_fn, score_next, score_here, mitigation.backup, learn_key)

    def log_step(c: _Carry, action: Array, after: Step) -> tuple[Array, Array]:
        """Return the running episode's sums and the log with them."""
        sums = c.sums + common.counted(world.evaluate(c.state, action, after), after)
        return sums, c.log.at[jnp.minimum(c.episode, program.episodes)].set(sums)

    def one_step(c: _Carry, keys: Any, learns: bool) -> tuple[_Carry, None]:
        own, of_world, of_panel = keys
        act_key, mask_key, draw_key, learn_key = jax.random.split(own, 4)
        step_key, reset_key = jax.random.split(of_world)
        action = select_action(c, act_key)
        after = world.step(c.state, action, step_key)
        known = source.collect(c.known, c.state, action, after, of_panel)
        buffer = store_transition(c, action, after, mask_key)
        learner, info = c.agent, UpdateInfo(jnp.float32(0.0), jnp.float32(0.0))
        if learns:
            # With what was just said of this step: it may be drawn at once.
            learner, info = update(c._replace(known=known), buffer, draw_key, learn_key)
        sums, log = log_step(c, action, after)
        done = common.is_over(world, c.time, after)
        fresh = world.reset(reset_key)
        return _Carry(
            agent=learner,
            buffer=buffer,
            known=known,
            model=c.model,
            statistics=c.statistics,
            state=jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, after.state),
            time=jnp.where(done, 0, c.time + 1),
            episode=c.episode + done.astype(jnp.int32),
            sums=jnp.where(done, 0.0, sums),
            log=log,
            steps=c.steps + 1,
            loss=c.loss + info.loss,
            largest=jnp.maximum(c.largest, info.largest),
        ), None

    def chunk(loop: tuple[_Carry, Array, common.Watch]) -> tuple[_Carry, Array, common.Watch]:
        c, number, watch = loop
        streams = (common.OWN, common.WORLD, common.PANEL)
        keys = [jax.random.split(jax.random.fold_in(common.key_of(run.seed, s), number), CHUNK) for s in streams]
        c = c._replace(statistics=source.panel_statistics(c.known, c.model))
        # Chosen once a chunk: to take an update back at every step of the warm-up would copy the networks each time.
        idle, busy = (
            lambda c, keys, learns=x: lax.scan(partial(one_step, learns=learns), c, keys)[0] for x in (False, True)
        )
        c = lax.cond(c.steps < agent.warmup, idle, busy, c, tuple(keys))
        model = source.fit(c.known, c.model, jax.random.fold_in(common.key_of(run.seed, common.MODEL), number))
        c = c._replace(model=model)
        watch = watch.after(c.steps, c.agent, c.loss, c.largest, model, c.sums, agent.network.value_scale)
        return c._replace(loss=jnp.float32(0.0), largest=jnp.float32(0.0)), number + 1, watch

    def unfinished(loop: tuple[_Carry, Array, common.Watch]) -> Array:
        c, _, watch = loop
        return common.goes_on(program, c.episode, c.steps, watch)

    start = _start(run, program, source)
    c, _, watch = lax.while_loop(unfinished, chunk, (start, jnp.uint32(0), common.Watch.start(start.agent)))

    def greedy(state: Any, key: Array) -> Array:
        alone = jax.tree.map(lambda x: x[None], state)
        return agent.greedy(c.agent, world.observe(state), score_fn_in(c, alone), key)

    def read(states: Any) -> tuple[Array, Array, Array]:
        values = agent.values(c.agent, observe(states), common.key_of(run.seed, common.INIT))
        return *mean_and_deviation(values), values.min(0)

    return common.finished(run, program, source, c, watch, greedy, read)


def _start(run: Run, program: Program, source: FeedbackSource) -> _Carry:
    world, agent = run.world, run.agent
    known, model = source.init()
    first = world.reset(jax.random.fold_in(common.key_of(run.seed, common.WORLD), common.FIRST))
    zero = jnp.float32(0.0)
    row = _Row(first, jnp.int32(0), zero, zero, first, jnp.asarray(False), jnp.zeros(agent.members, jnp.float32))
    statistics = jax.eval_shape(source.panel_statistics, known, model)
    return _Carry(
        agent=agent.init(common.key_of(run.seed, common.INIT), world.features, world.actions),
        buffer=jax.tree.map(lambda x: jnp.zeros((agent.buffer, *jnp.shape(x)), jnp.asarray(x).dtype), row),
        known=known,
        model=model,
        statistics=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), statistics),
        state=first,
        time=jnp.int32(0),
        episode=jnp.int32(0),
        sums=jnp.zeros(len(LOG), jnp.float32),
        log=jnp.zeros((program.episodes + 1, len(LOG)), jnp.float32),
        steps=jnp.int32(0),
        loss=zero,
        largest=zero,
    )


def _put(buffer: Any, row: _Row, place: Array) -> Any:
    """Return the buffer with a transition at a place.

    In a loop of its own, once round, of which the compiler does not know that it is once: it would otherwise read the
    batch from the old buffer beside the write, and for that copy the buffer at every step, a third of a DQN's time.
    """

    def write(_: Array, kept: Any) -> Any:
        return jax.tree.map(lambda rows, new: rows.at[place].set(new), kept, row)

    return lax.fori_loop(0, jnp.minimum(place + 1, 1), write, buffer)
