"""From ratings of clips to ratings of steps, where no state comes twice.

A person rates a clip; a training needs to know what she would say of a step. Her gap, the rating of a clip less the
reward that its steps earned on average, is taken for the mean over the steps of a function of state and action. With
random Fourier features that function is linear in the features, so that the clip's gap is the same linear function of
their mean: one ridge regression per rater. Each is fitted several times, to bootstraps of the clips and beside fixed
random functions, so that the fits disagree where nothing was rated [Osband et al. 2018].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.features import RandomFeatures

if TYPE_CHECKING:
    from jaxtyping import Float

FEWEST = 10  # clips that a rater must have rated before anything is said for her


class RatedClip(NamedTuple):
    """A clip and what raters said of it.

    Attributes:
        observations: (L, ...), what the actions were taken on.
        actions: (L, ...).
        reward: Mean observed reward per step.
        ratings: (K,), in the same unit; NaN where a rater has not rated it.
    """

    observations: Any
    actions: Any
    reward: float
    ratings: Float[np.ndarray, " K"]


class ClipModel:
    """Predicts the gap between each rater's rating of a step and its reward. Changed in place.

    Examples:
        >>> place, push = gymnasium.spaces.Box(-1.0, 1.0, (1,)), gymnasium.spaces.Discrete(2)
        >>> model = ClipModel(place, push)
        >>> x = np.linspace(-1.0, 1.0, 200).reshape(40, 5, 1)
        >>> lies = [RatedClip(o, np.zeros(5, int), 1.0, np.array([1.0 - 2.0 * (o.mean() > 0)])) for o in x]
        >>> model.fit(lies)
        >>> model(np.array([[-0.7], [0.7]]), np.zeros(2, int))[:, 0].round().tolist()
        [0.0, -2.0]
    """

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        *,
        members: int = 5,
        features: int = 128,
        ridge: float = 0.1,
        doubt: float = 0.5,
        seed: int = 0,
    ):
        """Start without any clip.

        Args:
            observation_space: Of one environment.
            action_space: Of one environment.
            members: Fits per rater, in [2, 64].
            features: Random features of each member, in [1, 4096].
            ridge: Penalty > 0, in clips: how many it takes before data outweigh the prior.
            doubt: Where the members' deviation exceeds this share of what a gap may be (the root mean square of gaps,
                or the deviation of rewards if that is more), nothing is said for a rater, in (0, 1].
            seed: Of features, priors and bootstraps, >= 0.

        Raises:
            InvalidValueError: naming the argument, its value and what is allowed.
        """
        _checks.whole("members", members, low=2, high=64)
        _checks.number("ridge", ridge, low=0, open_low=True)
        _checks.number("doubt", doubt, low=0, high=1, open_low=True)
        _checks.whole("seed", seed)
        self._random = np.random.default_rng(seed)
        self._features = RandomFeatures(observation_space, action_space, members, features, self._random)
        self._prior = self._random.normal(0.0, 1.0, (members, features))
        self._ridge, self._doubt = ridge, doubt
        self._weights: list[Float[np.ndarray, "N F"] | None] = []
        self._usual = 0.0  # what a gap may be

    def fit(self, clips: Sequence[RatedClip]) -> None:
        """Fit all raters anew to all clips that are rated.

        Args:
            clips: All of them; the longest row of ratings says how many raters there are.

        Raises:
            InvalidValueError: a clip's states or actions are none of the spaces'.
        """
        raters = max((len(c.ratings) for c in clips), default=0)
        gaps = np.full((len(clips), raters), np.nan)
        for i, c in enumerate(clips):
            gaps[i, : len(c.ratings)] = c.ratings - c.reward
        if not clips:
            return
        z = np.stack([self._features(c.observations, c.actions).mean(1) for c in clips], axis=1)
        self._usual, self._weights = _usual(gaps, np.array([c.reward for c in clips])), []
        for k in range(raters):
            heard = np.isfinite(gaps[:, k])
            enough = int(heard.sum()) >= FEWEST
            self._weights.append(self._regressed(z[:, heard], gaps[heard, k]) if enough else None)

    def _regressed(self, z: Float[np.ndarray, "N n F"], gap: Float[np.ndarray, " n"]) -> Float[np.ndarray, "N F"]:
        """Return each member's weights, its fixed random function included."""
        prior = self._usual * self._prior
        times = self._random.poisson(1.0, z.shape[:2]).astype(float)  # of each clip in each member's bootstrap
        weighted = times[..., None] * z
        gram = np.einsum("nbf,nbg->nfg", weighted, z) + self._ridge * np.eye(z.shape[-1])
        residual = gap - np.einsum("nbf,nf->nb", z, prior)
        moment = np.einsum("nbf,nb->nf", weighted, residual)
        solve: Any = np.linalg.solve  # whose types are not all known
        return prior + solve(gram, moment[..., None])[..., 0]

    def __call__(self, observations: Any, actions: Any) -> Float[np.ndarray, "B K"]:
        """Return the gaps of steps by rater, in reward units; NaN where too little is known of them.

        Raises:
            InvalidValueError: a state or an action is none of the space's.
        """
        z = self._features(observations, actions)
        out = np.full((z.shape[1], len(self._weights)), np.nan)
        for k, weights in enumerate(self._weights):
            if weights is None:
                continue
            said = np.einsum("nbf,nf->nb", z, weights)
            sure = said.std(0) <= self._doubt * self._usual
            out[:, k] = np.where(sure, said.mean(0), np.nan)
        return out


def _usual(gaps: Float[np.ndarray, "n K"], rewards: Float[np.ndarray, " n"]) -> float:
    """Return what a gap may be, in reward units; > 0, for raters who agree so far may differ where they saw nothing."""
    found = max(float(np.sqrt(np.nanmean(gaps**2))), float(rewards.std()))
    return found or float(np.abs(rewards).max()) or 1.0
