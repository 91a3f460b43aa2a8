"""The filter in Stable-Baselines3: a wrapper for its environments, a replay buffer, a callback that reports.

On-policy (PPO, A2C, sb3-contrib's TRPO): wrap the environments, before any ``VecNormalize``::

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
from typing import TYPE_CHECKING, Any, cast

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
    refuse_filtered,
    rows_of,
    with_row,
)
from uard.method.abstention import Abstention
from uard.method.mitigations import Mitigation
from uard.ratings.aggregate import aggregate
from uard.ratings.stream import MAX_KEYS, Filtered, RewardStream

try:
    from stable_baselines3.common.buffers import ReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"uard.adapters.sb3 needs Stable-Baselines3: pip install 'uard[sb3]' ({error})", name=error.name
    ) from error

if TYPE_CHECKING:
    from jaxtyping import Float, Integer

EVERY = 16  # the callback logs one step of so many


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
        _refuse_filtered(infos)
        seen = self._seen(next_observation)
        reached, space = seen, cast("Any", self.venv).observation_space
        if self.steps.ratings is not None:  # which is asked about what the steps led to, before any reset
            for i in np.flatnonzero(dones):
                reached = with_row(reached, i, batch_of(space, infos[i]["terminal_observation"]))
        observed = _checks.as_numpy("reward", rewards)
        out = self.steps.filter(self._observation, self._actions, reached, observed, _ratings_in(infos))
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


def _ratings_in(infos: list[dict[str, Any]]) -> Float[np.ndarray, "B K"] | None:
    return rows_of({i: x["ratings"] for i, x in enumerate(infos) if x.get("ratings") is not None}, len(infos))


def _refuse_filtered(infos: list[dict[str, Any]]) -> None:
    for i, info in enumerate(infos):
        refuse_filtered(info, f"infos[{i}]['raw_reward']")


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


class ReliabilityReplayBuffer(ReplayBuffer):
    """Keeps raw rewards and their ratings, and filters whenever it is sampled.

    Examples:
        >>> from gymnasium.spaces import Discrete
        >>> buffer = ReliabilityReplayBuffer(8, Discrete(9), Discrete(4))
        >>> state, action, reward, done = (np.array([x]) for x in (7, 2, 4.0, False))
        >>> buffer.add(state, state, action, reward, done, [{"ratings": [-1.0, 2.0, 1.0]}])
        >>> buffer.sample(5).rewards.shape, buffer.latest.raw.tolist()
        (torch.Size([5, 1]), [4.0, 4.0, 4.0, 4.0, 4.0])

    For ``replay_buffer_class=`` of DQN, SAC, TD3 and DDPG with one-step targets and observations that are arrays; the
    options go into ``replay_buffer_kwargs``. ``save_replay_buffer`` keeps all of it.

    Attributes:
        steps: What filters.
        latest: The rewards that were sampled last.
    """

    def __init__(
        self,
        *arguments: Any,
        mitigation: Mitigation | None = None,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
        **options: Any,
    ):
        """Build an empty buffer; see ``ReplayBuffer`` and ``uard.adapters.gymnasium.ReliabilityWrapper``.

        Raises:
            InvalidValueError: for observations that are no arrays.
        """
        space = arguments[1] if len(arguments) > 1 else options.get("observation_space")
        if isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
            allowed = "of arrays: put gymnasium's FlattenObservation around the environment, or use ReliabilityVecEnv"
            raise _checks.InvalidValueError("observation_space", cast("object", space), allowed)
        cast("Any", super()).__init__(*arguments, **options)
        spaces: Any = self
        key = key or natural_key(spaces.observation_space, spaces.action_space)
        # As many keys as steps: what a step in the buffer points to is never forgotten.
        stream = RewardStream(mitigation, max_keys=max(MAX_KEYS, self.buffer_size * self.n_envs))
        self.steps = Steps(stream, ratings, sigma_m, key)
        self.latest: Filtered | None = None
        size = self.buffer_size, self.n_envs
        self._raw = np.zeros(size)
        # With keys the place of what is known of a step's state-action, without keys the step's own ratings.
        self._slots = np.zeros(size if key else (0, 0), np.int64)
        self._ratings = np.full((0, 0, 1) if key else (*size, 1), np.nan)

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        """Store one step of every environment, with the ratings in its ``info``.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed, or a reward that has been
                filtered already; names the environment.
        """
        place = self.pos
        _refuse_filtered(infos)
        rewards = _checks.as_numpy("reward", reward).reshape(-1)
        _checks.fitting("reward", rewards, self.rewards.dtype)
        found = _ratings_in(infos)
        obs, action = np.asarray(obs), np.asarray(action)
        states, acts = obs.reshape(self.n_envs, *self.obs_shape), action.reshape(self.n_envs, self.action_dim)
        if self.steps.key is not None:  # which is given numbers, where states or actions are numbers
            spaces = cast("Any", self)
            states, acts = _numbers_in(spaces.observation_space, states), _numbers_in(spaces.action_space, acts)
        ratings = self.steps.ratings_of(states, acts, next_obs, rewards, found)
        slots = self.steps.stream.observe(rewards, ratings, self.steps.keys(states, acts, self.n_envs)).slots
        super().add(obs, next_obs, action, reward, done, infos)
        self._raw[place] = rewards
        if slots is None:
            self._keep_ratings(place, ratings)
        else:
            self._slots[place] = slots

    def _keep_ratings(self, place: int, ratings: Float[np.ndarray, "E K"] | None) -> None:
        """Keep the ratings of one step of all E environments; None is no rating."""
        self._ratings[place] = np.nan
        if ratings is not None:
            more = ratings.shape[1] - self._ratings.shape[2]
            if more > 0:
                self._ratings = np.pad(self._ratings, ((0, 0), (0, 0), (0, more)), constant_values=np.nan)
            self._ratings[place, :, : ratings.shape[1]] = ratings

    def _get_samples(self, batch_inds: Integer[np.ndarray, " batch"], env: VecNormalize | None = None) -> Any:
        raw = self._raw[batch_inds].reshape(-1)
        keyed, stream = self.steps.key is not None, self.steps.stream
        if keyed:
            known = stream.known(self._slots[batch_inds].reshape(-1))
        else:
            known = aggregate(self._ratings[batch_inds].reshape(len(raw), -1), raw, ddof=stream.ddof)
        sigma_m = None
        if self.steps.sigma_m is not None:
            states = self._normalize_obs(self.observations[batch_inds].reshape(-1, *self.obs_shape), env)
            sigma_m = self.steps.sigma_of(states, self.actions[batch_inds].reshape(-1, self.action_dim))
        self.latest = stream.filter(raw, known, sigma_m, keyed=keyed)
        learned = _checks.fitting("filtered reward", self.latest.reward, self.rewards.dtype)
        self.rewards[batch_inds] = learned.reshape(-1, self.n_envs)
        return super()._get_samples(batch_inds, env)


def _numbers_in(space: Any, batch: np.ndarray) -> np.ndarray:
    """Return a batch (B, ...) as (B,) where the space is one of numbers."""
    return batch.reshape(len(batch)) if isinstance(space, gymnasium.spaces.Discrete) else batch


class CriticDisagreement:
    """sigma_m from the critics of an algorithm that has several (SAC, TD3, TQC): deviation of their values.

    In units of value, as in the paper (A12).

    Examples:
        >>> from stable_baselines3 import SAC
        >>> sigma_m = CriticDisagreement(SAC("MlpPolicy", "Pendulum-v1"))
        >>> sigma_m(np.zeros((5, 3), np.float32), np.zeros((5, 1))).shape
        (5,)
    """

    def __init__(self, model: Any):
        """Read the critics of a model.

        Args:
            model: Of Stable-Baselines3 or sb3-contrib.

        Raises:
            InvalidValueError: if it has fewer than two critics.
        """
        if critics_of(model) < 2:
            allowed = "one with two critics or more (SAC, TD3; policy_kwargs=dict(n_critics=5))"
            raise _checks.InvalidValueError("model", type(model).__name__, allowed)
        self._model = model

    def __call__(self, observations: Any, actions: Any) -> Float[np.ndarray, " B"]:
        """Return sigma_m of state-actions as the critics take them: states normalised, actions in [-1, 1]."""
        import torch

        with torch.no_grad():
            policy = self._model.policy
            states, _ = policy.obs_to_tensor(observations)
            acts = torch.as_tensor(np.asarray(actions), device=policy.device, dtype=torch.float32)
            values = torch.cat(self._model.critic(states, acts), 1)
        return values.std(1, correction=1).double().cpu().numpy()

    def outside(self, observations: Any, actions: Any) -> Float[np.ndarray, " B"]:
        """Return sigma_m of state-actions as the environments have them."""
        normalised = self._model.get_vec_normalize_env()
        states = observations if normalised is None else normalised.normalize_obs(observations)
        return self(states, self._model.policy.scale_action(actions))


def critics_of(model: Any) -> int:
    """Return how many critics a model of Stable-Baselines3 has that give a state with an action a value.

    Examples:
        >>> from stable_baselines3 import SAC
        >>> critics_of(SAC("MlpPolicy", "Pendulum-v1"))
        2
    """
    return len(getattr(getattr(model, "critic", None), "q_networks", ()))


class ReliabilityCallback(BaseCallback):
    """Logs what the filter does under ``uard/``, and lends it the algorithm's critics where it has several.

    Scalars, means of every sixteenth step since the last dump: ``weight``, ``sigma_m``, ``sigma_h``, ``lambda_t``,
    ``abstained``, ``reward`` and ``raw_reward``; with ``ReliabilityVecEnv`` also ``raw_return`` and
    ``filtered_return``, of every episode.

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
        self._lent: list[Steps] = []
        self._source: ReliabilityReplayBuffer | ReliabilityVecEnv | None = None

    def _on_training_start(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        env: Any = self.training_env
        while isinstance(env, VecEnvWrapper) and not isinstance(env, ReliabilityVecEnv):
            env = env.venv
        filters = isinstance(buffer, ReliabilityReplayBuffer), isinstance(env, ReliabilityVecEnv)
        if not any(filters):
            raise _checks.InvalidValueError(
                "env", type(self.training_env).__name__, "a ReliabilityVecEnv, or give the ReliabilityReplayBuffer"
            )
        if all(filters):
            raise _checks.InvalidValueError(
                "env", "ReliabilityVecEnv", "left out where the replay buffer filters: rewards would be filtered twice"
            )
        source: Any = buffer if filters[0] else env
        self._source = source
        if self._critics and source.steps.sigma_m is None and critics_of(self.model) >= 2:
            critics = CriticDisagreement(self.model)
            source.steps.sigma_m = critics if filters[0] else critics.outside
            self._lent.append(source.steps)

    def _on_step(self) -> bool:
        assert self._source is not None
        latest = self._source.latest
        if self.n_calls % EVERY == 0 and latest is not None:
            for name, where in (("reward", "reward"), *INFO.items()):
                self.logger.record_mean(f"uard/{name}", float(getattr(latest, where).mean()))
        for i in np.flatnonzero(self.locals["dones"]):
            for name in ("raw_return", "filtered_return"):
                if name in self.locals["infos"][i]:
                    self.logger.record_mean(f"uard/{name}", self.locals["infos"][i][name])
        return True

    def _on_training_end(self) -> None:
        for steps in self._lent:  # or a saved buffer would hold the model
            steps.sigma_m = None
        self._lent.clear()
