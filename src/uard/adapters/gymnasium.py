"""The filter as a Gymnasium wrapper.

Order matters (stable-baselines3#146): what wraps this wrapper sees filtered rewards, what it wraps sees raw ones. So a
``RecordEpisodeStatistics`` or ``Monitor`` outside logs what the agent learns from; both returns of an episode are in
the ``info`` of its last step (``raw_return``, ``filtered_return``); ``Monitor(info_keywords=...)`` writes them down.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from uard import _checks
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
    subset,
    with_row,
)
from uard.method.abstention import Abstention
from uard.method.mitigations import Mitigation
from uard.ratings.stream import RewardStream

if TYPE_CHECKING:
    from jaxtyping import Bool, Integer, Shaped


NORMALISING = (gymnasium.wrappers.NormalizeReward, gymnasium.wrappers.vector.NormalizeReward)


def _steps(
    env: Any,
    mitigation: Mitigation | None,
    ratings: RatingsFn | None,
    sigma_m: SigmaFn | None,
    key: KeyFn | None,
    abstention: Abstention | None,
    single: str,
) -> Steps:
    _refuse_wrapped(env)
    spaces = getattr(env, f"{single}observation_space"), getattr(env, f"{single}action_space")
    return Steps(RewardStream(mitigation, abstention=abstention), ratings, sigma_m, key or natural_key(*spaces))


def _refuse_wrapped(env: Any) -> None:
    """Refuse environments in which rewards are filtered already, as far as that can be seen from outside."""
    if isinstance(env, ReliabilityWrapper | VectorReliabilityWrapper):
        allowed = "environments without one: rewards would be filtered twice"
        raise _checks.InvalidValueError("env", type(env).__name__, allowed)
    if isinstance(env, NORMALISING):
        allowed = "one that goes outside, NormalizeReward(ReliabilityWrapper(env)): ratings are not in normalised units"
        raise _checks.InvalidValueError("env", "NormalizeReward", allowed)
    if isinstance(env, gymnasium.Wrapper | gymnasium.vector.VectorWrapper):
        _refuse_wrapped(cast("Any", env).env)
    elif isinstance(env, gymnasium.vector.SyncVectorEnv):
        for one in cast("Any", env).envs:
            _refuse_wrapped(one)


class ReliabilityWrapper(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Emits filtered rewards; wraps single and vector environments (for those it is ``VectorReliabilityWrapper``).

    Examples:
        >>> import uard.envs
        >>> env = ReliabilityWrapper(gymnasium.make("uard/TrapGrid6-v0", panel="main"))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(3)
        >>> sorted(set(info) & {"raw_reward", "weight", "sigma_h"})
        ['raw_reward', 'sigma_h', 'weight']

    After each step ``info`` also holds ``raw_reward``, ``weight`` w, ``sigma_m``, ``sigma_h``, ``lambda_t`` and
    ``abstained``; after an episode's last step ``raw_return`` and ``filtered_return``.

    Attributes:
        steps: What filters; its ``stream`` is all that is remembered.
    """

    def __new__(cls, *args: Any, **options: Any) -> Any:
        """Return the vector form for vector environments."""
        env = args[0] if args else options.get("env")  # unpickling gives none
        if isinstance(env, gymnasium.vector.VectorEnv):
            return VectorReliabilityWrapper(*args, **options)
        return super().__new__(cls)

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        mitigation: Mitigation | None = None,
        *,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
        abstention: Abstention | None = None,
    ):
        """Wrap an environment.

        Args:
            env: Its ``info["ratings"]``, K numbers with None or NaN where one is missing, are taken where there is
                no ``ratings``; a step without is a step that nobody rated.
            mitigation: What to do with rewards; ``uard()`` if left out.
            ratings: Called with batches (observations, actions, next observations, rewards), B = 1 here.
            sigma_m: Called with batches (observations, actions); e.g. ``uard.adapters.reward_ensemble.RewardEnsemble``.
            key: Tells state-actions apart, so that the ratings of one are remembered when it comes again; found for
                numbered states and actions if left out.
            abstention: Marks steps in ``info["abstained"]``.

        Raises:
            InvalidValueError: a wrapper inside filters already, or an argument is not what it must be.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, mitigation=mitigation, ratings=ratings, sigma_m=sigma_m, key=key, abstention=abstention
        )
        super().__init__(env)
        self.steps = _steps(env, mitigation, ratings, sigma_m, key, abstention, "")
        self._observation: Any = None  # a batch of one
        self._started = False
        self._returns = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; all ratings are remembered."""
        observation, info = super().reset(seed=seed, options=options)
        self._observation, self._started = self._seen(observation), True
        self._returns[:] = 0.0
        return observation, info

    def _seen(self, observation: Any) -> Any:
        """Return a copy of an observation, which the environment may change, as a batch; None if nobody looks at it."""
        return batch_of(self.env.observation_space, observation) if self.steps.reads_steps else None

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step and return it with the filtered reward.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed, or a reward that was filtered.
            ResetNeeded: before the first ``reset``.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("call reset() of the ReliabilityWrapper before step()")
        acted = batch_of(self.env.action_space, action) if self.steps.reads_steps else None
        next_observation, reward, terminated, truncated, info = super().step(action)
        refuse_filtered(info, 'info["raw_reward"]')
        observed = _checks.as_numpy("reward", reward)
        if observed.ndim:
            raise _checks.InvalidValueError("reward.shape", observed.shape, "(), one number")
        reached = self._seen(next_observation)
        out = self.steps.filter(
            self._observation,
            acted,
            reached,
            observed[None],
            rows_of({0: info.get("ratings")}, 1),
        )
        filtered = float(out.reward[0])
        self._observation = reached
        self._returns += float(out.raw[0]), filtered
        info = info | {name: getattr(out, where)[0].item() for name, where in INFO.items()}
        if terminated or truncated:
            info |= {"raw_return": float(self._returns[0]), "filtered_return": float(self._returns[1])}
        return next_observation, filtered, terminated, truncated, info


class VectorReliabilityWrapper(gymnasium.vector.VectorWrapper, gymnasium.utils.RecordConstructorArgs):
    """The same for vector environments in all three autoreset modes; ``info`` holds arrays with their masks ``_name``.

    Examples:
        >>> import uard.envs
        >>> env = VectorReliabilityWrapper(gymnasium.make_vec("uard/TrapGrid6-v0", num_envs=2, panel="main"))
        >>> observations, info = env.reset(seed=0)
        >>> observations, rewards, terminated, truncated, info = env.step(np.array([3, 1]))
        >>> info["weight"].shape, info["_weight"].tolist()
        ((2,), [True, True])

    The step that only resets (``AutoresetMode.NEXT_STEP``) is neither filtered nor remembered.

    Attributes:
        steps: What filters; one for all environments.
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv[Any, Any, Any],
        mitigation: Mitigation | None = None,
        *,
        ratings: RatingsFn | None = None,
        sigma_m: SigmaFn | None = None,
        key: KeyFn | None = None,
        abstention: Abstention | None = None,
    ):
        """Wrap vector environments; see ``ReliabilityWrapper``."""
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, mitigation=mitigation, ratings=ratings, sigma_m=sigma_m, key=key, abstention=abstention
        )
        super().__init__(env)
        self.steps = _steps(env, mitigation, ratings, sigma_m, key, abstention, "single_")
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._observation: Any = None
        self._started = False
        self._returns = np.zeros((2, self.num_envs))
        self._resetting = np.zeros(self.num_envs, bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start episodes (those of ``options["reset_mask"]``, if given); all ratings are remembered."""
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)), bool).copy()
        observation, info = super().reset(seed=seed, options=options)
        self._observation, self._started = self._seen(observation), True
        self._returns[:, mask] = 0.0
        self._resetting[mask] = False
        return observation, info

    def _seen(self, observation: Any) -> Any:
        """Return a batch of observations, copied; None if nobody looks at it."""
        space = cast("Any", self.env).single_observation_space
        return arrays_of(space, observation) if self.steps.reads_steps else None

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one step in every environment and return it with filtered rewards.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed; names the environment.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("call reset() of the ReliabilityWrapper before step()")
        n = self.num_envs
        acted = arrays_of(cast("Any", self.env).single_action_space, actions) if self.steps.reads_steps else None
        next_observation, rewards, terminated, truncated, info = super().step(actions)
        refuse_filtered(info, 'info["raw_reward"]')
        info, ended = dict(info), np.asarray(terminated) | np.asarray(truncated)
        seen = self._seen(next_observation)
        reached = self._reached(seen, ended, info)
        found = rows_of(_reported(info, ended if self._mode is AutoresetMode.SAME_STEP else np.zeros(n, bool)), n)
        real = np.flatnonzero(~self._resetting)
        filtered = _checks.as_numpy("reward", rewards).copy()
        if len(real):
            out = self.steps.filter(
                _some(self._observation, real),
                _some(acted, real),
                _some(reached, real),
                filtered[real],
                None if found is None else found[real],
            )
            self._returns[0, real] += filtered[real]
            filtered[real] = out.reward
            self._returns[1, real] += out.reward
            for name, where in INFO.items():
                _put(info, name, real, getattr(out, where), n)
        over = np.flatnonzero(ended & ~self._resetting)
        if len(over):
            for name, returns in zip(("raw_return", "filtered_return"), self._returns, strict=True):
                _put(info, name, over, returns[over], n)
            self._returns[:, over] = 0.0
        self._resetting = ended if self._mode is AutoresetMode.NEXT_STEP else np.zeros(n, bool)
        self._observation = seen
        return next_observation, filtered, terminated, truncated, info

    def _reached(self, seen: Any, ended: Bool[np.ndarray, " B"], info: dict[str, Any]) -> Any:
        """Return what the steps led to, before any reset."""
        if self._mode is not AutoresetMode.SAME_STEP or not ended.any() or self.steps.ratings is None:
            return seen
        space = cast("Any", self.env).single_observation_space
        for i in np.flatnonzero(ended):
            seen = with_row(seen, i, batch_of(space, info["final_obs"][i]))
        return seen


def _reported(info: dict[str, Any], ended: Bool[np.ndarray, " B"]) -> dict[int, Any]:
    """Return the ratings of those environments that reported any; those that just ended did so in ``final_info``."""
    found: dict[int, Any] = {}
    for source, mine in ((info, ~ended), (info.get("final_info", {}), ended)):
        if isinstance(source.get("ratings"), dict):  # what Gymnasium makes of dictionaries
            raise _checks.InvalidValueError("ratings", source["ratings"], "a row of K numbers for each environment")
        if "ratings" in source:
            there = np.asarray(source.get("_ratings", np.ones(len(ended), bool))) & mine
            found |= {int(i): source["ratings"][i] for i in np.flatnonzero(there)}
    return found


def _put(
    info: dict[str, Any], name: str, places: Integer[np.ndarray, " n"], values: Shaped[np.ndarray, " n"], count: int
) -> None:
    """Put the values of some of ``count`` environments into ``info``, with the mask that Gymnasium keeps of them."""
    whole, mask = np.zeros(count, values.dtype), np.zeros(count, bool)
    whole[places], mask[places] = values, True
    info[name], info[f"_{name}"] = whole, mask


def _some(batch: Any, chosen: np.ndarray) -> Any:
    """Return some rows of a batch, None of none."""
    return None if batch is None else subset(batch, chosen)
