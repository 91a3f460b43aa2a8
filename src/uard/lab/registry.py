"""Names that the command line and studies use, and what they stand for."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, get_args

from uard import _checks, plugins
from uard._support.fields import changed
from uard.agents import continuous
from uard.agents.actor_critic import SoftActorCritic, edac
from uard.agents.base import Agent, Family
from uard.agents.networks import Ensemble, Network
from uard.agents.policy import CPO, PPO, TRPO
from uard.agents.tabular import QLearning
from uard.agents.value import DeepQ
from uard.envs.base import Environment, Kind
from uard.envs.grids.trapgrid import TrapGrid
from uard.envs.names import ENVIRONMENTS
from uard.lab.trainers import Trainer, trainer_of
from uard.method import mitigations as mitigation
from uard.method.abstention import Abstention
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import TransitionModel


def deep_agents(network: Network | None = None) -> dict[str, Any]:
    """Return the paper's deep baselines (D4-D12) by name, with one network for all of them (J35).

    Ensemble members where the paper has them; others have what the algorithm itself needs.

    Examples:
        >>> small = deep_agents(Network(hidden=32))
        >>> small["dqn"].network.hidden, small["ensemble-dqn"].ensemble.members
        (32, 5)

    Args:
        network: The default one if left out.
    """
    net = network or Network()
    five = Ensemble("shared", 5)
    return {
        "dqn": DeepQ(net),
        "ensemble-dqn": DeepQ(net, five),
        "cql": DeepQ(net, conservative=1.0),
        "sunrise": DeepQ(net, five, ucb=1.0, temperature=10.0),
        "ppo": PPO(net),
        "trpo": TRPO(net),
        "cpo": CPO(net, oracle=False),
        "cpo-oracle": CPO(net),
        "sac": SoftActorCritic(net),
        "edac": edac(network=net),
    }


def continuous_agents(small: bool = False) -> dict[str, Any]:
    """Return the agents for continuous actions by name, with one network for all of a family (J35).

    Examples:
        >>> continuous_agents(small=True)["sac"].batch
        128

    Args:
        small: 64 units and batches of 128 for the actor-critic family, for a CPU; else 256 and 256.
    """
    one = Network(64, 3e-4, 100.0, "tanh")  # values are as large as 1 / (1 - gamma)
    shared: dict[str, Any] = {"gamma": 0.99, "rollout": 256, "epochs": 10, "minibatches": 32, "count_bonus": 0.0}
    critic: dict[str, Any] = {"network": Network(256, 3e-4, 1.0)}
    if small:
        critic = {"network": Network(64, 1e-3, 1.0), "batch": 128, "warmup": 2_000}
    return {
        "ppo": PPO(one, entropy=0.0, **shared),
        "trpo": TRPO(one, **shared),
        "cpo": CPO(one, oracle=False, **shared),
        "cpo-oracle": CPO(one, **shared),
        "sac": continuous.sac(**critic),
        "ensemble-sac": continuous.ensemble_sac(**critic),
        "cql": continuous.cql(**critic),
        "edac": continuous.edac(**critic),
        "sunrise": continuous.sunrise(**critic),
    }


CONTINUOUS: dict[str, Any] = continuous_agents()
AGENTS: dict[str, Agent] = {
    "q-learning": QLearning(),
    "random-walk": QLearning(1, 0.1, 0.95, 1.0, 1.0, 1.0),
    **deep_agents(),
}


def can_work(agent: Any, environment: Any) -> bool:
    """Whether an agent can work in an environment: tables need one that fits into them, motors a continuous agent.

    Examples:
        >>> can_work(AGENTS["q-learning"], ENVIRONMENTS["CartPole"])
        False
    """
    return trainer_of(agent, environment) is not None


def trainer(agent: Any, environment: Any) -> Trainer:
    """Return who trains an agent in an environment.

    Examples:
        >>> trainer(AGENTS["ppo"], ENVIRONMENTS["CartPole"]).name
        'compiled-rollout'

    Raises:
        InvalidValueError: it cannot work there; with the names of those that can.
    """
    if (found := trainer_of(agent, environment)) is not None:
        return found
    able = ", ".join(name for name, other in agents(environment).items() if can_work(other, environment))
    if environment.kind == "simulator":
        why = "whose actions are continuous"
    elif agent.family == "tabular":
        why = "which does not fit into tables"
    else:
        why = "whose actions are discrete"
    where = _known(environment, ENVIRONMENTS) or type(environment).__name__
    shown = _known(agent, agents(environment)) or _known(agent, AGENTS) or agent
    raise _checks.InvalidValueError("agent", shown, f"one that can work in {where}, {why}: {able}")


def _known(value: Any, names: Mapping[str, Any]) -> str:
    """Return the name of an environment or agent as it is listed; no text if it has none."""
    return next((name for name, other in names.items() if other == value), "")


def agents(environment: Any = None) -> dict[str, Any]:
    """Return the agents by name, as they are for an environment; those for discrete actions if it is left out.

    Not every one of them can work there; see ``can_work``.

    Examples:
        >>> "q-learning" in agents(), "q-learning" in agents(ENVIRONMENTS["Hopper"])
        (True, False)
    """
    return CONTINUOUS if environment is not None and environment.kind == "simulator" else AGENTS


OWN: dict[str, tuple[str, ...]] = {
    "environment": (*ENVIRONMENTS,),
    "agent": (*dict.fromkeys((*AGENTS, *CONTINUOUS)),),
    "mitigation": (*mitigation.NAMED,),
}


def _fault(value: object, kind: type, declared: str, known: tuple[str, ...]) -> str | None:
    if (why := _checks.not_frozen(value, kind)) is not None:
        return why
    if getattr(value, declared, None) not in known:
        return f"an {kind.__name__} that declares its {declared}: {', '.join(known)}"
    return None


FAULTS: dict[str, Callable[[Any], str | None]] = {
    "environment": lambda value: _fault(value, Environment, "kind", get_args(Kind)),
    "agent": lambda value: _fault(value, Agent, "family", get_args(Family)),
    "mitigation": mitigation.fault,
}
"""Of each kind, what says what an object must be if it cannot be used as one; None if it can."""


def brought(kind: str) -> tuple[dict[plugins.Plugin, Any], list[plugins.PluginError]]:
    """Return what other packages bring of a kind ("environment", "agent", "mitigation"), and what of it is broken.

    Examples:
        >>> theirs, broken = brought("mitigation")
        >>> broken
        []
    """
    return plugins.brought(kind, lambda plugin: plugin.make(FAULTS[kind]), OWN[kind])


def _of(kind: str, name: str, ours: dict[str, Any]) -> Any:
    if name in ours:
        return ours[name]
    return plugins.pick(kind, name, OWN[kind], [*ours]).make(FAULTS[kind])


def environment(name: str, changes: dict[str, Any]) -> Any:
    """Return an environment by name, ours or a plugin's, some fields changed.

    A new size of a TrapGrid, unless more is said, brings its own traps, goal and horizon.

    Examples:
        >>> environment("TrapGrid6", {"size": 8, "trap_reward": 2}).traps
        ((3, 3), (5, 6))

    Args:
        name: One of ``ENVIRONMENTS``, or what an installed package calls its own.
        changes: Values by field.

    Raises:
        UnknownNameError: a name or a field, with the nearest known one.
        InvalidValueError: from the environment, naming the field.
        PluginError: a plugin that cannot be used.
    """
    base = _of("environment", name, ENVIRONMENTS)
    if isinstance(base, TrapGrid) and changes.get("size", base.size) != base.size:
        base = base.resized(changes["size"])
    return changed(base, changes, "environment")


def agent(name: str, changes: dict[str, Any], environment: Any = None) -> Agent:
    """Return an agent by name, ours or a plugin's, as it is for an environment, some fields changed.

    ``abstention.rule`` and the like make a tabular one abstain.

    Examples:
        >>> agent("dqn", {"network.hidden": 32}).network.hidden
        32

    Args:
        name: One of ``agents(environment)``, or what an installed package calls its own.
        changes: Values by field; fields of a part by dotted names.
        environment: Where it shall work.

    Raises:
        UnknownNameError: a name or a field, with the nearest known one.
        InvalidValueError: from the agent, naming the field.
        PluginError: a plugin that cannot be used.
    """
    base = _of("agent", name, agents(environment))
    if isinstance(base, QLearning) and any(field.partition(".")[0] == "abstention" for field in changes):
        base = dataclasses.replace(base, abstention=Abstention())
    return changed(base, changes, "agent")


def rating_model(name: str | None, of: Agent, environment: Any) -> RatingModel | TransitionModel | None:
    """Return how an agent knows of ratings in an environment: by its name, or the first way its trainer has.

    Examples:
        >>> grid = ENVIRONMENTS["TrapGrid6"]
        >>> rating_model(None, AGENTS["dqn"], grid).members, rating_model("table", AGENTS["dqn"], grid)
        (5, None)

    Args:
        name: ``model``, or ``table`` for running means per state-action, which are no model: None.
        of: The agent.
        environment: Where it works.

    Raises:
        UnknownNameError: it cannot know of them in that way.
        InvalidValueError: it cannot work there.
    """
    found = trainer(of, environment)
    if name is None:
        return found.usual_rating_model
    return found.rating_models[_checks.choose("feedback", name, found.rating_models)]
