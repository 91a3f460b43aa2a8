"""PPO, TRPO and CPO on a simulator: a piece of the run is one rollout and its update."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from uard.agents import heads, networks
from uard.agents.networks import Network
from uard.agents.policy import Experience, PolicyGradient
from uard.envs.simulator import Simulator, StepResult
from uard.method.mitigations import Evidence
from uard.training.compiled.common import all_finite
from uard.training.episode_log import LOG
from uard.training.feedback import transition_model as transitions
from uard.training.host import loop
from uard.training.host.loop import EpisodeLog, Fixed, Job, Loop, Norm, TrainState


class _Rollout(NamedTuple):
    """T steps of E copies, on the host.

    Attributes:
        observations: (T + 1, E, F), before each step and after the last.
        actions: (T, E, D), not clipped.
        steps: What each step led to.
        result: The same, stacked: leaves (T, E, ...).
    """

    observations: np.ndarray
    actions: np.ndarray
    steps: list[StepResult]
    result: StepResult


@final
class OnPolicyLoop(Loop):
    """The loop of agents that learn from what they just did."""

    def __init__(self, job: Job):
        """Bind a run."""
        self.job, self.copies = job, job.agent.envs
        self._width = transitions.width(job.environment.features, job.environment.actions)

    def start(self, simulator: Simulator) -> TrainState:
        """Return the first state."""
        job, environment = self.job, self.job.environment
        model, reservoir = loop.fresh_feedback(job)
        key = loop.key_of(job.seed, loop.INIT)
        return TrainState(
            agent=job.agent.init(key, environment.features, environment.actions, continuous=True),
            norm=Norm.start(environment.features),
            model=model,
            reservoir=reservoir,
            extra=(),
            simulator=simulator.save(),
            sums=np.zeros((self.copies, len(LOG))),
            log=np.zeros((0, len(LOG) + 1)),
            steps=np.int64(0),
        )

    def advance(self, state: TrainState, simulator: Simulator) -> TrainState:
        """Roll out, collect ratings, filter the rewards and update; then log."""
        number = int(state.steps) // (self.copies * self.job.agent.rollout)
        log = EpisodeLog(state.sums, int(state.steps))
        rollout = self._roll_out(state, simulator, number, log)
        inputs = self._inputs(rollout)
        model = self._collect_ratings(state, rollout, inputs, number)
        learner = self._update(state, rollout, inputs, model, number)
        return TrainState(
            agent=learner,
            # Not before: an update needs the observations as the policy that took the actions saw them.
            norm=state.norm.after(np.concatenate(rollout.observations[:-1])),
            model=model,
            reservoir=state.reservoir,
            extra=(),
            simulator=simulator.save(),
            sums=log.sums,
            log=log.all(state.log),
            steps=np.int64(log.steps),
        )

    def _roll_out(self, state: TrainState, simulator: Simulator, number: int, log: EpisodeLog) -> _Rollout:
        """Let the policy act for a rollout."""
        agent = self.job.agent
        keys = jax.random.split(loop.key_of(self.job.seed, loop.ACT, number), agent.rollout)
        observations, actions, steps = [simulator.observe()], [], []
        for t in range(agent.rollout):
            normal = state.norm.of(observations[-1])
            action = np.asarray(_act(state.agent.policy, normal, keys, t, network=agent.network))
            steps.append(simulator.step(np.clip(action, -1.0, 1.0)))
            log.add(steps[-1])
            actions.append(action)
            observations.append(simulator.observe())
        result = StepResult(*(np.stack(column) for column in zip(*steps, strict=True)))
        return _Rollout(np.stack(observations), np.stack(actions), steps, result)

    def _inputs(self, rollout: _Rollout) -> np.ndarray:
        """Return what the model of ratings sees: what was done, actions within their bounds, in the world's units."""
        result = rollout.result
        actions = np.clip(rollout.actions, -1.0, 1.0)
        inputs = transitions.features(rollout.observations[:-1], actions, result.observation, result.reward)
        return inputs.astype(np.float32)

    def _collect_ratings(self, state: TrainState, rollout: _Rollout, inputs: np.ndarray, number: int) -> Any:
        """Put the rollout to the panel, and return the model of ratings fitted to all that was said so far."""
        job, reservoir = self.job, state.reservoir
        if not job.asks_raters:
            return state.model
        loop.collect_ratings(job, state, rollout.steps, inputs, number)
        key = loop.key_of(job.seed, loop.MODEL, number + 1)
        return transitions.fit(job.rating_model, state.model, reservoir, key)

    def _update(self, state: TrainState, rollout: _Rollout, inputs: np.ndarray, model: Any, number: int) -> Any:
        """Return the agent after it has learned from the filtered rewards of a rollout."""
        job, result = self.job, rollout.result
        asks = job.asks_raters
        learner, fine = _learn(
            state.agent,
            model,
            state.reservoir.inputs if asks else np.zeros((1, self._width), np.float32),
            np.asarray(state.reservoir.seen[0] if asks else 0),
            state.norm.of(rollout.observations[:-1]),
            rollout.actions,
            state.norm.of(result.observation),
            inputs,
            (result.reward, result.hack, result.terminated, result.truncated),
            loop.key_of(job.seed, loop.LEARN, number),
            job=job.fixed,
        )
        if not fine:
            raise FloatingPointError("the agent's parameters or its reward left the finite numbers")
        return learner

    def act(self, state: TrainState, observations: np.ndarray) -> np.ndarray:
        """Return the most likely actions, (B, actions)."""
        normal = state.norm.of(observations)
        return np.asarray(_likeliest(state.agent.policy, normal, network=self.job.agent.network))

    def values(self, state: TrainState, observations: np.ndarray) -> np.ndarray:
        """Return all critics' values, (N, B)."""
        key = loop.key_of(self.job.seed, loop.EVALUATION)  # of dropout
        return np.asarray(_values(state.agent, state.norm.of(observations), key, agent=self.job.agent))


@partial(jax.jit, static_argnames="network")
def _act(policy: Any, observations: Array, keys: Array, t: int, *, network: Network) -> Array:
    # The key is taken here: outside, that costs more than the policy.
    return heads.draw(heads.action_distribution(network, policy, observations), keys[t])


@partial(jax.jit, static_argnames="network")
def _likeliest(policy: Any, observations: Array, *, network: Network) -> Array:
    return heads.likeliest(heads.action_distribution(network, policy, observations))


@partial(jax.jit, static_argnames="agent")
def _values(state: Any, observations: Array, key: Array, *, agent: PolicyGradient) -> Array:
    return agent.values(state, observations, key)


@partial(jax.jit, static_argnames="job")
def _learn(
    state: Any,
    model: Any,
    sample: Array,
    seen: Array,
    observation: Array,
    action: Array,
    next_observation: Array,
    inputs: Array,
    results: Any,
    key: Array,
    *,
    job: Fixed,
) -> tuple[Any, Array]:
    """Filter the rewards of a rollout (T, E, ...) and learn from them; also say whether all is finite."""
    agent, mitigation, rating_model, asks_raters, raters, horizon = job
    reward, hack, terminated, truncated = (jnp.asarray(x) for x in results)
    reward = reward.astype(jnp.float32)
    value_key, learn_key = jax.random.split(key)
    shape = reward.shape
    total = reward.size

    def flat(x: Array) -> Array:
        return x.reshape(total, *x.shape[2:])

    both = agent.values(state, jnp.concatenate([flat(observation), flat(next_observation)]), value_key)
    values, next_values = both[:, :total], both[:, total:]
    ahead = jnp.where(flat(terminated), 0.0, agent.gamma * networks.mean_and_deviation(next_values)[1])
    statistics = transitions.panel_statistics(mitigation, rating_model, model, sample, seen, raters)
    if asks_raters:
        feedback = transitions.read(rating_model, model, flat(inputs), raters)
    else:
        feedback = transitions.nothing(total)
    statistics = transitions.expecting(statistics, feedback)
    signal = mitigation.signal(Evidence(flat(reward), ahead, feedback), statistics)

    def score_fn(q: Array) -> Array:
        return mitigation.score(q.reshape(total), ahead, feedback, statistics, one_action=True).reshape(q.shape)

    learned = jnp.asarray(signal.reward, jnp.float32).reshape(shape)
    experience = Experience(
        observation=observation,
        action=action,
        next_observation=next_observation,
        reward=learned,
        weight=jnp.broadcast_to(jnp.asarray(signal.sample_weight, jnp.float32), (total,)).reshape(shape),
        cost=hack.astype(jnp.float32) if agent.needs_cost else jnp.zeros(shape, jnp.float32),
        terminated=terminated,
        done=terminated | truncated,
        values=values.reshape(-1, *shape),
        next_values=next_values.reshape(-1, *shape),
        horizon=jnp.asarray(horizon),
        score_fn=score_fn,
    )
    learner, info = agent.update(state, experience, learn_key)
    return learner, all_finite((info.loss, learned, learner))
