"""The filter in Stable-Baselines3: buffers, a wrapper for its environments, a callback that reports.

On-policy (PPO, A2C, sb3-contrib's TRPO): let the rollout buffer filter, a rollout at a time::

    PPO("MlpPolicy", env, rollout_buffer_class=ReliabilityRolloutBuffer).learn(100_000, callback=ReliabilityCallback())

or, where rewards are normalised or observations are dictionaries, wrap the environments, before any ``VecNormalize``::

    env = VecNormalize(ReliabilityVecEnv(make_vec_env(...)))
    PPO("MlpPolicy", env).learn(100_000, callback=ReliabilityCallback())

Off-policy (DQN, SAC, TD3): let the replay buffer filter when it is sampled, so that old steps are judged by what is
known now, and by the critics as they are now::

    DQN("MlpPolicy", env, replay_buffer_class=ReliabilityReplayBuffer).learn(100_000, callback=ReliabilityCallback())

Ratings come from ``info["ratings"]`` or from a callable. ``rollout/ep_rew_mean`` is what the Monitor saw: the raw
return where it is inside ``ReliabilityVecEnv``, as ``make_vec_env`` has it. The callback logs ``uard/raw_return`` and
``uard/filtered_return`` beside each other.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.gymnasium import ReliabilityWrapper
from uard.adapters.steps import (
    INFO,
    KeyFn,
    RatingsFn,
    SigmaFn,
    Steps,
    arrays_of,
    batch_of,
    natural_key,
    with_row,
)
from uard.method.abstention import Abstention
from uard.method.mitigations import Mitigation
from uard.ratings.stream import Filtered, RewardStream

try:
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"uard.adapters.sb3 needs Stable-Baselines3: pip install 'uard[sb3]' ({error})", name=error.name
    ) from error

from uard.adapters.sb3_buffers import (
    ReliabilityReplayBuffer,
    ReliabilityRolloutBuffer,
    ratings_in,
    refuse_filtered_infos,
)
from uard.adapters.sb3_critics import CriticDisagreement, critics_of

__all__ = [
    "CriticDisagreement",
    "ReliabilityCallback",
    "ReliabilityReplayBuffer",
    "ReliabilityRolloutBuffer",
    "ReliabilityVecEnv",
    "critics_of",
]

EVERY = 16  # the callback logs one step of so many; of a replay buffer, which must judge a batch for it, an eighth


class ReliabilityVecEnv(VecEnvWrapper):
    """Emits filtered rewards; ``infos[i]`` also holds what ``uard.adapters.gymnasium.ReliabilityWrapper`` puts there.

    Examples:
        >>> import uard.envs
        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> env = ReliabilityVecEnv(make_vec_env("uard/TrapGrid6-v0", n_envs=2, env_kwargs={"panel": "main"}))
        >>> observations = env.reset()
        >>> observations, rewards, dones, infos = env.step(np.array([3, 1]))
        >>> rewards.shape, "weight" in infos[0]
        ((2,), True)

    Attributes:
        steps: What filters; one for all environments.
        latest: The rewards of the latest step.
    """

    def __init__(
        self,
        venv: VecEnv,
        mitigation: Mitigation | None = None,
        *,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
        abstention: Abstention | None = None,
    ):
        """Wrap environments; the arguments are those of ``uard.adapters.gymnasium.ReliabilityWrapper``.

        Raises:
            InvalidValueError: if rewards arrive normalised (``VecNormalize`` goes outside) or filtered.
        """
        _refuse_changed(venv)
        cast("Any", super()).__init__(venv)  # its signature holds types of unknown parameters
        spaces: Any = venv
        key = key or natural_key(spaces.observation_space, spaces.action_space)
        self.steps = Steps(RewardStream(mitigation, abstention=abstention), ratings, sigma_m, key)
        self.latest: Filtered | None = None
        self._observation: Any = None
        self._actions: Any = None
        self._started = False
        self._returns = np.zeros((2, venv.num_envs))

    def reset(self) -> Any:
        """Start all episodes; all ratings are remembered."""
        observation = self.venv.reset()
        self._observation, self._started = self._seen(observation), True
        self._returns[:] = 0.0
        return observation

    def _seen(self, observation: Any) -> Any:
        """Return a batch of observations, copied; None if nobody looks at it."""
        return arrays_of(cast("Any", self.venv).observation_space, observation) if self.steps.reads_steps else None

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions.

        Raises:
            ResetNeeded: before the first ``reset``.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("call reset() of the ReliabilityVecEnv before step()")
        self._actions = np.array(actions)
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Return observations, filtered rewards, dones and infos.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed; names the environment.
        """
        venv: Any = self.venv
        next_observation, rewards, dones, infos = venv.step_wait()
        refuse_filtered_infos(infos)
        seen = self._seen(next_observation)
        reached, space = seen, cast("Any", self.venv).observation_space
        if self.steps.ratings is not None:  # which is asked about what the steps led to, before any reset
            for i in np.flatnonzero(dones):
                reached = with_row(reached, i, batch_of(space, infos[i]["terminal_observation"]))
        observed = _checks.as_numpy("reward", rewards)
        out = self.steps.filter(self._observation, self._actions, reached, observed, ratings_in(infos))
        learned = _checks.fitting("filtered reward", out.reward, np.float32)
        self.latest = out
        self._returns[0] += out.raw
        self._returns[1] += out.reward
        columns = {name: getattr(out, where).tolist() for name, where in INFO.items()}
        infos = [dict(info) for info in infos]  # an environment may give the same one again
        for i, info in enumerate(infos):
            for name, values in columns.items():
                info[name] = values[i]
            if dones[i]:
                info["raw_return"], info["filtered_return"] = self._returns[:, i].tolist()
                self._returns[:, i] = 0.0
        self._observation = seen
        return next_observation, learned, dones, infos

    def save(self, path: str | Path) -> None:
        """Write all that is known of rewards and ratings to a file, for ``load``; see ``RewardStream.save``."""
        self.steps.stream.save(path)

    @classmethod
    def load(
        cls,
        path: str | Path,
        venv: VecEnv,
        mitigation: Mitigation | None = None,
        *,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
    ) -> ReliabilityVecEnv:
        """Wrap environments with what ``save`` wrote; nothing in the file is executed.

        Args:
            path: The file.
            venv: The environments.
            mitigation: Needed if the one that was saved is not uard's own.
            ratings: As for a new wrapper, as are the next two; functions are not saved.
            sigma_m: See there.
            key: See there.

        Raises:
            InvalidValueError: the file holds something else, or its mitigation must be given.
        """
        stream = RewardStream.load(path, mitigation)
        env = cls(venv, stream.mitigation, ratings=ratings, sigma_m=sigma_m, key=key)
        env.steps.stream = stream
        return env


def _refuse_changed(venv: Any) -> None:
    """Refuse environments whose rewards are normalised or filtered, as far as that can be seen from outside."""
    inner = venv
    while isinstance(inner, VecEnvWrapper):
        if isinstance(inner, VecNormalize) and inner.norm_reward:
            allowed = "VecNormalize(ReliabilityVecEnv(venv)): ratings are not in normalised units"
            raise _checks.InvalidValueError("venv", type(inner).__name__, allowed)
        if isinstance(inner, ReliabilityVecEnv):
            allowed = "environments without one: rewards would be filtered twice"
            raise _checks.InvalidValueError("venv", type(inner).__name__, allowed)
        inner = inner.venv
    with suppress(NotImplementedError, AttributeError):  # not everybody's VecEnv can say; the first step tells too
        if any(venv.env_is_wrapped(ReliabilityWrapper)):
            allowed = "environments without a ReliabilityWrapper: rewards would be filtered twice"
            raise _checks.InvalidValueError("venv", type(venv).__name__, allowed)
        if any(venv.env_is_wrapped(gymnasium.wrappers.NormalizeReward)):
            allowed = "environments without NormalizeReward: ratings are not in normalised units"
            raise _checks.InvalidValueError("venv", type(venv).__name__, allowed)


class ReliabilityCallback(BaseCallback):
    """Logs what the filter does under ``uard/``, and lends it the algorithm's critics where it has several.

    Scalars, means of every sixteenth step (of a replay buffer every 128th batch) since the last dump: ``weight``,
    ``sigma_m``, ``sigma_h``, ``lambda_t``, ``abstained``, ``reward`` and ``raw_reward``; with ``ReliabilityVecEnv``
    also ``raw_return`` and ``filtered_return``, of every episode.

    Examples:
        >>> import uard.envs
        >>> from stable_baselines3 import DQN
        >>> model = DQN("MlpPolicy", "uard/TrapGrid6-v0", replay_buffer_class=ReliabilityReplayBuffer)
        >>> model = model.learn(32, callback=ReliabilityCallback())
    """

    def __init__(self, critics: bool = True, verbose: int = 0):
        """Start.

        Args:
            critics: Whether sigma_m is the critics' disagreement where nothing else was given.
            verbose: See ``BaseCallback``.
        """
        super().__init__(verbose)
        self._critics = critics
        self._lent: list[tuple[Steps, CriticDisagreement]] = []
        self._source: ReliabilityReplayBuffer | ReliabilityVecEnv | None = None
        self._rollout: ReliabilityRolloutBuffer | None = None
        self._every = EVERY
        self._observation: Any = None

    def _on_training_start(self) -> None:
        replay, rollout = (getattr(self.model, f"{name}_buffer", None) for name in ("replay", "rollout"))
        env: Any = self.training_env
        while isinstance(env, VecEnvWrapper) and not isinstance(env, ReliabilityVecEnv):
            env = env.venv
        kinds = (replay, ReliabilityReplayBuffer), (rollout, ReliabilityRolloutBuffer), (env, ReliabilityVecEnv)
        found: list[Any] = [one for one, kind in kinds if isinstance(one, kind)]
        if not found:
            allowed = "a ReliabilityVecEnv, or give the ReliabilityReplayBuffer or ReliabilityRolloutBuffer"
            raise _checks.InvalidValueError("env", type(self.training_env).__name__, allowed)
        if len(found) > 1:
            buffer = "replay" if found[0] is replay else "rollout"
            allowed = f"left out where the {buffer} buffer filters: rewards would be filtered twice"
            raise _checks.InvalidValueError("env", "ReliabilityVecEnv", allowed)
        source = found[0]
        if isinstance(source, ReliabilityRolloutBuffer):
            _refuse_changed(self.training_env)
            self._rollout = source
            return
        self._source, self._every = source, EVERY if source is env else 8 * EVERY
        if self._critics and source.steps.sigma_m is None and critics_of(self.model) >= 2:
            critics = CriticDisagreement(self.model)
            source.steps.sigma_m = critics if source is replay else critics.outside
            if source is replay:
                critics.lend()
            self._lent.append((source.steps, critics))

    def _on_rollout_start(self) -> None:
        if self._rollout is not None and self._rollout.steps.reads_steps:
            self._observation = self._seen(cast("Any", self.model)._last_obs)

    def _seen(self, observation: Any) -> Any:
        """Return the latest observation as the environments gave it."""
        normalised = self.model.get_vec_normalize_env()
        return observation if normalised is None else normalised.get_original_obs()

    def _on_step(self) -> bool:
        if self._rollout is not None:
            self._tell(self._rollout)
            return True
        assert self._source is not None
        if self.n_calls % self._every == 0:
            self._log(self._source.latest)
        for i, done in enumerate(self.locals["dones"].tolist()):
            for name in ("raw_return", "filtered_return") if done else ():
                if name in self.locals["infos"][i]:
                    self.logger.record_mean(f"uard/{name}", self.locals["infos"][i][name])
        return True

    def _tell(self, buffer: ReliabilityRolloutBuffer) -> None:
        """Tell the buffer of one step."""
        step, before = self.locals, self._observation
        if buffer.steps.reads_steps:
            self._observation = self._seen(step["new_obs"])
        actions = step.get("clipped_actions", step["actions"])
        buffer.tell(before, actions, self._observation, step["rewards"], step["dones"], step["infos"])

    def _on_rollout_end(self) -> None:
        if self._rollout is not None:
            self._log(self._rollout.latest)
            for returns in self._rollout.episodes:
                for name, value in zip(("raw_return", "filtered_return"), returns, strict=True):
                    self.logger.record_mean(f"uard/{name}", value)

    def _log(self, filtered: Filtered | None) -> None:
        if filtered is not None:
            for name, where in (("reward", "reward"), *INFO.items()):
                self.logger.record_mean(f"uard/{name}", float(getattr(filtered, where).mean()))

    def _on_training_end(self) -> None:
        for steps, critics in self._lent:  # or a saved buffer would hold the model
            steps.sigma_m = None
            critics.take_back()
        self._lent.clear()
