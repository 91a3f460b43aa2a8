"""``uard collect export``: the answers as a file."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from uard import _checks
from uard._support.text import counted
from uard.cli import terminal

if TYPE_CHECKING:
    from rich.console import Console

    from uard.collect import Question
    from uard.ratings.table import Answers

_ENDINGS = {".csv": "csv", ".jsonl": "jsonl", ".parquet": "parquet", ".pq": "parquet", ".json": "label-studio"}


@dataclass(frozen=True)
class Export:
    """Write the answers into a file."""

    project: Positional[str]
    """A project's folder."""
    file: Positional[str]
    """Where to: .csv, .jsonl, .parquet, or .json for Label Studio."""
    form: Literal["csv", "jsonl", "parquet", "trl", "label-studio", "record"] | None = None
    """What it holds; by its ending if left out. trl: preference rows; record: every answer that was ever given, those
    that were taken back included."""

    def run(self, console: Console) -> None:
        """Read the store and write the file."""
        from uard._support import files
        from uard.collect import Project
        from uard.ratings import export

        form = self.form or _ENDINGS.get(Path(self.file).suffix.lower())
        if form is None:
            allowed = f"a file that ends in {', '.join(_ENDINGS)}, or --form says what it holds"
            raise _checks.InvalidValueError("file", self.file, allowed)
        project = Project.open(self.project)
        project.outside(self.file, "file")
        with closing(project.store()) as store:
            (answers, _), (items, _) = store.answers(), store.items()
        if form != "record":
            answers = _with_numbers(answers, project.question)
        data = export.write(answers, {item.id: item.content for item in items}, form)
        try:
            with files.replacing(self.file) as file:
                file.write(data)
        except OSError as error:
            allowed = f"a file that can be written ({error.strerror or error})"
            raise _checks.InvalidValueError("file", self.file, allowed) from None
        readable = form in ("csv", "jsonl", "parquet")
        told = _next(answers, project.question, self.file) if readable else ""
        terminal.say(console, f"{_held(answers, data, form)} in {self.file}{told}")


def _with_numbers(answers: Answers, question: Question) -> Answers:
    """Return answers in which thumbs have what they are worth, which an old store does not say."""
    from uard.ratings.table import Answers

    worth = {"up": question.high, "down": question.low}
    if question.kind != "thumbs":
        return answers
    rows = (replace(a, value=worth[str(a.choice)]) if a.value is None and a.choice in worth else a for a in answers)
    return Answers(tuple(rows))


def _next(answers: Answers, question: Question, file: str) -> str:
    """Return which command reads the table that was written; nothing if there is nothing in it to read."""
    if question.kind == "pairs" and answers.comparisons():
        return f". Next: uard preferences {file}"
    rated = any(a.value is not None and not a.attribute and a.kind != "practice" for a in answers.standing())
    return f". Next: uard raters {file}" if rated else ""


def _held(answers: Answers, data: bytes, form: str) -> str:
    """Return how many rows a file holds, and why they may be fewer than the answers."""
    if form == "record":
        return f"{counted(len(answers), 'answer')}, practice and what was taken back included,"
    rated = sum(not a.attribute and a.kind != "practice" for a in answers.standing())
    if form == "trl":
        preferences = counted(data.count(b"\n"), "preference")
        return f"{preferences} of {counted(rated, 'answer')}, without ties and skips,"
    return counted(rated, "answer")
