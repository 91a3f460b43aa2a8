"""The laboratory's environments for Gymnasium.

``import uard.envs`` registers ``uard/NAME-v0`` for every name in ``uard.envs.names.ENVIRONMENTS`` but CartPole and
Acrobot, which are Gymnasium's own. Every field of the environment's configuration is a keyword of ``gymnasium.make``,
as are ``panel``, ``noise`` and ``render_mode``. MuJoCo is needed only to make what runs on it, JAX for none.

    >>> import gymnasium, uard.envs
    >>> env = gymnasium.make("uard/TrapGrid6-v0", panel="main")
    >>> state, info = env.reset(seed=0)
    >>> state, reward, terminated, truncated, info = env.step(1)
    >>> state, reward, info["ratings"].shape
    (6, -0.1, (3,))
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium

from uard import _checks
from uard.envs import names
from uard.envs.base import SimulatedEnvironment, TableEnvironment
from uard.envs.grids.gaming import TomatoWatering
from uard.envs.gym.grids import GridEnv
from uard.envs.gym.rated import Evaluation, RatedEnv
from uard.envs.gym.simulated import SimulatedEnv
from uard.ratings.panels import Panel

__all__ = ["IDS", "Evaluation", "GridEnv", "RatedEnv", "SimulatedEnv", "make", "register"]

IDS: dict[str, str] = {
    f"uard/{name}-v0": name
    for name, (kind, _) in names.KINDS.items()
    if issubclass(kind, TableEnvironment | SimulatedEnvironment | TomatoWatering)
}


def make(
    environment: str,
    *,
    panel: str | Panel | None = None,
    noise: float = 0.0,
    render_mode: str | None = None,
    **fields: Any,
) -> RatedEnv[Any, Any]:
    """Build an environment by its name in the laboratory; what ``gymnasium.make`` calls.

    Examples:
        >>> env = make("TrapGrid6", trap_reward=8.0, render_mode="ansi")
        >>> env.observation_space, env.action_space, env.problem.trap_reward
        (Discrete(36), Discrete(4), 8.0)
        >>> make("TrapGrid6", noise=-1.0)
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: noise = -1.0: must be a finite number >= 0

    Args:
        environment: A value of ``IDS``, a name in ``uard.envs.names.ENVIRONMENTS``.
        panel: Who rates each step, a ``Panel`` or a name in ``uard.ratings.panels.PANELS``; nobody if left out.
        noise: Standard deviation of extra normal noise on every rater, in reward units, >= 0.
        render_mode: ``rgb_array``, ``ansi`` or None.
        **fields: Of the environment's configuration, to change; cells of a grid may be lists.

    Raises:
        InvalidValueError: naming the field, the value and what is allowed.
    """
    kind: Any = names.KINDS[_checks.choose("environment", environment, IDS.values())][0]
    for field in fields:
        known = [f.name for f in dataclasses.fields(kind) if f.init]
        _checks.choose(f"keyword of {environment}", field, [*known, "panel", "noise", "render_mode"])
    problem = names.build(environment, **fields)
    form: Any = SimulatedEnv if isinstance(problem, SimulatedEnvironment) else GridEnv
    return form(problem, panel=panel, noise=noise, render_mode=render_mode)


# Gymnasium looks here for whether it can show pictures itself (render_mode="human").
make.metadata = {"render_modes": ["rgb_array", "ansi"]}  # type: ignore[attr-defined]


def register() -> None:
    """Register every id in ``IDS`` with Gymnasium; calling it again changes nothing.

    Examples:
        >>> register()
        >>> gymnasium.spec("uard/TrapGrid6-v0").kwargs
        {'environment': 'TrapGrid6'}
    """
    for id_, name in IDS.items():
        if id_ not in gymnasium.registry:
            gymnasium.register(id=id_, entry_point="uard.envs.gym:make", kwargs={"environment": name})
