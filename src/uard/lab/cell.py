"""A cell: everything that defines a result but the seed, as one frozen object with a key."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

from uard import _checks
from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import TrapGrid
from uard.lab import registry
from uard.lab.config import key_of, plain, settled
from uard.lab.trainers import Trainer
from uard.method.mitigations import Mitigation, Raw
from uard.ratings.panels import MAIN, Panel
from uard.training.feedback.rating_model import RatingModel
from uard.training.feedback.transition_model import QUERIES, TransitionModel

EPISODES, STEPS = 500, 1_000_000
_RENAMED = {"feedback": "rating_model"}
# Of a mitigation that asks nobody, whatever was said of its raters.
_UNASKED: dict[str, Any] = {"panel": MAIN, "noise": 0.0, "rated": 1.0, "rating_model": None, "query": "random"}


@dataclass(frozen=True)
class Cell:
    """One environment, panel, agent and mitigation, trained for some episodes or steps.

    Examples:
        >>> from uard.method.mitigations import named
        >>> cell = Cell(TrapGrid(size=8), named("uard"), rated=0.1, episodes=200)
        >>> cell.trainer.name, cell.with_(noise=1).noise
        ('tabular', 1.0)
        >>> Cell(mitigation=named("raw"), rated=0.1) == Cell()  # it reads no ratings, however many there are
        True

    Attributes:
        environment: Where it learns.
        mitigation: What the agent does about a reward that may lie.
        agent: The learner.
        panel: Who rates. Irrelevant, and therefore ignored, for a mitigation that reads no ratings, and where an
            environment has judges of its own; so are ``noise``, ``rated``, ``rating_model`` and ``query``.
        noise: Standard deviation of extra noise on every rater, in reward units, >= 0.
        rated: Fraction of steps that are rated, in [0, 1].
        episodes: Training episodes, in 1..1 000 000; ignored on a simulator.
        ddof: Of the raters' deviation, 0 or 1.
        snapshots: Tables kept along the way, for the uncertainty curves, in 0..1000; tabular agents only.
        rating_model: How a deep agent knows of ratings: a model of them, or running means per state-action if None
            (which a tabular agent always has). On a simulator always a model of transitions.
        steps: Environment steps, in 1..10^12, on a simulator only; 1 000 000 if None.
        query: Which steps are rated: ``random``, or half of them where the model of ratings knows least (``doubtful``;
            on a simulator only).
    """

    def __new__(cls, *_: Any, **fields: Any) -> Self:
        """Refuse a field by a name that it had before.

        Raises:
            InvalidValueError: with the name that it has now.
        """
        for old, new in _RENAMED.items():
            if old in fields:
                raise _checks.InvalidValueError(old, fields[old], f"left out: the field is called {new} now")
        return super().__new__(cls)

    environment: Any = field(default_factory=TrapGrid)
    mitigation: Mitigation = field(default_factory=Raw)
    agent: Any = field(default_factory=QLearning)
    panel: Panel = MAIN
    noise: float = 0.0
    rated: float = 1.0
    episodes: int = EPISODES
    ddof: int = 0
    snapshots: int = 0
    rating_model: RatingModel | TransitionModel | None = None
    steps: int | None = None
    query: str = "random"

    def __post_init__(self) -> None:
        """Check everything; bring what means the same to one form, and forget what cannot matter.

        Raises:
            InvalidValueError: a field out of range, or an agent that cannot work in the environment, with those that
                can.
        """
        for name in ("environment", "mitigation", "agent", "panel"):
            self._put(name, _part(name, getattr(self, name)))
        self._check_numbers()
        trainer = registry.trainer(self.agent, self.environment)
        if self.mitigation.reads_truth and not trainer.knows_truth:
            allowed = "one that reads no true reward, but for a tabular agent"
            raise _checks.InvalidValueError("mitigation", self.mitigation, allowed)
        self._settle_budget(trainer)
        self._settle_feedback(trainer)
        if not (self.mitigation.reads_feedback and trainer.has_panel):
            for name, value in _UNASKED.items():
                self._put(name, value)

    def _put(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _check_numbers(self) -> None:
        _checks.number("noise", self.noise, low=0)
        _checks.number("rated", self.rated, low=0, high=1)
        _checks.whole("episodes", self.episodes, low=1, high=1_000_000)
        _checks.whole("ddof", self.ddof, low=0, high=1)
        _checks.whole("snapshots", self.snapshots, low=0, high=1000)
        for name in ("noise", "rated"):
            self._put(name, settled(name, float(getattr(self, name))))
        for name in ("episodes", "ddof", "snapshots"):
            self._put(name, int(getattr(self, name)))

    def _settle_budget(self, trainer: Trainer) -> None:
        if trainer.budget == "steps":
            steps = STEPS if self.steps is None else self.steps
            _checks.whole("steps", steps, low=1, high=10**12)
            self._put("steps", int(steps))
            self._put("episodes", EPISODES)
        elif self.steps is not None:
            raise _checks.InvalidValueError("steps", self.steps, "left out, except on a simulator: see episodes")
        if self.snapshots and not trainer.snapshots:
            raise _checks.InvalidValueError("snapshots", self.snapshots, "0 for an agent that keeps no tables")

    def _settle_feedback(self, trainer: Trainer) -> None:
        model = self.rating_model
        kinds = {type(m) for m in trainer.rating_models.values() if m is not None}
        if model is None and "table" not in trainer.rating_models:
            model = trainer.usual_rating_model
        elif model is not None and type(model) not in kinds:
            allowed = " or ".join([*(f"a {kind.__name__}" for kind in kinds), "none"])
            why = "" if kinds else " for a tabular agent, which keeps tables"
            raise _checks.InvalidValueError("rating_model", model, f"{allowed}{why}")
        self._put("rating_model", settled("rating_model", model))
        if _checks.choose("query", self.query, QUERIES) not in trainer.queries:
            raise _checks.InvalidValueError(
                "query", self.query, f"{' or '.join(trainer.queries)}, except on a simulator"
            )

    def config(self) -> dict[str, Any]:
        """Return the whole configuration as plain data; see ``uard.lab.config``."""
        return plain(self)

    @cached_property
    def trainer(self) -> Trainer:
        """Who trains it."""
        return registry.trainer(self.agent, self.environment)

    @cached_property
    def key(self) -> str:
        """A name made of the whole configuration and of how it is trained: equal cells have equal keys, only they do.

        It has a new one when the version of that kind of training is raised, and none when a class is moved.
        """
        return key_of(self.config(), self.trainer.name, self.trainer.version)

    def with_(self, **changes: Any) -> Cell:
        """Return a copy with some fields changed."""
        return replace(self, **changes)


_NAMED = {
    "environment": "uard.lab.registry.environment({!r}, {{}})",
    "mitigation": "uard.method.mitigations.named({!r})",
    "agent": "uard.lab.registry.agent({!r}, {{}}, environment)",
    "panel": "uard.ratings.panels.PANELS[{!r}]",
}


def _part(name: str, value: Any) -> Any:
    fault = _checks.not_frozen(value, Panel) if name == "panel" else registry.FAULTS[name](value)
    if fault is not None:
        hint = f", such as {_NAMED[name].format(value)}" if isinstance(value, str) else ""
        raise _checks.InvalidValueError(name, value, f"{fault}{hint}")
    return settled(name, value)
