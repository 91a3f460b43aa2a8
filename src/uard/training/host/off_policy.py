"""SAC and its family on a simulator: a piece of the run is some steps, and as many updates in one call."""

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


class Buffer(NamedTuple):
    """Transitions, on the device: (M, F) observations before and after, (M, D) actions, (M,) reward and end."""

    observation: Any
    action: Any
    next_observation: Any
    reward: Any
    terminated: Any


class Kept(NamedTuple):
    """What the loop keeps besides: the buffer, and the panel's statistics."""

    buffer: Buffer
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
            extra=Kept(buffer, self._panel_statistics(model, reservoir)),
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
        learner, buffer = self._update(state, row, model, statistics, number)
        return state._replace(
            agent=learner,
            model=model,
            extra=Kept(buffer, statistics),
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

    def _panel_statistics(self, model: Any, reservoir: Any) -> Any:
        known = (reservoir.inputs, reservoir.seen[0]) if reservoir else self._unknown()
        return _panel_statistics(model, *known, job=self._fixed)

    def _unknown(self) -> tuple[np.ndarray, np.int64]:
        return np.zeros((1, self._width), np.float32), np.int64(0)

    def _update(self, state: TrainState, row: Buffer, model: Any, statistics: Any, number: int) -> tuple[Any, Buffer]:
        """Return the agent after as many updates as there were steps, and the buffer with these steps."""
        done = int(state.steps)
        learner, buffer, fine = _learn(
            state.agent,
            state.extra.buffer,
            row,
            np.int32(done),
            model,
            statistics,
            loop.key_of(self.job.seed, loop.LEARN, number),
            job=self._fixed,
            learns=done + PIECE > self.job.agent.warmup,
        )
        if not fine:
            raise FloatingPointError("the agent's parameters or its values left the finite numbers")
        return learner, buffer

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


@partial(jax.jit, static_argnames=("job", "learns"), donate_argnums=(0, 1))
def _learn(
    state: Any,
    buffer: Buffer,
    row: Buffer,
    done: Array,
    model: Any,
    statistics: Any,
    key: Array,
    *,
    job: Fixed,
    learns: bool,
) -> tuple[Any, Buffer, Array]:
    """Put a piece's transitions into the buffer, and take as many updates; also say whether all is finite."""
    agent, mitigation, rating_model, asks_raters, raters, _ = job
    slots = buffer.reward.shape[0]
    count = row.reward.shape[0]
    buffer = jax.tree.map(lambda kept, new: lax.dynamic_update_slice_in_dim(kept, new, done % slots, 0), buffer, row)
    if not learns:
        return state, buffer, jnp.asarray(True)
    filled = jnp.minimum(done + count, slots)

    def draw(key: Array) -> tuple[Buffer, Array, Array]:
        draw_key, mask_key, learn_key = jax.random.split(key, 3)
        places = jax.random.randint(draw_key, (agent.batch,), 0, filled)
        return jax.tree.map(lambda x: x[places], buffer), mask_key, learn_key

    def rated(drawn: Buffer) -> Any:
        """Return the feedback of all batches, which the model predicts at once: large products take half the time."""
        if not asks_raters:
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), transitions.nothing(agent.batch))
        flat: Buffer = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), drawn)
        inputs = transitions.features(flat.observation, flat.action, flat.next_observation, flat.reward)
        feedback = transitions.read(rating_model, model, inputs, raters)
        return feedback.map(lambda x: x.reshape(count, agent.batch, *x.shape[1:]))

    def update(state: Any, given: tuple[Buffer, Any, Array, Array]) -> tuple[Any, Array]:
        drawn, feedback, mask_key, learn_key = given
        expected = transitions.expecting(statistics, feedback)

        def reward_fn(sigma_m: Array) -> LearningSignal:
            return mitigation.signal(Evidence(drawn.reward, sigma_m, feedback), expected)

        def score_fn(mu: Array, sigma_m: Array) -> Array:
            return mitigation.score(mu, sigma_m, feedback, expected, one_action=True)

        mask = (jax.random.uniform(mask_key, (agent.batch, agent.members)) < agent.bootstrap).astype(jnp.float32)
        batch = Transitions(drawn.observation, drawn.action, drawn.next_observation, drawn.terminated, mask)
        state, info = agent.update(state, batch, reward_fn, score_fn, learn_key)
        return state, info.loss

    drawn, mask_keys, learn_keys = jax.vmap(draw)(jax.random.split(key, count))
    state, losses = lax.scan(update, state, (drawn, rated(drawn), mask_keys, learn_keys))
    return state, buffer, jnp.isfinite(losses).all()
