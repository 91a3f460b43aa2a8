"""SAC and its family on a simulator: a piece of the run is some steps, and as many updates in one call.

What the model of ratings predicts of a transition changes when the model is fitted, not when the transition is drawn.
So a prediction stands in the buffer beside its transition, and is made anew when it is drawn after another fit.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from uard.agents.continuous import ContinuousActorCritic
from uard.agents.off_policy import Transitions
from uard.envs.simulator import Simulator, StepResult
from uard.method.mitigations import Evidence, LearningSignal
from uard.training.episode_log import LOG
from uard.training.feedback import transition_model as transitions
from uard.training.host import loop
from uard.training.host.loop import EpisodeLog, Fixed, Job, Loop, Norm, TrainState

PIECE = 32  # steps between calls of the compiled update
FIT_EVERY = 64  # pieces between fits of the model of ratings: 2048 steps
BLOCK = 256  # transitions that are predicted together


class Buffer(NamedTuple):
    """Transitions, on the device: (M, F) observations before and after, (M, D) actions, (M,) reward and end."""

    observation: Any
    action: Any
    next_observation: Any
    reward: Any
    terminated: Any


class Predicted(NamedTuple):
    """What is predicted of every transition in the buffer: feedback (M, ...), and after which fit it was, -1 never."""

    feedback: Any
    fit: Any


class Kept(NamedTuple):
    """What the loop keeps besides: the buffer, what is predicted of it, and the panel's statistics."""

    buffer: Buffer
    predicted: Any
    statistics: Any


@final
class OffPolicyLoop(Loop):
    """The loop of agents that learn from a replay buffer; it steps one copy."""

    def __init__(self, job: Job):
        """Bind a run."""
        self.job, self.copies = job, 1
        self._fixed = job.fixed
        self._width = transitions.width(job.environment.features, job.environment.actions)
        # Whole pieces: one that began before the end of the buffer and went beyond it would be written elsewhere.
        self._slots = -(-min(job.agent.buffer, job.steps) // PIECE) * PIECE

    def start(self, simulator: Simulator) -> TrainState:
        """Return the first state."""
        job, environment = self.job, self.job.environment
        model, reservoir = loop.fresh_feedback(job)
        sizes = (environment.features,), (environment.actions,), (environment.features,), ()
        columns = (jnp.zeros((self._slots, *size), jnp.float32) for size in sizes)
        buffer = Buffer(*columns, terminated=jnp.zeros(self._slots, bool))
        return TrainState(
            agent=job.agent.init(loop.key_of(job.seed, loop.INIT), environment.features, environment.actions),
            norm=Norm.start(environment.features),
            model=model,
            reservoir=reservoir,
            extra=Kept(buffer, self._no_predictions(model), self._panel_statistics(model, reservoir)),
            simulator=simulator.save(),
            sums=np.zeros((1, len(LOG))),
            log=np.zeros((0, len(LOG) + 1)),
            steps=np.int64(0),
        )

    def advance(self, state: TrainState, simulator: Simulator) -> TrainState:
        """Take some steps, collect ratings, and make as many updates on filtered rewards; then log."""
        number = int(state.steps) // PIECE
        log = EpisodeLog(state.sums, int(state.steps))
        row, results = self._step(state, simulator, number, log)
        model, statistics = self._collect_ratings(state, row, results, number)
        learner, buffer, predicted = self._update(state, row, model, statistics, number)
        return state._replace(
            agent=learner,
            model=model,
            extra=Kept(buffer, predicted, statistics),
            simulator=simulator.save(),
            sums=log.sums,
            log=log.all(state.log),
            steps=np.int64(log.steps),
        )

    def _step(
        self, state: TrainState, simulator: Simulator, number: int, log: EpisodeLog
    ) -> tuple[Buffer, list[StepResult]]:
        """Let the agent act for a piece; during the warm-up its actions are uniformly random."""
        agent, done = self.job.agent, int(state.steps)
        random = loop.generator(self.job.seed, loop.ACT, number)
        keys = jax.random.split(loop.key_of(self.job.seed, loop.ACT, number), PIECE)
        observations, actions, results = [], [], []
        for t in range(PIECE):
            observation = simulator.observe()
            if done + t < agent.warmup:
                action = random.uniform(-1.0, 1.0, (1, self.job.environment.actions))
            else:
                action = np.asarray(_act(state.agent, observation.astype(np.float32), keys, t, agent=agent))
            results.append(simulator.step(action))
            log.add(results[-1])
            observations.append(observation)
            actions.append(action)
        row = Buffer(
            np.concatenate(observations).astype(np.float32),
            np.concatenate(actions).astype(np.float32),
            np.concatenate([r.observation for r in results]).astype(np.float32),
            np.concatenate([r.reward for r in results]).astype(np.float32),
            np.concatenate([r.terminated for r in results]),
        )
        return row, results

    def _collect_ratings(
        self, state: TrainState, row: Buffer, results: list[StepResult], number: int
    ) -> tuple[Any, Any]:
        """Put the piece to the panel; now and then fit the model of ratings and the panel's statistics anew."""
        job, model, statistics = self.job, state.model, state.extra.statistics
        if not job.asks_raters:
            return model, statistics
        inputs = transitions.features(row.observation, row.action, row.next_observation, row.reward)
        loop.collect_ratings(job, state, results, inputs[:, None], number)
        if number % FIT_EVERY == FIT_EVERY - 1:
            key = loop.key_of(job.seed, loop.MODEL, number + 1)
            reservoir = state.reservoir
            model = transitions.fit(job.rating_model, model, reservoir, key)
            statistics = self._panel_statistics(model, reservoir)
        return model, statistics

    def _no_predictions(self, model: Any) -> Any:
        """Return room for a prediction of every transition; () for a mitigation that asks nobody."""
        if not self.job.asks_raters:
            return ()
        inputs = jax.ShapeDtypeStruct((self._slots, self._width), jnp.float32)
        read = partial(transitions.read, self.job.rating_model, model, raters=self._fixed.raters)
        feedback = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(read, inputs))
        return Predicted(feedback, jnp.full(self._slots, -1, jnp.int32))

    def _panel_statistics(self, model: Any, reservoir: Any) -> Any:
        known = (reservoir.inputs, reservoir.seen[0]) if reservoir else self._unknown()
        return _panel_statistics(model, *known, job=self._fixed)

    def _unknown(self) -> tuple[np.ndarray, np.int64]:
        return np.zeros((1, self._width), np.float32), np.int64(0)

    def _update(
        self, state: TrainState, row: Buffer, model: Any, statistics: Any, number: int
    ) -> tuple[Any, Buffer, Any]:
        """Return the agent after as many updates as there were steps, the buffer with these steps, and predictions."""
        done = int(state.steps)
        learner, buffer, predicted, fine = _learn(
            state.agent,
            state.extra.buffer,
            state.extra.predicted,
            row,
            np.int32(done),
            np.int32((number + 1) // FIT_EVERY),
            model,
            statistics,
            loop.key_of(self.job.seed, loop.LEARN, number),
            job=self._fixed,
            learns=done + PIECE > self.job.agent.warmup,
        )
        if not fine:
            raise FloatingPointError("the agent's parameters or its values left the finite numbers")
        return learner, buffer, predicted

    def act(self, state: TrainState, observations: np.ndarray) -> np.ndarray:
        """Return the policy's middle actions, (B, actions)."""
        return np.asarray(_greedy(state.agent, observations.astype(np.float32), agent=self.job.agent))

    def values(self, state: TrainState, observations: np.ndarray) -> np.ndarray:
        """Return all critics' values, (N, B)."""
        return np.asarray(_values(state.agent, observations.astype(np.float32), agent=self.job.agent))


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
def _panel_statistics(model: Any, sample: Array, seen: Array, *, job: Fixed) -> Any:
    return transitions.panel_statistics(job.mitigation, job.rating_model, model, sample, seen, job.raters)


@partial(jax.jit, static_argnames=("job", "learns"), donate_argnums=(0, 1, 2))
def _learn(
    state: Any,
    buffer: Buffer,
    predicted: Any,
    row: Buffer,
    done: Array,
    fits: Array,
    model: Any,
    statistics: Any,
    key: Array,
    *,
    job: Fixed,
    learns: bool,
) -> tuple[Any, Buffer, Any, Array]:
    """Put a piece's transitions into the buffer, and take as many updates; also say whether all is finite."""
    agent, mitigation, rating_model, asks_raters, raters, _ = job
    slots = buffer.reward.shape[0]
    count = row.reward.shape[0]
    place = done % slots
    buffer = jax.tree.map(lambda kept, new: lax.dynamic_update_slice_in_dim(kept, new, place, 0), buffer, row)
    if asks_raters:
        fresh = lax.dynamic_update_slice_in_dim(predicted.fit, jnp.full(count, -1, jnp.int32), place, 0)
        predicted = predicted._replace(fit=fresh)
    if not learns:
        return state, buffer, predicted, jnp.asarray(True)
    filled = jnp.minimum(done + count, slots)

    def draw(key: Array) -> tuple[Array, Array, Array]:
        draw_key, mask_key, learn_key = jax.random.split(key, 3)
        return jax.random.randint(draw_key, (agent.batch,), 0, filled), mask_key, learn_key

    def update(state: Any, given: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        places, mask_key, learn_key = given
        drawn: Buffer = jax.tree.map(lambda x: x[places], buffer)
        feedback = predicted.feedback.map(lambda x: x[places]) if asks_raters else transitions.nothing(agent.batch)
        expected = transitions.expecting(statistics, feedback)

        def reward_fn(sigma_m: Array) -> LearningSignal:
            return mitigation.signal(Evidence(drawn.reward, sigma_m, feedback), expected)

        def score_fn(mu: Array, sigma_m: Array) -> Array:
            return mitigation.score(mu, sigma_m, feedback, expected, one_action=True)

        mask = (jax.random.uniform(mask_key, (agent.batch, agent.members)) < agent.bootstrap).astype(jnp.float32)
        batch = Transitions(drawn.observation, drawn.action, drawn.next_observation, drawn.terminated, mask)
        state, info = agent.update(state, batch, reward_fn, score_fn, learn_key)
        return state, info.loss

    batches = jax.vmap(draw)(jax.random.split(key, count))
    if asks_raters:
        read = partial(transitions.read, rating_model, model, raters=raters)
        predicted = _predicted(read, buffer, predicted, batches[0].reshape(-1), fits)
    state, losses = lax.scan(update, state, batches)
    return state, buffer, predicted, jnp.isfinite(losses).all()


def _predicted(read: Any, buffer: Buffer, predicted: Predicted, places: Array, fits: Array) -> Predicted:
    """Return the predictions, anew in those of some places that were made before the latest fit."""
    stale = predicted.fit[places] != fits
    (order,) = jnp.nonzero(stale, size=places.size + BLOCK, fill_value=places.size)
    # Beyond the end, so that nothing is written there.
    order = jnp.append(places, jnp.full(1, buffer.reward.shape[0]))[order]

    def body(i: Array, predicted: Predicted) -> Predicted:
        block = lax.dynamic_slice_in_dim(order, i * BLOCK, BLOCK)
        rows: Buffer = jax.tree.map(lambda x: x[block], buffer)
        found = read(transitions.features(rows.observation, rows.action, rows.next_observation, rows.reward))
        new = Predicted(found, jnp.full(BLOCK, fits))
        return jax.tree.map(lambda x, y: x.at[block].set(y, mode="drop"), predicted, new)

    return lax.fori_loop(0, -(-stale.sum() // BLOCK), body, predicted)
