"""The environments of the laboratory by name.

The command line, studies and Gymnasium's ids (``uard.envs.gym``) are made of this one table: an environment that stands
here has all of them (CartPole and Acrobot have Gymnasium's own ids).
"""

from __future__ import annotations

from typing import Any

from uard import _checks
from uard.envs.base import Environment
from uard.envs.classic.specs import Acrobot, CartPole
from uard.envs.grids.gaming import AbsentSupervisor, BoatRace, TomatoWatering
from uard.envs.grids.learned_reward import LearnedRewardGrid
from uard.envs.grids.random_tasks import RandomMDP
from uard.envs.grids.trapgrid import PAPER_TRAPS, TrapGrid
from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
from uard.envs.locomotion.locomotion import Locomotion
from uard.envs.locomotion.regions import REGIONS

TWIN: dict[str, Any] = {"legitimate": True}
TWINS: dict[str, dict[str, Any]] = {"": {}, "-Legitimate": TWIN}

KINDS: dict[str, tuple[type[Environment], dict[str, Any]]] = {
    "TrapGrid": (TrapGrid, {}),
    **{f"TrapGrid{n}": (TrapGrid, {"size": n}) for n in PAPER_TRAPS},
    **{f"TrapGrid{n}-Trap8": (TrapGrid, {"size": n, "trap_reward": 8.0}) for n in PAPER_TRAPS},
    **{f"TrapGrid{n}-Legitimate": (TrapGrid, {"size": n, **TWIN}) for n in PAPER_TRAPS},
    "TrapGrid10-T100": (TrapGrid, {"size": 10, "horizon": 100}),
    **{
        f"{kind.__name__}{suffix}": (kind, twin)
        for kind in (BoatRace, TomatoWatering, AbsentSupervisor)
        for suffix, twin in TWINS.items()
    },
    "LearnedRewardGrid": (LearnedRewardGrid, {}),
    "RandomMDP": (RandomMDP, {}),
    **{
        f"{robot.capitalize()}-{region.capitalize()}{suffix}": (Locomotion, {"robot": robot, "region": region, **twin})
        for robot in ("hopper", "walker2d")
        for region in REGIONS
        for suffix, twin in TWINS.items()
    },
    "Hopper": (Locomotion, {"robot": "hopper", "region": None}),
    "Walker2d": (Locomotion, {"robot": "walker2d", "region": None}),
    "InvertedPendulum": (InvertedPendulum, {}),
    "CartPole": (CartPole, {}),
    "Acrobot": (Acrobot, {}),
}
"""Class and settings of each; what is not set is the class's default."""


def build(name: str, **changes: Any) -> Environment:
    """Return an environment by name, some of its fields changed.

    Examples:
        >>> build("TrapGrid6", trap_reward=8.0).trap_reward
        8.0
        >>> build("Trapgrid6")
        Traceback (most recent call last):
            ...
        uard._checks.UnknownNameError: environment = 'Trapgrid6': must be one of ... (did you mean 'TrapGrid6'?)

    Args:
        name: A name in ``ENVIRONMENTS``.
        **changes: Fields of the environment's configuration.

    Raises:
        UnknownNameError: with the nearest name.
        InvalidValueError: from the environment, naming the field.
        TypeError: a field that the environment does not have.
    """
    kind, settings = KINDS[_checks.choose("environment", name, KINDS)]
    return kind(**(settings | changes))


ENVIRONMENTS: dict[str, Environment] = {name: build(name) for name in KINDS}
