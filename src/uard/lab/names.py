"""Names that the command line and studies use, and how ``--set`` changes what they stand for."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from uard import _checks, mitigation
from uard.abstention import Abstention
from uard.agents.actor_critic import SoftActorCritic, edac
from uard.agents.off_policy import OffPolicy
from uard.agents.policy import CPO, PPO, TRPO, PolicyGradient
from uard.agents.tabular import QLearning
from uard.agents.value import DeepQ
from uard.envs.classic import Acrobot, CartPole
from uard.envs.gaming import AbsentSupervisor, BoatRace, TomatoWatering
from uard.envs.panels import PANELS
from uard.envs.spec import Tables
from uard.envs.trapgrid import TrapGrid
from uard.feedback.learned import RatingModel
from uard.mitigation import Mitigation
from uard.networks import Ensemble, Network

ENVIRONMENTS: dict[str, Any] = {
    "TrapGrid": TrapGrid(),
    **{f"TrapGrid{n}": TrapGrid(size=n) for n in (6, 8, 10)},
    **{f"TrapGrid{n}-Trap8": TrapGrid(size=n, trap_reward=8.0) for n in (6, 8, 10)},
    **{f"TrapGrid{n}-Legitimate": TrapGrid(size=n, legitimate=True) for n in (6, 8, 10)},
    "TrapGrid10-T100": TrapGrid(size=10, horizon=100),
    **{
        f"{spec.__name__}{suffix}": spec(legitimate=bool(suffix))
        for spec in (BoatRace, TomatoWatering, AbsentSupervisor)
        for suffix in ("", "-Legitimate")
    },
    "CartPole": CartPole(),
    "Acrobot": Acrobot(),
}


def deep_agents(network: Network | None = None) -> dict[str, Any]:
    """Return the paper's deep baselines (D4-D12) by name, with one network for all of them (J35).

    Ensemble members where the paper has them; others have what the algorithm itself needs.
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


Agent = QLearning | OffPolicy | PolicyGradient
AGENTS: dict[str, Agent] = {
    "q-learning": QLearning(),
    "random-walk": QLearning(1, 0.1, 0.95, 1.0, 1.0, 1.0),
    **deep_agents(),
}


def can_work(agent: Any, environment: Any) -> bool:
    """Whether an agent can work in an environment: one with tables needs an environment that fits into them."""
    return isinstance(environment, Tables) or not isinstance(agent, QLearning)


def check_pair(agent: Any, environment: Any) -> None:
    """Refuse an agent that cannot work in an environment.

    Raises:
        InvalidValueError: with the names of those that can.
    """
    if not can_work(agent, environment):
        able = ", ".join(name for name, other in AGENTS.items() if can_work(other, environment))
        where = type(environment).__name__
        raise _checks.InvalidValueError(
            "agent", agent, f"one that can work in {where}, which does not fit into tables: {able}"
        )


def settings(pairs: tuple[str, ...], option: str = "--set") -> dict[str, Any]:
    """Read ``name=value`` pairs; values are JSON, or else text.

    Raises:
        InvalidValueError: a pair without ``=``.
    """
    out: dict[str, Any] = {}
    for pair in pairs:
        name, sign, value = pair.partition("=")
        if not sign or not name:
            raise _checks.InvalidValueError(option, pair, "name=value, such as size=12 or 'traps=[[2,5],[7,3]]'")
        try:
            out[name] = json.loads(value)
        except json.JSONDecodeError:
            out[name] = value
    return out


def changed(base: Any, changes: dict[str, Any], what: str) -> Any:
    """Return a frozen dataclass with some fields changed; nested ones by dotted names.

    Raises:
        UnknownNameError: an unknown field, with the nearest known one.
    """
    fields = {f.name: f for f in dataclasses.fields(base) if f.init}
    given: dict[str, Any] = {}
    for name, value in changes.items():
        head, _, rest = name.partition(".")
        if head not in fields:
            raise _checks.UnknownNameError(f"{what} setting", name, fields)
        old = given.get(head, getattr(base, head))
        parts = [f"{head}.{f.name}" for f in dataclasses.fields(old)] if dataclasses.is_dataclass(old) else []
        if bool(rest) != bool(parts):
            raise _checks.InvalidValueError(f"{what} setting", name, f"one of {', '.join(parts)}" if parts else head)
        if rest:
            value = changed(old, {rest: value}, f"{what}.{head}")
        elif isinstance(old, bool) and not isinstance(value, bool):
            raise _checks.InvalidValueError(f"{what} setting {name}", value, "true or false")
        elif isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        elif isinstance(value, list):
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
        given[head] = value
    return dataclasses.replace(base, **given)


def environment(name: str, changes: dict[str, Any]) -> Any:
    """Return an environment by name. A new size, unless more is said, brings its own traps, goal and horizon."""
    base = ENVIRONMENTS[_checks.choose("environment", name, ENVIRONMENTS)]
    if isinstance(base, TrapGrid) and changes.get("size", base.size) != base.size:
        base = TrapGrid(trap_reward=base.trap_reward, legitimate=base.legitimate)
        base = _bare(base)
    return changed(base, changes, "environment")


def _bare(grid: TrapGrid) -> TrapGrid:
    """Undo what the constructor filled in from the size."""
    copy = object.__new__(TrapGrid)
    for f in dataclasses.fields(TrapGrid):
        keep = f.name not in ("traps", "goal", "horizon", "size")
        object.__setattr__(copy, f.name, getattr(grid, f.name) if keep else f.default)
    return copy


def agent(name: str, changes: dict[str, Any]) -> Agent:
    """Return an agent by name, some fields changed (``abstention.rule`` and the like make it abstain)."""
    base = AGENTS[_checks.choose("agent", name, AGENTS)]
    if isinstance(base, QLearning) and any(field.partition(".")[0] == "abstention" for field in changes):
        base = dataclasses.replace(base, abstention=Abstention())
    return changed(base, changes, "agent")


def feedback(name: str | None, of: Agent) -> RatingModel | None:
    """Return how an agent knows of ratings: ``model`` (a deep agent's default) or ``table`` (a tabular one's)."""
    if name is None:
        return None if isinstance(of, QLearning) else RatingModel()
    return RatingModel() if _checks.choose("feedback", name, ("model", "table")) == "model" else None


def mitigation_named(name: str, changes: dict[str, Any]) -> Mitigation:
    """Return a mitigation by name, some fields changed (``filter.lam`` and the like for the filter's)."""
    base: Any = mitigation.named(name)
    short = {f.name for f in dataclasses.fields(base.filter)} if hasattr(base, "filter") else set()
    known = short | {f.name for f in dataclasses.fields(base)}
    for setting in changes:
        _checks.choose("mitigation setting", setting.partition(".")[0], known)
    return changed(base, {f"filter.{k}" if k in short else k: v for k, v in changes.items()}, "mitigation")


def panel(name: str) -> str:
    """Return a panel's name if there is one."""
    return _checks.choose("panel", name, PANELS)
