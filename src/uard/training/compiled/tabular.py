"""Training of tabular agents as one compiled program.

It is compiled once per combination of array sizes, heads, raters and class of mitigation; numbers are traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from uard.agents import tabular
from uard.agents.tabular import QLearning
from uard.envs.tables import MIN_STATES, HiddenTruth, Task, at, pad, step
from uard.method.feedback import Feedback
from uard.method.mitigations import Evidence, LearningSignal, Mitigation
from uard.ratings.aggregate import aggregate, empty_rows, from_rows, merged, to_rows
from uard.ratings.panels import UNIFORMS, RatingLaw, answers
from uard.training.compiled import runs
from uard.training.compiled.draws import normal, words
from uard.training.episode_log import LOG
from uard.training.tracing import traceable

CHUNK = 512  # steps whose random numbers are drawn together; the panel's statistics are measured once a chunk, and,
# where a rule asks for them early, in the first chunk whenever the number of steps has doubled
DOUBLED = np.array([0, *(2**i for i in range(CHUNK.bit_length()))])  # its end is the last
ROOM = 64  # a program has room for this many runs, or a multiple


class Run(NamedTuple):
    """One run, as data. ``truth`` reaches the log only."""

    task: Task
    law: RatingLaw
    truth: HiddenTruth
    agent: QLearning
    mitigation: Mitigation
    rated: Any
    seed: Any


@dataclass(frozen=True)
class Program:
    """What is fixed when the program is compiled.

    Attributes:
        episodes: Number of training episodes.
        ddof: Of the raters' deviation.
        snapshots: How many tables to keep along the way, evenly spaced in episodes.
    """

    episodes: int = 500
    ddof: int = 0
    snapshots: int = 0


class TrainedTables(NamedTuple):
    """What a run leaves behind.

    Attributes:
        log: (episodes, len(LOG)) per-episode sums.
        steps: Environment steps taken.
        q: Final table (S, A, N).
        feedback: What is known of every state-action's ratings at the end, (S, A) arrays.
        q_snapshots: (snapshots, S, A, N).
        feedback_snapshots: The same as ``feedback`` along the way, (snapshots, S, A) arrays.
    """

    log: Array
    steps: Array
    q: Array
    feedback: Feedback
    q_snapshots: Array
    feedback_snapshots: Feedback


def make_run(
    task: Task,
    law: RatingLaw,
    truth: HiddenTruth,
    agent: QLearning,
    mitigation: Mitigation,
    seed: int,
    rated: float = 1.0,
) -> Run:
    """Build a run; tables are padded so that sizes up to 10x10 share a program."""
    states = max(MIN_STATES, task.next_state.shape[0])
    return Run(
        pad(task, states),
        pad(law, states),
        pad(truth, states),
        traceable(agent),
        traceable(mitigation),
        np.float32(rated),
        np.uint32(seed),
    )


def train(these: list[Run], program: Program, fields: tuple[str, ...] = ("log", "steps")) -> list[dict[str, Any]]:
    """Train all runs, which must agree in everything that is not a number, and return the asked-for fields."""
    return runs.train(these, train_one, program, fields, ROOM)


class _Carry(NamedTuple):
    q: Array
    row: Array  # q[state], carried so that it is read once
    rows: Array  # what is known of ratings, (S, A, width), see ``uard.ratings.aggregate``
    statistics: Any
    state: Array
    time: Array
    episode: Array
    epsilon: Array
    sums: Array
    log: Array
    steps: Array


class _Draws(NamedTuple):
    """Random numbers of some steps: the agent's; of the raters' answers; whether a step is rated (0 or 1)."""

    agent: tabular.Draws
    normal: Array
    uniform: Array | None
    rated: Array


def train_one(run: Run, program: Program) -> TrainedTables:
    """Train one run (pure; jit and vmap it at will).

    The barriers keep XLA from computing values again inside the writes to the tables, which would then need a copy of
    a whole table at every step.

    Examples:
        >>> from uard.envs.grids.trapgrid import TrapGrid
        >>> from uard.method.mitigations import named
        >>> from uard.ratings.panels import MAIN
        >>> grid = TrapGrid(size=3)
        >>> run = make_run(grid.task(), grid.rating_law(MAIN), grid.truth(), QLearning(), named("uard"), seed=0)
        >>> trained = jax.jit(train_one, static_argnames="program")(run, Program(episodes=5))
        >>> trained.log.shape, trained.q.shape  # the tables are padded
        ((5, 6), (100, 4, 5))

    Args:
        run: See ``make_run``.
        program: What is fixed when the program is compiled.
    """
    task, agent, mitigation = run.task, run.agent, run.mitigation
    states, actions = task.next_state.shape
    starts = jnp.atleast_1d(jnp.asarray(task.start, jnp.int32))
    raters = run.law.centre.shape[-1]
    asks_raters = mitigation.reads_feedback
    # Where a segment begins and ends in its chunk: those of the first chunk, and the whole of any later one.
    doubled = DOUBLED if mitigation.refits_early and asks_raters else DOUBLED[[0, -1]]
    lows, highs = np.append(doubled[:-1], 0), np.append(doubled[1:], CHUNK)
    # One row per state-action, so that a step reads each table once.
    ones = jnp.ones_like(task.reward)
    columns = [run.truth.hack, run.truth.reward, task.reward, run.truth.goal, ones, 0.0 * ones]
    counted = jnp.stack([c.astype(jnp.float32) for c in columns], axis=-1).reshape(states * actions, len(LOG))
    centre, deviation = (x.reshape(states * actions, raters) for x in run.law[:2])
    asks_when_abstaining = agent.abstention is not None and agent.abstention.response == "ask"
    skips_when_abstaining = agent.abstention is not None and agent.abstention.response == "skip"

    def panel_statistics(rows: Array) -> Any:
        feedback = from_rows(rows)
        return mitigation.fit(feedback, feedback.count > 0)

    def select_action(c: _Carry, explore: Array, random_action: Array) -> tuple[Array, Array]:
        """Return an action, and whether the agent abstained from its own (0 or 1)."""
        mu, sigma_m = tabular.mean_and_deviation(c.row)
        feedback = from_rows(at(c.rows, c.state))
        best = jnp.argmax(mitigation.score(mu, sigma_m, feedback, c.statistics)).astype(jnp.int32)
        abstained = jnp.float32(0.0)
        if agent.abstention is not None:
            u = 0.5 * sigma_m + 0.5 * jnp.where(feedback.count > 0, feedback.sd, 0.0)
            abstains = agent.abstention.abstains(u[best], mu[best])
            abstained = abstains.astype(jnp.float32)
            if agent.abstention.response == "safe":
                best = jnp.where(abstains, jnp.argmin(u).astype(jnp.int32), best)
        return jnp.where(explore < c.epsilon, random_action, best), abstained

    def collect_ratings(
        c: _Carry, action: Array, reward: Array, draws: _Draws, abstained: Array, active: Array
    ) -> tuple[Array, Array]:
        """Put the step to the panel, if it is one that is rated; return all rows, and the state-action's own."""
        row = at(at(c.rows, c.state), action)
        if not asks_raters:
            return c.rows, row
        place = c.state * actions + action
        law = RatingLaw(at(centre, place), at(deviation, place), None, run.law.quirks)
        ratings, mask = answers(law, draws.normal, draws.uniform)
        visit = aggregate(ratings, reward, mask, program.ddof)
        rated = jnp.maximum(draws.rated, abstained) if asks_when_abstaining else draws.rated
        if run.law.reach is not None:
            rated = rated * at(at(run.law.reach, c.state), action)
        row = merged(row, to_rows(visit), rated * active * visit.count)
        row = lax.optimization_barrier(row)
        return lax.dynamic_update_slice(c.rows, row[None, None], (c.state, action, 0)), row

    def filter_reward(c: _Carry, action: Array, reward: Array, row: Array) -> LearningSignal:
        _, sigma_m = tabular.mean_and_deviation(at(c.row, action))
        if task.doubt is not None:
            sigma_m = jnp.hypot(sigma_m, at(at(task.doubt, c.state), action))
        return lax.optimization_barrier(mitigation.signal(Evidence(reward, sigma_m, from_rows(row)), c.statistics))

    def next_value(c: _Carry, rows: Array, next_state: Array) -> Array:
        """Return every head's value of the next state, (N,): of its own best action, or of the best score's."""
        values = at(c.q, next_state)
        if mitigation.backup == "greedy":
            return values.max(0)
        mu, sigma_m = tabular.mean_and_deviation(values)
        best = jnp.argmax(mitigation.score(mu, sigma_m, from_rows(at(rows, next_state)), c.statistics))
        return at(values, lax.optimization_barrier(best))

    def update(c: _Carry, action: Array, target: Array, rate: Array) -> Array:
        """Return the table after every head moved towards its target."""
        old = at(c.row, action)
        target = lax.optimization_barrier(target)
        return lax.dynamic_update_slice(c.q, (old + rate * (target - old))[None, None], (c.state, action, 0))

    def log_step(c: _Carry, action: Array, abstained: Array) -> tuple[Array, Array]:
        """Return the running episode's sums and the log with them."""
        step_adds = at(counted, c.state * actions + action)
        if agent.abstention is not None:
            step_adds = jnp.where(jnp.arange(len(LOG)) == LOG.index("abstained"), abstained, step_adds)
        sums = c.sums + step_adds
        return sums, lax.dynamic_update_slice(c.log, sums[None], (jnp.minimum(c.episode, program.episodes), 0))

    def one_step(c: _Carry, draws: _Draws) -> _Carry:
        # A chunk goes on after the last episode, but to no effect: nothing is rated, learned or counted then.
        active = (c.episode < program.episodes).astype(jnp.float32)
        action, abstained = select_action(c, draws.agent.explore, draws.agent.action)
        if asks_raters:
            action = lax.optimization_barrier(action)
        next_state, reward, terminated, truncated = step(task, c.state, c.time, action)
        rows, row = collect_ratings(c, action, reward, draws, abstained, active)
        signal = filter_reward(c, action, reward, row)
        target = signal.reward + jnp.where(terminated, 0.0, agent.gamma * next_value(c, rows, next_state))
        rate = agent.learning_rate * active * signal.sample_weight * draws.agent.mask
        if skips_when_abstaining:
            rate = rate * (1.0 - abstained)
        q = update(c, action, target, rate)
        sums, log = log_step(c, action, abstained)
        done = jnp.logical_or(terminated, truncated)
        episode = c.episode + done.astype(jnp.int32)
        state = jnp.where(done, at(starts, episode % starts.shape[0]), next_state)
        return _Carry(
            q=q,
            row=at(q, state),
            rows=rows,
            statistics=c.statistics,
            state=state,
            time=jnp.where(done, 0, c.time + 1),
            episode=episode,
            epsilon=jnp.where(done, tabular.next_epsilon(agent, c.epsilon), c.epsilon),
            sums=jnp.where(done, 0.0, sums),
            log=log,
            steps=c.steps + active.astype(jnp.int32),
        )

    def segment(loop: tuple[_Carry, Array, Array, Array]) -> tuple[_Carry, Array, Array, Array]:
        """Measure the panel's statistics and go on to the segment's end.

        One loop for the first chunk and for all others: half of what a second one would take to compile. Each segment
        draws the random numbers of its whole chunk, which are the same every time.
        """
        c, number, q_kept, rows_kept = loop
        kind = jnp.minimum(number, len(lows) - 1)
        chunk = jnp.maximum(number - len(lows) + 2, 0)
        draws = _drawn(run, chunk.astype(jnp.uint32) + 1, actions, raters if asks_raters else None)
        # All segments of the first chunk fill what it fills: it began before any episode was over.
        slot = jnp.where(chunk > 0, c.episode * program.snapshots // program.episodes, 0)
        if asks_raters:
            c = c._replace(statistics=panel_statistics(c.rows))
        low, high = at(jnp.asarray(lows), kind), at(jnp.asarray(highs), kind)
        c = lax.fori_loop(low, high, lambda i, c: one_step(c, jax.tree.map(lambda x: at(x, i), draws)), c)
        if program.snapshots:
            # A chunk can pass over several slots, so all that are left are filled; the next chunk overwrites them.
            later = (jnp.arange(program.snapshots) >= slot)[:, None, None, None]
            q_kept = jnp.where(later, c.q, q_kept)
            rows_kept = jnp.where(later, c.rows, rows_kept)
        return c, number + 1, q_kept, rows_kept

    q = tabular.init(agent, _key(run.seed, jnp.uint32(0)), states, actions)
    rows = empty_rows((states, actions), raters, jnp, jnp.float32)
    before = jax.tree.map(jnp.zeros_like, jax.eval_shape(panel_statistics, rows))  # a chunk begins by measuring them
    start = _Carry(
        q=q,
        row=q[starts[0]],
        rows=rows,
        statistics=before if asks_raters else panel_statistics(rows),
        state=starts[0],
        time=jnp.int32(0),
        episode=jnp.int32(0),
        epsilon=jnp.float32(agent.epsilon),
        sums=jnp.zeros(len(LOG), jnp.float32),
        log=jnp.zeros((program.episodes + 1, len(LOG)), jnp.float32),
        steps=jnp.int32(0),
    )
    kept = jnp.zeros((program.snapshots, *q.shape)), jnp.zeros((program.snapshots, *rows.shape))
    loop = start, jnp.int32(0), *kept
    c, _, q_kept, rows_kept = lax.while_loop(lambda loop: loop[0].episode < program.episodes, segment, loop)
    log = c.log[:-1]  # what came after the last episode was put into the last row
    return TrainedTables(log, c.steps, c.q, from_rows(c.rows), q_kept, from_rows(rows_kept))


def _key(seed: Array, number: Array) -> Array:
    return jax.random.wrap_key_data(jnp.stack([seed, number]), impl="threefry2x32")


def _drawn(run: Run, number: Array, actions: int, raters: int | None) -> _Draws:
    """Draw a chunk's random numbers from one call, which costs a fraction of drawing them step by step."""
    own = tabular.words(run.agent)
    quirky = raters is not None and run.law.quirks is not None
    asked = 0 if raters is None else raters * (1 + UNIFORMS * quirky) + 1
    bits = words(run.seed, number, own + asked, CHUNK)
    agent = tabular.draw(run.agent, bits[:own], actions)
    if raters is None:
        return _Draws(agent, jnp.zeros((CHUNK, 0)), None, jnp.zeros((CHUNK, 0)))
    uniform = None
    if quirky:
        uniform = tabular.uniform(bits[own + raters : -1]).reshape(raters, UNIFORMS, CHUNK).transpose(2, 0, 1)
    rated = (tabular.uniform(bits[-1]) < run.rated).astype(jnp.float32)
    return _Draws(agent, normal(bits[own : own + raters]).T, uniform, rated)
