"""A cell: everything that defines a result but the seed, as one frozen object with a key."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from uard import _checks
from uard.agents.tabular import QLearning
from uard.envs.base import CompiledEnvironment, SimulatedEnvironment
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import registry as names
from uard.method.mitigations import Mitigation, Raw
from uard.ratings.panels import MAIN, Panel
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import QUERIES, TransitionModel

# Raise this when training code changes what a cell means: old results are then not found, never mixed in.
RESULTS = 2
STEPS = 1_000_000
LATER = {"later": True}  # of a field that older results do not know; at its default it is no part of a key


@dataclass(frozen=True)
class Cell:
    """One environment, panel, agent and mitigation, trained for some episodes.

    Attributes:
        environment: Where it learns: an ``uard.envs.base.Spec``, or a ``Locomotion``.
        mitigation: What the agent does about a reward that may lie.
        agent: The learner.
        panel: Who rates. Irrelevant, and therefore ignored, for a mitigation that reads no ratings.
        noise: Standard deviation of extra noise on every rater, in reward units.
        rated: Fraction of steps that are rated, in [0, 1].
        episodes: Training episodes, >= 1; ignored for a ``Locomotion``.
        ddof: Of the annotators' deviation.
        snapshots: Tables kept along the way, for the uncertainty curves; tabular agents only.
        rating_model: How a deep agent knows of ratings: a model of them, or running means per state-action if None (which a
            tabular agent always has). For a ``Locomotion`` always a model of transitions.
        steps: Environment steps, for a ``Locomotion`` only; 1 000 000 if None.
        query: Which steps are rated: ``random``, or half of them where the model of ratings knows least (``doubtful``;
            for a ``Locomotion`` only).
    """

    environment: Any = field(default_factory=TrapGrid)
    mitigation: Mitigation = field(default_factory=Raw)
    agent: Any = field(default_factory=QLearning)
    panel: Panel = MAIN
    noise: float = 0.0
    rated: float = 1.0
    episodes: int = 500
    ddof: int = 0
    snapshots: int = 0
    rating_model: RatingModel | TransitionModel | None = field(default=None, metadata=LATER)
    steps: int | None = field(default=None, metadata=LATER)
    query: str = field(default="random", metadata=LATER)

    def __post_init__(self) -> None:
        """Check everything; forget what cannot matter.

        Raises:
            InvalidValueError: a field out of range, or an agent that cannot work in the environment, with those that
                can.
        """
        if not isinstance(self.panel, Panel):
            raise _checks.InvalidValueError("panel", self.panel, "a Panel (see uard.ratings.panels.PANELS)")
        _checks.number("noise", self.noise, low=0)
        _checks.number("rated", self.rated, low=0, high=1)
        _checks.whole("episodes", self.episodes, low=1, high=1_000_000)
        _checks.whole("ddof", self.ddof, low=0, high=1)
        _checks.whole("snapshots", self.snapshots, low=0, high=1000)
        _checks.choose("query", self.query, QUERIES)
        for name, kind in (
            ("environment", CompiledEnvironment | SimulatedEnvironment),
            ("mitigation", Mitigation),
            ("agent", names.Agent),
        ):
            value = getattr(self, name)
            if not isinstance(value, kind) or not _checks.is_frozen(value):
                raise _checks.InvalidValueError(name, value, f"a frozen dataclass that is {_an(kind)}")
            object.__setattr__(self, name, _settled(name, value))
        names.check_pair(self.agent, self.environment)
        physical = isinstance(self.environment, SimulatedEnvironment)
        if physical:
            _checks.whole("steps", STEPS if self.steps is None else self.steps, low=1, high=10**12)
            object.__setattr__(self, "steps", int(STEPS if self.steps is None else self.steps))
            object.__setattr__(self, "episodes", 500)
            if self.rating_model is None:
                object.__setattr__(self, "rating_model", TransitionModel())
        elif self.steps is not None:
            raise _checks.InvalidValueError("steps", self.steps, "left out but for Hopper and Walker2d; see episodes")
        elif self.query != "random":
            raise _checks.InvalidValueError("query", self.query, "random but for Hopper and Walker2d")
        if isinstance(self.agent, QLearning):
            if self.rating_model is not None:
                raise _checks.InvalidValueError(
                    "rating_model", self.rating_model, "none for a tabular agent, which keeps tables"
                )
        elif self.snapshots:
            raise _checks.InvalidValueError("snapshots", self.snapshots, "0 for an agent that keeps no tables")
        if self.rating_model is not None:
            wanted = TransitionModel if physical else RatingModel
            if not isinstance(self.rating_model, wanted):
                raise _checks.InvalidValueError("rating_model", self.rating_model, f"a {wanted.__name__} or none")
            object.__setattr__(self, "rating_model", _settled("rating_model", self.rating_model))
        if not self.mitigation.reads_feedback:
            unheard = {"panel": MAIN, "noise": 0.0, "rated": 1.0, "rating_model": None, "query": "random"}
            for name, value in unheard.items():
                object.__setattr__(self, name, value)
        for name, kind in (("noise", float), ("rated", float), ("episodes", int), ("ddof", int), ("snapshots", int)):
            object.__setattr__(self, name, kind(getattr(self, name)))

    def config(self) -> dict[str, Any]:
        """Return the whole configuration as plain data."""
        return plain(self)

    @cached_property
    def key(self) -> str:
        """A name made of the whole configuration: equal cells have equal keys, and only they."""
        text = json.dumps({"results": RESULTS, "cell": self.config()}, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:32]

    def with_(self, **changes: Any) -> Cell:
        """Return a copy with some fields changed."""
        return replace(self, **changes)


def _an(kind: Any) -> str:
    kinds = getattr(kind, "__args__", (kind,))
    return "a " + " or a ".join(k.__name__ for k in kinds)


def _settled(name: str, value: Any) -> Any:
    """Bring equal settings (2 and 2.0, 0.0 and -0.0, NumPy's numbers) to one form, so that their keys are equal.

    Raises:
        InvalidValueError: a setting that cannot be part of a key.
    """
    if _checks.is_frozen(value):
        changes = {}
        for f in _fields(type(value)):
            old = getattr(value, f.name)
            new = _settled(f"{name}.{f.name}", old)
            if new is old and type(new) is not int:
                continue
            if f.type in (float, "float") and type(new) is int:
                new = float(new)
            if type(new) is not type(old) or repr(new) != repr(old):
                changes[f.name] = new
        return replace(value, **changes) if changes else value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, tuple):
        return tuple(_settled(f"{name}[{i}]", v) for i, v in enumerate(value))
    if isinstance(value, float):
        _checks.number(name, value)
        return value if value else 0.0
    if not (value is None or isinstance(value, bool | int | str)):
        allowed = "a number, text, true, false, none, or a tuple or frozen dataclass of these"
        raise _checks.InvalidValueError(name, value, allowed)
    return value


@cache
def _fields(cls: type) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(cls)


def plain(value: Any) -> Any:
    """Turn (nested) dataclasses into dictionaries that name their class; see ``LATER``."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        cls = type(value)
        held = ((f, getattr(value, f.name)) for f in _fields(cls))
        fields = {f.name: plain(v) for f, v in held if not (f.metadata.get("later") and v == f.default)}
        return {"class": cls.__name__, **fields}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    return value
