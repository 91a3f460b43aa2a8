"""A project's question, as ``uard collect`` makes it from options and from what was recorded."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from uard import _checks
from uard._support.text import counted
from uard.cli import terminal

if TYPE_CHECKING:
    from rich.console import Console

    from uard.collect import Item, Project, Question

Kind = Literal["slider", "stars", "thumbs", "pairs"]
_ROUND = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_ASKED = {"thumbs": "Is this good?", "pairs": "Which of the two is better?"}


@dataclass(frozen=True)
class Asked:
    """What raters are asked, in a new project; that of an old one stands in its project.toml."""

    kind: Kind | None = None
    """How: slider, stars, thumbs, or pairs of items side by side."""
    low: float | None = None
    """The lowest value that can be given, in the reward's unit; by what was observed if left out."""
    high: float | None = None
    """The highest."""
    stars: int | None = None
    """How many, if the kind is stars."""
    question: str | None = None
    """The sentence above the item."""

    def given(self) -> dict[str, Any]:
        """Return what was said."""
        return {name: value for name, value in asdict(self).items() if value is not None}


ASKED = Asked()
AskedOptions = Annotated[Asked, arg(name="")]


@contextmanager
def begun(folder: str, asked: Asked) -> Iterator[Project]:
    """Begin a project, or open it; of a new one nothing is left if the block fails before anything is in it.

    Yields:
        The project, which items can be put into; a new one has no question yet.

    Raises:
        InvalidValueError: the folder cannot be made; a question that cannot be, or one for a project that has its own.
    """
    from uard._support import files
    from uard.collect import Project, Question
    from uard.collect.project import MEDIA, SETTINGS

    path = Path(folder)
    if (path / SETTINGS).exists():
        for name, value in asked.given().items():
            raise _checks.InvalidValueError(f"--{name}", value, f"left out: it stands in {path / SETTINGS}")
        files.prepare_folder(str(path / MEDIA), "project")
        yield Project.open(path)
        return
    low, high = asked.low, asked.high
    for name, value in (("--low", low), ("--high", high)):
        if value is not None:
            _checks.number(name, value, low=-_checks.LARGEST, high=_checks.LARGEST)
    if low is not None and high is not None and not low < high:
        raise _checks.InvalidValueError("--high", high, f"more than --low, {low:g}")
    question = Question(**{n: v for n, v in asked.given().items() if n not in ("low", "high")})
    files.prepare_folder(str(path / MEDIA), "project")
    try:
        yield Project(path, question)
    except BaseException:
        with suppress(OSError):  # of a folder that is not empty
            (path / MEDIA).rmdir()
            path.rmdir()
        raise


def names(project: Project) -> set[str]:
    """Return the names of the items that a project has now."""
    if not (project.folder / "answers.sqlite").exists():  # nothing is made yet that would be left if all failed
        return set()
    with closing(project.store()) as store:
        return {item.id for item in store.items()[0]}


def tell_known(console: Console, before: set[str], items: Sequence[Item], remedy: str) -> None:
    """Say how many items the project had already, and what brings others."""
    there = sum(item.id in before for item in items)
    if there:
        few = "all of them were" if there == len(items) else f"{there} of them {'was' if there == 1 else 'were'}"
        terminal.say(console, f"{few} in the project already{remedy}")


def tell_unknown(console: Console, project: Project, items: Sequence[Item]) -> None:
    """Warn of practice, gold and examples that are about no item of the project, and are not shown."""
    warn_unknown(console, project.unknown(items))


def warn_unknown(console: Console, unknown: Mapping[str, str]) -> None:
    """Warn of what ``Project.unknown`` has found."""
    for name, table in unknown.items():
        terminal.warning(console, f"[[{table}]] names an item that is not in the project: {name}")


def is_new(project: Project) -> bool:
    """Whether a project has no question yet."""
    from uard.collect.project import SETTINGS

    return not (project.folder / SETTINGS).exists()


def finish(
    console: Console, project: Project, items: Sequence[Item], asked: Asked, count: int | None, seed: int
) -> None:
    """Make a new project's question, and pairs if that is what it asks for; say what comes next."""
    from uard.collect import Project

    paid = paid_by(items)
    if is_new(project):
        question, why = _question(asked, items)
        project = Project.create(project.folder, question)
        terminal.say(console, f"raters are asked: {question.question} ({question.kind}{why})")
    elif project.question.kind in ("slider", "stars") and paid is not None:
        low, high = project.question.low, project.question.high
        if paid[0] < low or paid[1] > high:
            told = f"these pay {paid[0]:.3g} .. {paid[1]:.3g}, and raters can say {low:g} .. {high:g}"
            terminal.warning(console, f"{told}: see low and high in {project.folder / 'project.toml'}")
    if project.question.kind == "pairs":
        from uard.collect.texts import comparable, pairs

        few = len(items) if count is None and items and items[0].kind == "clip" else count
        made = pairs(items, project, few, seed) if comparable(items) else []
        terminal.say(console, counted(len(made), "pair") + ("" if made else ": they are made when raters ask for more"))
    terminal.say(console, f"next: uard collect serve {project.folder} --raters ann,bob")


def paid_by(items: Sequence[Item]) -> tuple[float, float] | None:
    """Return the least and the most that items pay; None where none says."""
    rewards = [item.reward for item in items if item.reward is not None]
    return (min(rewards), max(rewards)) if rewards else None


def _question(asked: Asked, items: Sequence[Item]) -> tuple[Question, str]:
    """Return the question of a new project, and why its range is what it is.

    The range is symmetric: what was paid for a hack may be as bad as it was paid well.
    """
    from uard.collect import Question

    given = asked.given()
    paid, texts = paid_by(items), items[0].kind == "text"
    kind = given.setdefault("kind", "stars" if texts and paid is None else "slider")
    if kind in _ASKED:
        given.setdefault("question", _ASKED[kind])
    elif texts:
        given.setdefault("question", "How good is this answer?")
    if texts:
        given["unit"] = "points" if paid is None else "points of the reward"
    if paid is None:
        low, high = (1.0, float(given.get("stars", 5))) if kind == "stars" else (-1.0, 1.0)
        why = ""
    else:
        high = round_up(max(map(abs, paid)))
        low, why = -high, ", the largest observed reward, rounded up, both ways"
    low, high = given.get("low", low), given.get("high", high)
    if not low < high:  # one of them was given, and lies beyond what was observed
        low, high = (low, low + max(1.0, abs(low))) if "low" in given else (high - max(1.0, abs(high)), high)
    given["low"], given["high"] = low, high
    if kind in ("thumbs", "pairs"):
        return Question(**given), ""
    chosen = asked.low is not None and asked.high is not None
    return Question(**given), f" from {given['low']:g} to {given['high']:g}{'' if chosen else why}"


def round_up(value: float) -> float:
    """Return the next number that is easy to read; 1 for none.

    Examples:
        >>> round_up(2.13), round_up(0.1), round_up(87.0), round_up(0.0)
        (2.5, 0.1, 100.0, 1.0)
    """
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    nearest = next((m for m in _ROUND if m * power >= value * (1 - 1e-9)), 10.0)
    return float(f"{nearest * power:.12g}")
