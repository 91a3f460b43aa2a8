"""An ensemble that needs nothing but NumPy: sigma_m for training that has no ensemble of its own.

Each member is a ridge regression of the observed reward on random Fourier features [Rahimi and Recht 2007] of state
and action, fitted to its own bootstrap of the steps (each step counts 0, 1, 2 ... times, Poisson) and added to its own
fixed random function, so that members disagree where nothing was seen [Osband et al. 2018].
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from uard import _checks
from uard.adapters.features import RandomFeatures
from uard.method import uncertainty

if TYPE_CHECKING:
    from jaxtyping import Float


class RewardEnsemble:
    """Predicts the observed reward of state-actions; members disagree where they have seen little. Changed in place.

    Examples:
        >>> place, push = gymnasium.spaces.Box(-1.0, 1.0, (2,)), gymnasium.spaces.Discrete(2)
        >>> ensemble = RewardEnsemble(place, push)
        >>> seen, unseen = np.full((64, 2), 0.5), np.full((64, 2), -0.5)
        >>> ensemble.update(seen, np.ones(64, int), np.ones(64))
        >>> sigma_m = [ensemble(states, np.ones(64, int)).mean() for states in (seen, unseen)]
        >>> bool(sigma_m[0] < sigma_m[1])
        True
    """

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        *,
        members: int = 5,
        features: int = 64,
        ridge: float = 1.0,
        prior_scale: float = 1.0,
        seed: int = 0,
    ):
        """Start without having seen anything.

        Args:
            observation_space: Of one environment.
            action_space: Of one environment.
            members: N >= 2.
            features: Random features of each member, >= 1.
            ridge: Penalty > 0, in steps: how many it takes before data outweigh the prior.
            prior_scale: Deviation of the fixed random functions, in reward units, > 0.
            seed: Of the features, the priors and the bootstrap, >= 0.

        Raises:
            InvalidValueError: naming the argument, its value and what is allowed; a space of which a sample is no row
                of numbers (``Sequence``, ``Graph``).
        """
        _checks.whole("seed", seed)
        _checks.whole("members", members, low=2, high=64)
        _checks.number("ridge", ridge, low=0, open_low=True)
        _checks.number("prior_scale", prior_scale, low=0, open_low=True)
        self._random = np.random.default_rng(seed)
        self._features = RandomFeatures(observation_space, action_space, members, features, self._random)
        self._prior = self._random.normal(0.0, prior_scale, (members, features))
        self._gram = np.tile(ridge * np.eye(features), (members, 1, 1))
        self._moment = np.zeros((members, features))
        self._weights: np.ndarray = np.zeros((members, features))
        self._seen, self._due = 0, 1

    def __call__(self, observations: Any, actions: Any) -> Float[np.ndarray, " B"]:
        """Return sigma_m of a batch of state-actions of the two spaces, in reward units.

        Raises:
            InvalidValueError: a state or an action is not finite, or none of its space's numbers.
        """
        return uncertainty.sigma_model(self.predict(observations, actions), axis=0)

    def predict(self, observations: Any, actions: Any) -> Float[np.ndarray, "N B"]:
        """Return every member's estimate of the observed reward."""
        return np.einsum("nbf,nf->nb", self._features(observations, actions), self._prior + self._weights)

    def update(self, observations: Any, actions: Any, rewards: Float[np.ndarray, " B"]) -> None:
        """Learn from a batch of steps; members are fitted again after 1, 2, 4 ... 256, 512, 768 ... steps.

        Raises:
            InvalidValueError: a state, an action or a reward is not finite: nothing is learned from the batch.
        """
        _checks.moderate("rewards", rewards)
        z = self._features(observations, actions)
        times = self._random.poisson(1.0, z.shape[:2]).astype(float)  # of each step in each member's bootstrap
        residual = rewards - np.einsum("nbf,nf->nb", z, self._prior)
        weighted = times[..., None] * z
        self._gram += np.einsum("nbf,nbg->nfg", weighted, z)
        self._moment += np.einsum("nbf,nb->nf", weighted, residual)
        self._seen += len(rewards)
        if self._seen >= self._due:
            self._due = self._seen + min(self._seen, 256)
            self._weights = np.linalg.solve(self._gram, self._moment[..., None])[..., 0]
