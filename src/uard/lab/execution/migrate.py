"""Brings what older versions have written over to the present format of configurations and keys: ``uard migrate``.

Up to format 2 a class stood in a configuration with its address, a panel with its name, and fields at their defaults
were left out if they were younger than the format. The tables below say what became of each. They are of the day on
which format 3 began, and stay as they are: what is done to a class later is no part of them.

Whatever is migrated, the old file is kept beside the new one.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uard import _checks
from uard._support import files
from uard.agents.base import Agent
from uard.lab.config import FORMAT, TYPE, key_of
from uard.lab.execution.claims import Owner
from uard.lab.execution.store import OLDEST, TABLES, StoreError, check_store, create_tables
from uard.lab.result import digest

# New names of metrics and of the log's columns, by their old ones.
METRICS: dict[str, str] = {}
COLUMNS: dict[str, str] = {}

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
    usual = {"temptation": 0.0, "bias": 0.0, "scale": 1.0, "noise": 0.1, "contested_noise": None, "lapse": 0.0}
    return {TYPE: "Rater", **usual, "coverage": 1.0, "stars": None, **changes}


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


@dataclass(frozen=True)
class Migration:
    """What became of an old store or file.

    Attributes:
        path: What was migrated; the new one stands there now.
        backup: The old one.
        cells: That have new keys.
        rows: By table, how many rows were brought over; of a file of published results, only ``results``: its seeds.
        left: What stands in the backup only: why, and how many rows that are.
        checkpoints: Unfinished long runs, which begin again: their checkpoints are an older program's.
    """

    path: Path
    backup: Path
    cells: int
    rows: Counter[str]
    left: Counter[str] = field(default_factory=Counter)
    checkpoints: int = 0


def lines(migration: Migration) -> list[str]:
    """Return what is to be said of it."""
    m = migration
    others = ", ".join(f"{count} {table}" for table, count in m.rows.items() if table != "results")
    said = [f"{m.path}: {m.cells} cells, {m.rows['results']} seeds have new keys{f'; {others}' if others else ''}"]
    said += [f"only in {m.backup}: {count} rows, for {why}" for why, count in m.left.items()]
    if m.checkpoints:
        said.append(f"{m.checkpoints} long runs begin again: their checkpoints are an older version's")
    return [*said, f"the old file is kept as {m.backup}"]


def migrate(path: str | Path) -> Migration:
    """Bring a result store, or a JSON file of published results, over to the present format.

    Raises:
        InvalidValueError: there is no such file, or nothing in it to migrate.
        StoreError: the store is damaged, cannot be written, is in use, or is of another format than the last.
    """
    path = Path(path)
    if not path.is_file():
        raise _checks.InvalidValueError("path", str(path), "a result store, or a JSON file of published results")
    backup = path.with_name(f"{path.name}.format-{OLDEST}")
    return _migrate_published(path, backup) if path.suffix == ".json" else _migrate_store(path, backup)


def new_config(old: dict[str, Any]) -> dict[str, Any]:
    """Return the present form of a configuration of format 2.

    Raises:
        UnmappedError: it has none.
    """
    config = _new_value(old)
    if config[TYPE] != "Cell" or old.get("panel") not in _PANELS:
        raise UnmappedError(f"no cell of format {OLDEST} looked like that: {_checks.short(old)}")
    return config | {"panel": _PANELS[old["panel"]]}


def new_key(config: dict[str, Any], old: dict[str, Any]) -> str:
    """Return the key of a configuration.

    Args:
        config: What ``new_config`` returned.
        old: What it was made of.

    Raises:
        UnmappedError: nobody knows how it was trained.
    """
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
    return _NAMES[path] if package == "uard" else f"{package}/{path.rpartition('.')[2]}"


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


class _Keys:
    """New keys and configurations by old keys, and why there is none."""

    def __init__(self, configs: dict[str, dict[str, Any]]):
        self.new: dict[str, tuple[str, dict[str, Any]]] = {}
        self.why: dict[str, str] = {}
        for key, old in configs.items():
            try:
                config = new_config(old)
                self.new[key] = new_key(config, old), config
            except UnmappedError as error:
                self.why[key] = str(error)

    def reason(self, key: str) -> str:
        """Return why an old key has no new one."""
        return self.why.get(key, "no configuration is stored with their keys")


def _migrate_published(path: Path, backup: Path) -> Migration:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise _checks.InvalidValueError("path", str(path), f"JSON ({error})") from None
    if not isinstance(data, dict) or "cells" not in data or data.get("results") != OLDEST:
        allowed = f"published results of format {OLDEST} (what `uard reproduce --extract` wrote)"
        raise _checks.InvalidValueError("path", str(path), allowed)
    keys, rows, left, cells = _Keys({k: c["config"] for k, c in data["cells"].items()}), Counter[str](), Counter(), {}
    for key, cell in data["cells"].items():
        if key not in keys.new:
            left[keys.reason(key)] += len(cell["seeds"])
            continue
        new, config = keys.new[key]
        cells[new] = {**cell, "config": config, "metrics": _renamed(cell["metrics"], METRICS)}
        if "curves" in cell:
            cells[new]["curves"] = _renamed(cell["curves"], COLUMNS)
        rows["results"] += len(cell["seeds"])
    _check_free(path, backup)
    head = {"format" if k == "results" else k: FORMAT if k == "results" else v for k, v in data.items()}
    shutil.copy2(path, backup)
    files.write(path, json.dumps(head | {"cells": cells}, allow_nan=False) + "\n", "path")
    return Migration(path, backup, len(cells), rows, left)


def _check_free(path: Path, backup: Path) -> None:
    if backup.exists():
        raise _checks.InvalidValueError("path", str(path), f"one whose backup is not there yet; move {backup} away")


def _renamed(values: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    return {names.get(name, name): value for name, value in values.items()}


def _migrate_store(path: Path, backup: Path) -> Migration:
    fresh = path.with_name(f"{path.name}.migrating")
    fresh.unlink(missing_ok=True)
    try:
        with _alone(path) as source, closing(sqlite3.connect(fresh)) as target:
            _check_free(path, backup)
            create_tables(target)
            cells, rows, left = _copied(source, target)
            target.close()
            _keep(path, backup)
            os.replace(fresh, path)  # while nobody else can write
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"store = {str(path)!r}: could not be migrated ({error}); nothing was changed") from None
    finally:
        fresh.unlink(missing_ok=True)
    checkpoints = len(list(Path(f"{path}-checkpoints").glob("*.checkpoint")))
    return Migration(path, backup, cells, rows, left, checkpoints)


@contextmanager
def _alone(path: Path) -> Iterator[sqlite3.Connection]:
    """Open an old store so that nobody else reads or writes it, all of it in one file.

    Raises:
        StoreError: it is at work, or of another format.
        sqlite3.Error: it is in use, or damaged.
    """
    with closing(sqlite3.connect(path, timeout=5)) as db:
        if db.execute("pragma user_version").fetchone()[0] == FORMAT:
            raise StoreError(f"store = {str(path)!r}: is of format {FORMAT} already; there is nothing to migrate")
        tables = check_store(db, str(path), OLDEST)
        if "runs" in tables:
            living = "select token, host, place, pid, born, beat from runs where ended is null"
            for *owner, beat in db.execute(living):
                if Owner(*owner).alive(beat):
                    raise StoreError(
                        f"store = {str(path)!r}: {Owner(*owner)} is at work on it; wait for it, or stop it"
                    )
        db.execute("pragma locking_mode = exclusive")
        db.execute("pragma journal_mode = delete")  # fails while another process has it open
        db.execute("begin exclusive")
        yield db
        db.rollback()


def _keep(path: Path, backup: Path) -> None:
    """Make the backup without taking the store away, not even for a moment."""
    try:
        os.link(path, backup)
    except OSError:  # a file system without links
        shutil.copy2(path, backup)


def _copied(source: sqlite3.Connection, target: sqlite3.Connection) -> tuple[int, Counter[str], Counter[str]]:
    """Copy all rows with new keys; return how many cells and rows there are, and why which were left out."""
    there = {row[0] for row in source.execute("select name from sqlite_master where type = 'table'")}
    keys = _Keys({key: json.loads(text) for key, text in source.execute("select key, config from cells")})
    rows, left = Counter[str](), Counter[str]()
    with target:
        for new, config in keys.new.values():
            text = json.dumps(config, sort_keys=True)
            rows["cells"] += target.execute("insert or ignore into cells values (?, ?)", (new, text)).rowcount
        for table in (t for t in TABLES if t in there and t != "cells"):
            names = [row[1] for row in target.execute(f"pragma table_info({table})")]
            for values in source.execute(f"select {', '.join(names)} from {table}"):
                row = dict(zip(names, values, strict=True))
                if "key" in row and row["key"] not in keys.new:
                    left[keys.reason(row["key"])] += 1
                    continue
                if "key" in row:
                    row["key"] = keys.new[row["key"]][0]
                place, row = _checked(table, row)
                marks = ", ".join("?" * len(row))
                put = f"insert or ignore into {place} ({', '.join(row)}) values ({marks})"
                added = target.execute(put, tuple(row.values())).rowcount
                rows[place] += added
                left["another row of the same cell and seed was there"] += 1 - added
    return rows.pop("cells", 0), rows, +left


def _checked(table: str, row: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return a row with new names of metrics, and its table: a result that is not sound goes into quarantine."""
    if table != "results":
        return table, row
    if digest(row["data"] + row["metrics"].encode()) != row["checksum"]:
        kept = {k: row[k] for k in ("key", "seed", "data", "created")}
        return "quarantine", kept | {"reason": "checksum does not match"}
    if METRICS:
        metrics = json.dumps(_renamed(json.loads(row["metrics"]), METRICS))
        row |= {"metrics": metrics, "checksum": digest(row["data"] + metrics.encode())}
    return table, row
