"""A project is a folder: its question (``project.toml``), its answers (``answers.sqlite``), its clips (``media``)."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from uard import _checks
from uard._support import files
from uard.collect.items import Item
from uard.collect.question import LISTS, SETTINGS, Known, Question, as_toml, question_of
from uard.collect.sqlite import SQLiteStore

ANSWERS, MEDIA, LOCK = "answers.sqlite", "media", "serving.lock"


@dataclass(frozen=True)
class Project:
    """A folder in which people rate.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     project = Project.create(Path(folder) / "walk", Question(kind="stars"))
        ...     project.question.kind, Project.open(project.folder).question == project.question
        ('stars', True)

    Attributes:
        folder: Where it is.
        question: What raters are asked.
    """

    folder: Path
    question: Question

    @staticmethod
    def create(folder: str | Path, question: Question | None = None) -> Project:
        """Make a project's folder; an existing project is opened and keeps its question.

        Raises:
            InvalidValueError: the folder cannot be made, or its ``project.toml`` is not what it must be.
        """
        path = Path(folder)
        if not (path / SETTINGS).exists():
            files.prepare_folder(str(path / MEDIA), "project")
            files.write(path / SETTINGS, as_toml(question or Question()), "project")
        return Project.open(path)

    @staticmethod
    def open(folder: str | Path) -> Project:
        """Open a project.

        Raises:
            InvalidValueError: there is none, or its ``project.toml`` is not what it must be.
        """
        path = Path(folder)
        file = path / SETTINGS
        try:
            data = tomllib.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise _checks.InvalidValueError(
                "project", str(folder), "a folder that `uard collect record` or `uard collect texts` has made"
            ) from None
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise _checks.InvalidValueError(str(file), str(error), "a TOML file that can be read") from None
        try:
            (path / MEDIA).mkdir(exist_ok=True)
        except OSError as error:
            raise _checks.InvalidValueError(str(path / MEDIA), error.strerror, "a folder, which holds clips") from None
        return Project(path, question_of(data, str(file)))

    def store(self) -> SQLiteStore:
        """Open its store; made if there is none yet.

        Raises:
            StoreError: it cannot be opened, or is of another version.
        """
        return SQLiteStore(self.folder / ANSWERS)

    def served_at(self) -> str | None:
        """Return the address of the server that shows the project now; None if it tells none."""
        try:
            return str(json.loads((self.folder / LOCK).read_bytes())["address"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def keep(self, data: bytes, ending: str) -> str:
        """Keep a file of a clip, and return its name, which is made of its content.

        Args:
            data: The file's bytes.
            ending: ``webp`` or ``npz``.
        """
        name = f"{hashlib.sha256(data).hexdigest()}.{ending}"
        path = self.folder / MEDIA / name
        if not path.exists():
            with files.replacing(path) as file:
                file.write(data)
        return name

    def media(self, name: str) -> Path:
        """Return the path of a file of a clip; it may be missing."""
        return self.folder / MEDIA / name

    def outside(self, target: str | None, field: str) -> None:
        """Refuse to write over what the project is made of.

        Args:
            target: Where a file is going to be written; None and ``-`` are nowhere.
            field: What that is called in the error.

        Raises:
            InvalidValueError: it is one of the project's own files.
        """
        if target is None or target == "-":
            return
        own, path = self.folder.resolve(), Path(target).resolve()
        names = (SETTINGS, LOCK, *(ANSWERS + ending for ending in ("", "-wal", "-shm", "-journal")))
        inside = path in {own / name for name in names} or path == own / MEDIA or own / MEDIA in path.parents
        if inside or self._is_clip(path):
            raise _checks.InvalidValueError(field, target, f"another file than those of the project {self.folder}")
        files.prepare(target, field, *(own / name for name in names))

    def _is_clip(self, path: Path) -> bool:
        """Whether a file is one of a clip under another name; only then has it several."""
        try:
            found = path.stat()
            return found.st_nlink > 1 and any(path.samefile(clip) for clip in (self.folder / MEDIA).iterdir())
        except OSError:  # there is none yet
            return False

    def unknown(self, items: Iterable[Item]) -> dict[str, str]:
        """Return the items that practice, gold or examples name and that are not there, each with the table's name."""
        there = {item.id for item in items}
        tables: dict[str, tuple[Known, ...]] = {table: getattr(self.question, name) for table, name in LISTS.items()}
        return {k.item: table for table, entries in tables.items() for k in entries if k.item not in there}

    def damaged(self, items: Iterable[Item]) -> dict[str, str]:
        """Return which items cannot be shown, and why: a file is missing, or was changed since it was recorded."""
        verdicts: dict[str, str | None] = {}
        found: dict[str, str] = {}
        for item in items:
            for name in item.media:
                if name not in verdicts:
                    verdicts[name] = self._wrong(name)
                if (why := verdicts[name]) is not None:
                    found[item.id] = why
        return found

    def _wrong(self, name: str) -> str | None:
        path = self.media(name)
        try:
            changed = hashlib.sha256(path.read_bytes()).hexdigest() != name.split(".")[0]
        except FileNotFoundError:
            return f"{path} is missing"
        except OSError as error:
            return f"{path} cannot be read ({error.strerror})"
        return f"{path} was changed after it was recorded" if changed else None
