"""``uard collect``: from an agent or a file of answers to a page where people rate, and to a table. Needs no JAX."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlsplit

from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from uard import __version__, _checks
from uard._support.text import counted
from uard.cli import progress, projects, terminal
from uard.cli.items import Items
from uard.cli.projects import ASKED, AskedOptions
from uard.cli.settings import Pairs
from uard.cli.settings import settings as read
from uard.cli.simulated import Simulate

if TYPE_CHECKING:
    from rich.console import Console

    from uard.collect import Project
    from uard.ratings.table import Answers

PORT = 8321
PASSWORD = "UARD_OWNER_PASSWORD"  # an environment variable: an option would stand in everybody's list of processes
_ENDINGS = {".csv": "csv", ".jsonl": "jsonl", ".parquet": "parquet", ".pq": "parquet", ".json": "label-studio"}


@dataclass(frozen=True)
class Record:
    """Record clips of an agent in any Gymnasium environment that draws pictures.

    Three commands lead to a page where people rate: pip install 'uard[collect,lab,mujoco]', uard collect record
    Hopper-v5 hopper, uard collect serve hopper --raters ann,bob.
    """

    environment: Positional[str]
    """The id of a Gymnasium environment, such as Hopper-v5, or a name of `uard run`, such as TrapGrid."""
    project: Positional[str]
    """A folder; made if it is not there, else clips are added."""
    policy: str = "random"
    """Who acts: random; sb3:FILE, an agent that Stable-Baselines3 has saved (PPO, A2C, DQN, SAC, TD3; such a file is
    executed, so take none from a stranger; observations that were normalised in training are not normalised here); or
    uard:STORE, an agent of `uard run --store` in a world of tables, @CELL or @CELL:SEED behind it if there are
    several."""
    segments: int = 200
    """How many different clips."""
    length: int = 50
    """Steps of a clip; 1 for ratings of single state-actions."""
    asked: AskedOptions = ASKED
    pairs: int | None = None
    """If the kind is pairs, how many; as many as clips if left out."""
    stratum: str | None = None
    """What the clips are called in statistics; the policy's name if left out."""
    fps: float | None = None
    """Frames per second; the environment's own, at most 30, if left out."""
    set: Pairs = ()
    """A keyword of the environment, e.g. size=8. Repeatable."""
    seed: int = 0
    """Of the environment, of random actions, and of where clips begin."""

    def run(self, console: Console) -> None:
        """Record, make the project, and say what comes next."""
        from uard.cli import acting
        from uard.collect.record import record

        _check_pairs(self.pairs, self.seed)
        with (
            closing(acting.environment(self.environment, read(self.set))) as env,
            projects.begun(self.project, self.asked) as project,
        ):
            act, before = acting.policy(self.policy, env), projects.names(project)
            with progress.bar(console, f"recording {self.environment}") as move:
                clips = record(
                    env,
                    act.policy,
                    project,
                    segments=self.segments,
                    length=self.length,
                    seed=self.seed,
                    fps=self.fps,
                    stratum=act.name if self.stratum is None else self.stratum,
                    progress=lambda done, total: move(done, total, None),
                )
        frames = sum(clip.content["frames"] for clip in clips)
        paid = projects.paid_by(clips)
        observed = f", observed reward per step {paid[0]:.3g} .. {paid[1]:.3g}" if paid else ""
        terminal.say(console, f"{counted(len(clips), 'clip')} ({act.name}), {counted(frames, 'frame')}{observed}")
        if len(clips) < self.segments:
            terminal.say(console, f"fewer than {self.segments}: after these, no new ones came")
        projects.tell_known(console, before, clips, ": another --seed makes others")
        projects.finish(console, project, clips, self.asked, self.pairs, self.seed)


@dataclass(frozen=True)
class Texts:
    """Take prompts and completions from a file."""

    file: Positional[str]
    """A JSONL, JSON, CSV or Parquet file with a prompt and a completion (or a list of them) per row, or chosen and
    rejected, or messages; reward and model if they are there."""
    project: Positional[str]
    """A folder; made if it is not there, else texts are added."""
    asked: AskedOptions = ASKED
    pairs: int | None = None
    """If the kind is pairs, how many; all completions of a prompt with each other if left out."""
    seed: int = 0
    """Of which pairs are drawn."""

    def run(self, console: Console) -> None:
        """Read, make the project, and say what comes next."""
        from uard.collect.texts import texts

        _check_pairs(self.pairs, self.seed)
        with projects.begun(self.project, self.asked) as project:
            before = projects.names(project)
            items = texts(self.file, project)
        prompts = len({item.content["prompt"] for item in items})
        terminal.say(console, f"{counted(len(items), 'completion')} of {counted(prompts, 'prompt')}")
        projects.tell_known(console, before, items, "")
        asked = self.asked
        if (
            asked.kind is None
            and projects.is_new(project)
            and projects.paid_by(items) is None
            and len(items) == 2 * prompts
        ):
            asked = replace(asked, kind="pairs")  # such as chosen and rejected
        projects.finish(console, project, items, asked, self.pairs, self.seed)


@dataclass(frozen=True)
class Serve:
    """Show the page where people rate, and the owner's page, until it is stopped with Ctrl-C.

    The owner's password is made anew at each start, and printed, unless the environment variable UARD_OWNER_PASSWORD
    holds one.
    """

    project: Positional[str]
    """A project's folder."""
    raters: str = ""
    """Names of the raters, with commas between them; each gets a link of their own. Raters who were invited before need
    not be named again."""
    port: int = PORT
    """Where to listen."""
    host: str = "127.0.0.1"
    """Where to listen; 127.0.0.1 is this machine only."""
    public_url: str | None = None
    """The address by which raters reach the page, such as https://rate.example.org, if something stands before it."""
    new_links: bool = False
    """Give new links to raters who have one; the old ones are void."""

    def run(self, console: Console) -> None:
        """Serve."""
        from uard.collect.serving import serve

        names = [name.strip() for name in self.raters.split(",") if name.strip()]
        serve(
            self.project,
            names,
            host=self.host,
            port=self.port,
            public_url=self.public_url,
            owner_password=os.environ.get(PASSWORD) or None,
            new_links=self.new_links,
            say=lambda line: terminal.say(terminal.output(), line),
        )


@dataclass(frozen=True)
class Invite:
    """Give a rater a new link, also while the page is served; links that they had before are void."""

    project: Positional[str]
    """A project's folder."""
    name: Positional[str]
    """The rater's name, as it will stand in the table."""
    url: str | None = None
    """The address by which raters reach the page; that of the running server if left out."""

    def run(self, console: Console) -> None:
        """Invite."""
        from uard.collect import Project

        project = Project.open(self.project)
        url = (self.url or project.served_at() or f"http://127.0.0.1:{PORT}").rstrip("/")
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise _checks.InvalidValueError("url", self.url, "an address such as https://rate.example.org")
        with closing(project.store()) as store:
            new = self.name not in {rater.name for rater in store.raters()}
            secret = store.invite(self.name)
        terminal.say(terminal.output(), f"{url}/enter/{secret}")
        serve = "" if project.served_at() else f" Next: uard collect serve {self.project}"
        who = f"{self.name}, a new rater" if new else self.name
        terminal.say(console, f"give this link to {who}: it works once.{serve}")


@dataclass(frozen=True)
class Status:
    """Say how far a project is: answers, by rater, and what is still to come."""

    project: Positional[str]
    """A project's folder."""
    json: str | None = None
    """Write one JSON object to this file; - for standard output."""

    def run(self, console: Console) -> None:
        """Read the store and print numbers."""
        from uard.collect import Project

        project = Project.open(self.project)
        project.outside(self.json, "json")
        found = _status(project)
        if self.json is not None:
            terminal.write_json({"version": __version__, "project": self.project} | found, self.json)
        if self.json != "-":
            rows = [_row(rater) for rater in found["raters"]]
            if rows:
                terminal.table(("rater", "answers", "skipped", "coverage", "link used"), rows, self.project)
            out = terminal.output()
            for line in _told(found):
                terminal.say(out, line)
        for name, why in found["damaged"].items():
            terminal.warning(console, f"item {name} is not shown: {why}")
        for name, table in found["unknown"].items():
            terminal.warning(console, f"[[{table}]] names an item that is not in the project: {name}")
        terminal.say(console, f"next: {_next(found, self.project)}")


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
        data = export.write(answers, {item.id: item.content for item in items}, form)
        try:
            with files.replacing(self.file) as file:
                file.write(data)
        except OSError as error:
            allowed = f"a file that can be written ({error.strerror or error})"
            raise _checks.InvalidValueError("file", self.file, allowed) from None
        terminal.say(console, f"{_held(answers, data, form)} in {self.file}{self._next(answers, project, form)}")

    def _next(self, answers: Answers, project: Project, form: str) -> str:
        """Return what can be done with the file."""
        if form not in ("csv", "jsonl", "parquet") or not answers.standing():
            return ""
        return f". Next: {'uard preferences' if project.question.kind == 'pairs' else 'uard raters'} {self.file}"


def _held(answers: Answers, data: bytes, form: str) -> str:
    """Return how many rows a file holds, and why they may be fewer than the answers."""
    if form == "record":
        return f"{counted(len(answers), 'answer')}, practice and what was taken back included,"
    rated = sum(not a.attribute and a.kind != "practice" for a in answers.standing())
    if form == "trl":
        preferences = counted(data.count(b"\n"), "preference")
        return f"{preferences} of {counted(rated, 'answer')}, without ties and skips,"
    return counted(rated, "answer")


_Action = (
    Annotated[Record, subcommand("record")]
    | Annotated[Texts, subcommand("texts")]
    | Annotated[Serve, subcommand("serve")]
    | Annotated[Invite, subcommand("invite")]
    | Annotated[Status, subcommand("status")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Items, subcommand("items")]
)


@dataclass(frozen=True)
class Collect:
    """Let people rate clips of an agent, or texts: record, serve the page, export what they said."""

    action: OmitSubcommandPrefixes[Annotated[_Action, arg(name="")]]

    def run(self, console: Console) -> None:
        """Do what was asked for."""
        self.action.run(console)


def _check_pairs(pairs: int | None, seed: int) -> None:
    """Refuse before the project is made, not after it, what no pairs can be drawn by."""
    if pairs is not None:
        _checks.whole("--pairs", pairs, low=1, high=1_000_000)
    _checks.whole("--seed", seed, low=0, high=2**63 - 1)


def _status(project: Project) -> dict[str, Any]:
    from uard.collect.app.overview import overview

    with closing(project.store()) as store:
        (answers, _), (items, _), raters = store.answers(), store.items(), store.raters()
        open_requests = len(store.open_requests()[0])
    by_name = {item.id: item for item in items}
    seen = overview(answers, by_name, project.question, [rater.name for rater in raters])
    states = {rater.name: rater for rater in raters}
    rows = [
        {"name": r.name, "answers": r.answers, "skipped": r.skipped, "coverage": r.coverage}
        | {"entered": r.name in states and states[r.name].entered}
        | {"paused": r.name in states and states[r.name].paused}
        for r in seen.raters
    ]
    return {
        "items": seen.items,
        "rated": seen.rated,
        "complete": seen.complete,
        "answers": seen.answers,
        "wanted": seen.wanted,
        "open_requests": open_requests,
        "raters": rows,
        "damaged": project.damaged(items),
        "unknown": project.unknown(items),
    }


def _row(rater: dict[str, Any]) -> tuple[str, ...]:
    name = f"{rater['name']} (paused)" if rater["paused"] else rater["name"]
    used = "yes" if rater["entered"] else "no"
    return name, str(rater["answers"]), str(rater["skipped"]), f"{rater['coverage']:.0%}", used


def _told(found: dict[str, Any]) -> list[str]:
    items, out = counted(found["items"], "item"), counted(found["open_requests"], "question")
    return [
        f"{items}, {found['rated']} of them rated, {found['complete']} by as many as wanted",
        f"{found['answers']} of {found['wanted']} answers that are wanted; {out} given out and not answered yet",
    ]


def _next(found: dict[str, Any], folder: str) -> str:
    if not found["raters"]:
        return f"uard collect serve {folder} --raters ann,bob"
    if found["answers"] < found["wanted"]:
        return f"uard collect serve {folder}"
    return f"uard collect export {folder} answers.csv"
