"""sigma_m from the critics of an algorithm of Stable-Baselines3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import Float


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
            return _deviation(self._model.critic(states, acts))

    def of_batch(self, observations: Any, actions: Any) -> Float[np.ndarray, " B"]:
        """Return sigma_m of the tensors of a batch that is about to be learned from.

        What the critics say is kept: the algorithm, which asks them about the same tensors before it changes them, is
        given it (see ``lend``), and the critics compute it once.
        """
        critic = self._model.critic
        once = getattr(critic.forward, "__self__", None)
        values = once.ask(observations, actions) if isinstance(once, _AskedOnce) else critic(observations, actions)
        return _deviation([value.detach() for value in values])

    def of_kept(self, observations: Any, actions: Any) -> Float[np.ndarray, " B"]:
        """Return sigma_m of state-actions as a replay buffer has them: states as they are, actions in [-1, 1]."""
        normalised = self._model.get_vec_normalize_env()
        return self(observations if normalised is None else normalised.normalize_obs(observations), actions)

    def lend(self) -> None:
        """Have the critics remember their last answer, until ``take_back``."""
        from stable_baselines3.common.policies import ContinuousCritic

        critic: Any = self._model.critic
        if isinstance(critic, ContinuousCritic) and "forward" not in vars(critic):
            setattr(critic, "forward", _AskedOnce(critic).forward)  # noqa: B010 its type says it has one already

    def take_back(self) -> None:
        """Undo ``lend``."""
        critic = self._model.critic
        if isinstance(getattr(critic.forward, "__self__", None), _AskedOnce):
            del critic.forward

    def outside(self, observations: Any, actions: Any) -> Float[np.ndarray, " B"]:
        """Return sigma_m of state-actions as the environments have them."""
        return self.of_kept(observations, self._model.policy.scale_action(actions))


def critics_of(model: Any) -> int:
    """Return how many critics a model of Stable-Baselines3 has that give a state with an action a value.

    Examples:
        >>> from stable_baselines3 import SAC
        >>> critics_of(SAC("MlpPolicy", "Pendulum-v1"))
        2
    """
    return len(getattr(getattr(model, "critic", None), "q_networks", ()))


class _AskedOnce:
    """In the place of a critic's ``forward``: gives an answer that is known already, with its gradients, once."""

    def __init__(self, critic: Any):
        self._critic, self._forward = critic, critic.forward
        self._weights = [*critic.parameters(), *critic.buffers()]
        self._question: Any = None
        self._answer: Any = None

    def _state(self, observations: Any, actions: Any) -> tuple[Any, ...]:
        """Return what an answer depends on; tensors count what is written into them."""
        import torch

        tensors = observations, actions, *self._weights
        return (torch.is_grad_enabled(), self._critic.training, *(tensor._version for tensor in tensors))

    def ask(self, observations: Any, actions: Any) -> Any:
        """Ask the critic, and keep the answer for the next who asks the same."""
        self._question = self._answer = None
        answer = self._critic(observations, actions)
        self._question = observations, actions, self._state(observations, actions)
        self._answer = answer
        return answer

    def forward(self, observations: Any, actions: Any) -> Any:
        """Return the critic's answer."""
        question, answer = self._question, self._answer
        self._question = self._answer = None
        if question is None or question[0] is not observations or question[1] is not actions:
            return self._forward(observations, actions)
        if question[2] == self._state(observations, actions):
            return answer
        return self._forward(observations, actions)


def _deviation(values: Any) -> Float[np.ndarray, " B"]:
    import torch

    return torch.cat(tuple(values), 1).std(1, correction=1).double().cpu().numpy()
