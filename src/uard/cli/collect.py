"""``uard collect``: from an agent or a file of answers to a page where people rate, and to a table. Needs no JAX."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from uard import _checks
from uard._support.text import counted
from uard.cli import progress, projects, terminal
from uard.cli.exporting import Export
from uard.cli.items import Items
from uard.cli.project_status import Status
from uard.cli.projects import ASKED, Asked, AskedOptions
from uard.cli.settings import Pairs
from uard.cli.settings import settings as read
from uard.cli.simulated import Simulate

if TYPE_CHECKING:
    from rich.console import Console

    from uard.collect import Item, Project

PORT = 8321
PASSWORD = "UARD_OWNER_PASSWORD"  # an environment variable: an option would stand in everybody's list of processes


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
        if self.asked.kind == "pairs":
            _checks.whole("--segments", self.segments, low=2)  # one alone has none to stand beside
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
        from uard.collect.texts import read_texts

        _check_pairs(self.pairs, self.seed)
        with projects.begun(self.project, self.asked) as project:
            before, items = projects.names(project), read_texts(self.file)
            asked = self._asked(project, items)
            with closing(project.store()) as store:
                store.add_items(items)
        prompts = len({item.content["prompt"] for item in items})
        terminal.say(console, f"{counted(len(items), 'completion')} of {counted(prompts, 'prompt')}")
        projects.tell_known(console, before, items, "")
        projects.finish(console, project, items, asked, self.pairs, self.seed)

    def _asked(self, project: Project, items: Sequence[Item]) -> Asked:
        """Return what is asked; in a new project that is pairs if there are two completions of each prompt.

        Raises:
            InvalidValueError: a new project is of pairs, and there are none.
        """
        from uard.collect.texts import comparable

        if not projects.is_new(project):
            return self.asked
        if self.asked.kind == "pairs" and not comparable(items):
            allowed = f"another one: {self.file} has no two completions of one prompt"
            raise _checks.InvalidValueError("--kind", "pairs", allowed)
        prompts = len({item.content["prompt"] for item in items})
        if self.asked.kind is None and projects.paid_by(items) is None and len(items) == 2 * prompts:
            return replace(self.asked, kind="pairs")  # such as chosen and rejected
        return self.asked


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
        from uard.collect import Project
        from uard.collect.serving import serve

        project = Project.open(self.project)
        with closing(project.store()) as store:
            projects.tell_unknown(console, project, store.items()[0])
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
