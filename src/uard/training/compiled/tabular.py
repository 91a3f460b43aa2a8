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
from uard.envs.tables import MIN_STATES, HiddenTruth, Ratings, Task, at, pad, step
from uard.method.mitigations import Evidence, Feedback, Mitigation
from uard.training.compiled import runs as lanes
from uard.training.episode_log import LOG
from uard.training.feedback import running
from uard.training.tracing import traceable

CHUNK = 512  # steps whose random numbers are drawn together; what is usual is measured once a chunk
ROOM = 64


class Lane(NamedTuple):
    """One run, as data. ``truth`` reaches the log only."""

    task: Task
    ratings: Ratings
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
        ddof: Of the annotators' deviation.
        snapshots: How many tables to keep along the way, evenly spaced in episodes.
    """

    episodes: int = 500
    ddof: int = 0
    snapshots: int = 0


class Outcome(NamedTuple):
    """What a run leaves behind.

    Attributes:
        log: (episodes, len(LOG)) per-episode sums.
        steps: Environment steps taken.
        q: Final table (S, A, N).
        feedback: Final rating table (S, A, running.FIELDS).
        q_snapshots: (snapshots, S, A, N).
        feedback_snapshots: (snapshots, S, A, running.FIELDS).
    """

    log: Array
    steps: Array
    q: Array
    feedback: Array
    q_snapshots: Array
    feedback_snapshots: Array


def lane(
    task: Task,
    ratings: Ratings,
    truth: HiddenTruth,
    agent: QLearning,
    mitigation: Mitigation,
    seed: int,
    rated: float = 1.0,
) -> Lane:
    """Build a lane; tables are padded so that sizes up to 10x10 share a program."""
    states = max(MIN_STATES, task.next_state.shape[0])
    return Lane(
        pad(task, states),
        pad(ratings, states),
        pad(truth, states),
        traceable(agent),
        traceable(mitigation),
        np.float32(rated),
        np.uint32(seed),
    )


def train(
    these: list[Lane], program: Program, fields: tuple[str, ...] = ("log", "steps")
) -> list[dict[str, np.ndarray]]:
    """Train all lanes, which must agree in everything that is not a number, and return the asked-for fields."""
    return lanes.train(these, run, program, fields, ROOM)


class _Carry(NamedTuple):
    q: Array
    row: Array  # q[state], carried so that it is read once
    feedback: Array
    usual: Any
    state: Array
    time: Array
    episode: Array
    epsilon: Array
    sums: Array
    log: Array
    steps: Array


def run(one: Lane, program: Program) -> Outcome:
    """Train one lane (pure; jit and vmap it at will)."""
    task, agent, mitigation = one.task, one.agent, one.mitigation
    states, actions = task.next_state.shape
    starts = jnp.atleast_1d(jnp.asarray(task.start, jnp.int32))
    raters = one.ratings.centre.shape[-1]
    listens = mitigation.reads_feedback
    # One row per state-action, so that a step reads each table once.
    one_each = jnp.ones_like(task.reward)
    columns = [one.truth.hack, one.truth.reward, task.reward, one.truth.goal, one_each, 0.0 * one_each]
    scored = jnp.stack([c.astype(jnp.float32) for c in columns], axis=-1).reshape(states * actions, len(LOG))
    centre = one.ratings.centre.reshape(states * actions, raters)
    deviation = one.ratings.deviation.reshape(states * actions, raters)
    agent_words = tabular.words(agent)
    rater_words = raters + 1 if listens else 0
    asks = agent.abstention is not None and agent.abstention.response == "ask"
    skips = agent.abstention is not None and agent.abstention.response == "skip"

    def heard(rows: Array) -> Feedback:
        return running.read(rows, raters)

    def usual(feedback: Array) -> Any:
        return mitigation.usual(heard(feedback), feedback[..., 0] > 0)

    def choose(c: _Carry, explore: Array, random_action: Array) -> tuple[Array, Array]:
        mu, sigma_m = tabular.mean_and_deviation(c.row)
        scores = mitigation.score(mu, sigma_m, heard(at(c.feedback, c.state)), c.usual)
        best = jnp.argmax(scores).astype(jnp.int32)
        abstained = jnp.float32(0.0)
        if agent.abstention is not None:
            feedback = heard(at(c.feedback, c.state))
            u = 0.5 * sigma_m + 0.5 * jnp.where(feedback.count > 0, feedback.spread, 0.0)
            defers = agent.abstention.abstains(u[best], mu[best])
            abstained = defers.astype(jnp.float32)
            if agent.abstention.response == "safe":
                best = jnp.where(defers, jnp.argmin(u).astype(jnp.int32), best)
        return jnp.where(explore < c.epsilon, random_action, best), abstained

    def one_step(c: _Carry, draws: Any) -> tuple[_Carry, None]:
        own, noise, rated = draws
        action, abstained = choose(c, own.explore, own.action)
        if listens:
            action = lax.optimization_barrier(action)
        old = at(c.row, action)
        _, sigma_m = tabular.mean_and_deviation(old)
        if task.doubt is not None:
            sigma_m = jnp.hypot(sigma_m, at(at(task.doubt, c.state), action))
        state2, reward, terminated, truncated = step(task, c.state, c.time, action)
        place = c.state * actions + action
        active = (c.episode < program.episodes).astype(jnp.float32)

        feedback = c.feedback
        if listens:
            spoken = at(centre, place) + at(deviation, place) * noise
            rated = jnp.maximum(rated, abstained) if asks else rated
            if one.ratings.reach is not None:
                rated = rated * at(at(one.ratings.reach, c.state), action)
            entry = running.updated(
                at(at(feedback, c.state), action),
                running.summarise(spoken, program.ddof),
                reward,
                rated * active,
            )
            entry = lax.optimization_barrier(entry)
            feedback = lax.dynamic_update_slice(feedback, entry[None, None], (c.state, action, 0))
            known = heard(entry)
        else:
            known = heard(at(at(feedback, c.state), action))
        signal = mitigation.signal(Evidence(reward, sigma_m, known), c.usual)

        signal = lax.optimization_barrier(signal)

        following = at(c.q, state2)
        if mitigation.backup == "greedy":
            value = following.max(0)
        else:
            mu2, sigma2 = tabular.mean_and_deviation(following)
            best2 = jnp.argmax(mitigation.score(mu2, sigma2, heard(at(feedback, state2)), c.usual))
            value = at(following, lax.optimization_barrier(best2))
        target = signal.reward + jnp.where(terminated, 0.0, agent.gamma * value)
        rate = agent.learning_rate * active * signal.sample_weight * own.mask
        if skips:
            rate = rate * (1.0 - abstained)
        # The barriers keep XLA from computing these again inside the writes below, which would then need a copy
        # of the whole table at every step.
        target = lax.optimization_barrier(target)
        q = lax.dynamic_update_slice(c.q, (old + rate * (target - old))[None, None], (c.state, action, 0))

        done = jnp.logical_or(terminated, truncated)
        counted = at(scored, place)
        if agent.abstention is not None:
            counted = jnp.where(jnp.arange(len(LOG)) == LOG.index("abstained"), abstained, counted)
        sums = c.sums + counted
        log = lax.dynamic_update_slice(c.log, sums[None], (jnp.minimum(c.episode, program.episodes), 0))
        episode = c.episode + done.astype(jnp.int32)
        state = jnp.where(done, at(starts, episode % starts.shape[0]), state2)
        return _Carry(
            q=q,
            row=at(q, state),
            feedback=feedback,
            usual=c.usual,
            state=state,
            time=jnp.where(done, 0, c.time + 1),
            episode=episode,
            epsilon=jnp.where(done, tabular.next_epsilon(agent, c.epsilon), c.epsilon),
            sums=jnp.where(done, 0.0, sums),
            log=log,
            steps=c.steps + active.astype(jnp.int32),
        ), None

    def chunk(loop: tuple[_Carry, Array, Array, Array]) -> tuple[_Carry, Array, Array, Array]:
        c, number, q_kept, f_kept = loop
        key = jax.random.wrap_key_data(jnp.stack([one.seed, number]), impl="threefry2x32")
        bits = jax.random.bits(key, (CHUNK, agent_words + rater_words), jnp.uint32)
        own = tabular.draw(agent, bits[:, :agent_words], actions)
        noise, rated = jnp.zeros((CHUNK, 0)), jnp.zeros((CHUNK, 0))
        if listens:
            noise = _normal(bits[:, agent_words:-1])
            rated = (tabular.uniform(bits[:, -1]) < one.rated).astype(jnp.float32)
            c = c._replace(usual=usual(c.feedback))
        slot = c.episode * program.snapshots // program.episodes
        c, _ = lax.scan(one_step, c, (own, noise, rated))
        if program.snapshots:
            # A chunk can pass over several slots, so all that are left are filled; the next chunk overwrites them.
            later = (jnp.arange(program.snapshots) >= slot)[:, None, None, None]
            q_kept = jnp.where(later, c.q, q_kept)
            f_kept = jnp.where(later, c.feedback, f_kept)
        return c, number + 1, q_kept, f_kept

    key = jax.random.wrap_key_data(jnp.stack([one.seed, jnp.uint32(0)]), impl="threefry2x32")
    q = tabular.init(agent, key, states, actions)
    feedback = running.empty(states, actions)
    start = _Carry(
        q=q,
        row=q[starts[0]],
        feedback=feedback,
        usual=usual(feedback),
        state=starts[0],
        time=jnp.int32(0),
        episode=jnp.int32(0),
        epsilon=jnp.float32(agent.epsilon),
        sums=jnp.zeros(len(LOG), jnp.float32),
        log=jnp.zeros((program.episodes + 1, len(LOG)), jnp.float32),
        steps=jnp.int32(0),
    )
    kept = jnp.zeros((program.snapshots, *q.shape)), jnp.zeros((program.snapshots, *feedback.shape))
    c, _, q_kept, f_kept = lax.while_loop(
        lambda loop: loop[0].episode < program.episodes, chunk, (start, jnp.uint32(1), *kept)
    )
    return Outcome(c.log[:-1], c.steps, c.q, c.feedback, q_kept, f_kept)


# Giles' single-precision polynomials for the inverse error function, near the centre and in the tails.
_CENTRE = (
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
    0.246640727, 1.50140941,
)  # fmt: skip
_TAIL = (
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
    1.00167406, 2.83297682,
)  # fmt: skip


def _normal(bits: Array) -> Array:
    """Turn 32 random bits into a standard normal, never beyond +-5.3, by the inverse of its distribution function.

    The probability keeps 23 bits and lies in the middle of its interval, so that it never rounds to 0 or 1.
    """
    p = ((bits >> 9).astype(jnp.float32) + jnp.float32(0.5)) * jnp.float32(2.0**-23)
    w = -jnp.log(4.0 * p * (1.0 - p))
    tail = w >= 5.0
    w = jnp.where(tail, jnp.sqrt(w) - 3.0, w - 2.5)
    y = jnp.zeros_like(w)
    for centre, far in zip(_CENTRE, _TAIL, strict=True):
        y = y * w + jnp.where(tail, jnp.float32(far), jnp.float32(centre))
    return jnp.float32(np.sqrt(2.0)) * y * (2.0 * p - 1.0)
