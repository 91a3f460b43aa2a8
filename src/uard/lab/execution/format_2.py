"""Format 2 of configurations, and what became of it in format 3.

Up to format 2 a class stood in a configuration with its address, a panel with its name, and fields at their defaults
were left out if they were younger than the format. The tables below say what became of each. They are of the day on
which format 3 began, and stay as they are: what is done to a class later is no part of them.
"""

from __future__ import annotations

import importlib
from typing import Any

from uard import _checks
from uard.agents.base import Agent
from uard.lab.config import TYPE, key_of, type_name

NUMBER = 2

# New names of metrics and of the log's columns, by their old ones.
METRICS: dict[str, str] = {"trap_visits": "hacks", "goal_rate": "success_rate"}
COLUMNS: dict[str, str] = {"trap_visits": "hacks", "goal": "success"}

_NAMES = {
    **{f"uard.{name}": name.rpartition(".")[2] for name in (
        "lab.cell.Cell",
        "abstention.Abstention",
        "agents.tabular.QLearning",
        "agents.value.DeepQ",
        "agents.actor_critic.SoftActorCritic",
        "agents.policy.PPO",
        "agents.policy.TRPO",
        "agents.policy.CPO",
        "agents.continuous.ContinuousActorCritic",
        "networks.Network",
        "networks.Ensemble",
        "envs.trapgrid.TrapGrid",
        "envs.learned_reward.LearnedRewardGrid",
        "envs.gaming.BoatRace",
        "envs.gaming.TomatoWatering",
        "envs.gaming.AbsentSupervisor",
        "envs.classic.CartPole",
        "envs.classic.Acrobot",
        "envs.mujoco.Locomotion",
        "envs.mujoco.Vibration",
        "envs.mujoco.Posture",
        "envs.mujoco.Kick",
        "mitigation.Raw",
        "mitigation.RatedReward",
        "mitigation.Screening",
        "mitigation.RewardDiscounting",
        "reliability.ReliabilityFilter",
        "feedback.learned.RatingModel",
        "feedback.transitions.TransitionModel",
    )},
}  # fmt: skip
_FIELDS = {("Cell", "feedback"): "rating_model"}
_GONE = {("Locomotion", "spikes")}  # fields that can only be left out
_CELL = {
    *(TYPE, "environment", "mitigation", "agent", "panel", "noise", "rated", "episodes", "rating_model", "ddof"),
    *("snapshots", "steps", "query"),
}  # fields of a cell
_LEFT_OUT: dict[str, dict[str, Any]] = {
    "Cell": {"rating_model": None, "steps": None, "query": "random"},
    "Network": {"activation": "relu"},
}
_FAMILIES = {
    "QLearning": "tabular",
    "DeepQ": "replay",
    "SoftActorCritic": "replay",
    "PPO": "rollout",
    "TRPO": "rollout",
    "CPO": "rollout",
    "ContinuousActorCritic": "continuous-replay",
}
_TRAINERS = {
    ("tabular", False): "tabular",
    ("replay", False): "compiled-replay",
    ("rollout", False): "compiled-rollout",
    ("rollout", True): "simulated-rollout",
    ("continuous-replay", True): "simulated-replay",
}  # by family, and by whether it was trained for steps on a simulator
_VERSION = 1  # of all kinds of training


def _rater(**changes: Any) -> dict[str, Any]:
    default = {"temptation": 0.0, "bias": 0.0, "scale": 1.0, "noise": 0.1, "contested_noise": None, "lapse": 0.0}
    return {TYPE: "Rater", **default, "coverage": 1.0, "stars": None, **changes}


def _panel(*raters: dict[str, Any]) -> dict[str, Any]:
    return {TYPE: "Panel", "raters": list(raters), "low": None, "high": None}


_PANELS = {
    "main": _panel(_rater(), _rater(temptation=0.6, contested_noise=0.0), _rater(temptation=0.4, contested_noise=1.0)),
    "appendix": _panel(_rater(), _rater(noise=0.3), _rater(noise=0.2, contested_noise=1.0)),
    "colluding": _panel(*[_rater(temptation=1.0, noise=0.0)] * 3),
    "single": _panel(_rater()),
}


class UnmappedError(ValueError):
    """A configuration for which there is no new one; the message says why."""


def new_config(old: dict[str, Any]) -> dict[str, Any]:
    """Return the present form of a configuration of format 2.

    Raises:
        UnmappedError: it has none.
    """
    try:
        config = _new_value(old)
        known = config[TYPE] == "Cell" and config.keys() == _CELL and old["panel"] in _PANELS
    except (TypeError, KeyError, AttributeError, RecursionError):  # it is no configuration at all
        config, known = {}, False
    if not known:
        raise UnmappedError(f"no cell of format {NUMBER} looked like that: {_checks.short(old)}")
    return config | {"panel": _PANELS[old["panel"]]}


def new_key(config: dict[str, Any], old: dict[str, Any]) -> str:
    """Return the key of a configuration.

    Args:
        config: What ``new_config`` returned.
        old: What it was made of.

    Raises:
        UnmappedError: nobody knows how it was trained.
    """
    if not all(isinstance(config[part], dict) for part in ("agent", "environment")):
        raise UnmappedError(f"no cell of format {NUMBER} looked like that: {_checks.short(old)}")
    family = _FAMILIES.get(config["agent"][TYPE]) or _family_of(old["agent"]["class"])
    trainer = _TRAINERS.get((family, config["steps"] is not None))
    if trainer is None:
        raise UnmappedError(f"an agent of the family {family} was not trained in {config['environment'][TYPE]}")
    return key_of(config, trainer, _VERSION)


def _new_value(old: Any) -> Any:
    if isinstance(old, list):
        return [_new_value(value) for value in old]
    if not isinstance(old, dict):
        return old
    name = _new_name(old["class"])
    for gone in (k for k, value in old.items() if (name, k) in _GONE and value is not None):
        raise UnmappedError(f"the {gone} of a {name} are no more")
    fields = {k: value for k, value in old.items() if k != "class" and (name, k) not in _GONE}
    new = {_FIELDS.get((name, k), k): _new_value(value) for k, value in fields.items()}
    return {TYPE: name, **_LEFT_OUT.get(name, {}), **new}


def _new_name(path: str) -> str:
    package, _, _ = path.partition(".")
    if package == "uard" and path not in _NAMES:
        raise UnmappedError(f"uard had no class {path} that a result was of")
    if "<locals>" in path:
        raise UnmappedError(f"the class {path} is local to a function")
    if package == "uard":
        return _NAMES[path]
    module, _, name = path.rpartition(".")
    try:
        return type_name(getattr(importlib.import_module(module), name))
    except (ImportError, AttributeError, ValueError):  # the package is not installed here
        return f"{module}/{name}"


def _family_of(path: str) -> str:
    """Return the family of another package's agent."""
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise UnmappedError(
            f"its agent {path} cannot be imported, so that nobody knows how it learned ({error})"
        ) from None
    if not (isinstance(found, type) and issubclass(found, Agent)):
        raise UnmappedError(f"its agent {path} is no uard.agents.base.Agent")
    return found.family
