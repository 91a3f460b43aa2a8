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

from uard.adapters.steps import INFO, KeyFn, RatingsFn, SigmaFn, Steps, map_batch, natural_key, rows_of, subset
from uard.method.abstention import Abstention
from uard.method.mitigations import Mitigation
from uard.ratings.stream import RewardStream

if TYPE_CHECKING:
    from jaxtyping import Bool, Integer, Shaped


def _steps(
    env: Any,
    mitigation: Mitigation | None,
    ratings: RatingsFn | None,
    sigma_m: SigmaFn | None,
    key: KeyFn | None,
    abstention: Abstention | None,
    single: str,
) -> Steps:
    spaces = getattr(env, f"{single}observation_space"), getattr(env, f"{single}action_space")
    return Steps(RewardStream(mitigation, abstention=abstention), ratings, sigma_m, key or natural_key(*spaces))


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
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, mitigation=mitigation, ratings=ratings, sigma_m=sigma_m, key=key, abstention=abstention
        )
        super().__init__(env)
        self.steps = _steps(env, mitigation, ratings, sigma_m, key, abstention, "")
        self._observation: Any = None
        self._returns = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; all ratings are remembered."""
        self._observation, info = super().reset(seed=seed, options=options)
        self._returns[:] = 0.0
        return self._observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step and return it with the filtered reward.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed.
        """
        next_observation, reward, terminated, truncated, info = super().step(action)
        found = info.get("ratings")
        out = self.steps.filter(
            _batch(self._observation),
            _batch(action),
            _batch(next_observation),
            np.array([reward], float),
            None if found is None else rows_of({0: found}, 1),
        )
        filtered = float(out.reward[0])
        self._observation = next_observation
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
        self._returns = np.zeros((2, self.num_envs))
        self._resetting = np.zeros(self.num_envs, bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start episodes (those of ``options["reset_mask"]``, if given); all ratings are remembered."""
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)), bool).copy()
        self._observation, info = super().reset(seed=seed, options=options)
        self._returns[:, mask] = 0.0
        self._resetting[mask] = False
        return self._observation, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one step in every environment and return it with filtered rewards.

        Raises:
            InvalidValueError: for a reward or ratings that no training should be fed; names the environment.
        """
        n = self.num_envs
        next_observation, rewards, terminated, truncated, info = super().step(actions)
        info, ended = dict(info), np.asarray(terminated) | np.asarray(truncated)
        reached = self._reached(next_observation, ended, info)
        found = rows_of(_reported(info, ended if self._mode is AutoresetMode.SAME_STEP else np.zeros(n, bool)), n)
        real = np.flatnonzero(~self._resetting)
        filtered = np.array(rewards, float)
        if len(real):
            out = self.steps.filter(
                subset(self._observation, real),
                subset(actions, real),
                subset(reached, real),
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
        self._observation = next_observation
        return next_observation, filtered, terminated, truncated, info

    def _reached(self, next_observation: Any, ended: Bool[np.ndarray, " B"], info: dict[str, Any]) -> Any:
        """Return what the steps led to, before any reset."""
        if self._mode is not AutoresetMode.SAME_STEP or not ended.any() or self.steps.ratings is None:
            return next_observation
        rows = [
            info["final_obs"][i] if ended[i] else subset(next_observation, np.array(i)) for i in range(self.num_envs)
        ]
        space = cast("Any", self).single_observation_space
        out = gymnasium.vector.utils.create_empty_array(space, self.num_envs)
        return gymnasium.vector.utils.concatenate(space, rows, out)


def _reported(info: dict[str, Any], ended: Bool[np.ndarray, " B"]) -> dict[int, Any]:
    """Return the ratings of those environments that reported any; those that just ended did so in ``final_info``."""
    found: dict[int, Any] = {}
    for source, mine in ((info, ~ended), (info.get("final_info", {}), ended)):
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


def _batch(one: Any) -> Any:
    """Return a single observation or action as a batch of one."""
    return map_batch(one, lambda x: np.asarray(x)[None])
