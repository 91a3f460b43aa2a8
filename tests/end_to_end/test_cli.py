import json
import os
import re
import signal
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest
from rich.console import Console

from uard import __version__
from uard.cli import app as cli
from uard.cli import terminal
from uard.lab import registry as names
from uard.lab import studies
from uard.lab.execution.store import Store
from uard.lab.result import METRICS, Result
from uard.lab.trainers.tabular import Tabular
from uard.method import mitigations as mitigation
from uard.ratings.panels import PANELS

UARD = str(Path(sys.executable).parent / "uard")
LONG = "x" * 300  # no file may have such a name
RUN = ["run", "TrapGrid", "--set", "size=5", "--set", "traps=[[2,2]]", "--episodes", "60", "--seeds", "2"]


def uard(*arguments, **options):
    return subprocess.run([UARD, *map(str, arguments)], capture_output=True, text=True, check=False, **options)


@pytest.fixture(scope="module")
def printed():
    done = uard(*RUN, "--json", "-")
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_version():
    for option in ("--version", "-V"):
        done = uard(option)
        assert (done.returncode, done.stdout, done.stderr) == (0, f"uard {__version__}\n", "")
    module = subprocess.run([sys.executable, "-m", "uard", "--version"], capture_output=True, text=True)
    assert module.stdout == f"uard {__version__}\n"


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ((), ("run", "reproduce", "ledger", "list", "doctor", "best-of-n", "leaderboard", "status", "compare")),
        (("run",), ("--set", "--set-mitigation", "--noise-fraction", "--json", "Who rates")),
        (("reproduce",), ("--report", "--store", "--workers", "--seeds")),
        (("ledger",), ("--json", "J5 F3")),
        (("reproduce",), ("--failed", "--tensorboard", "--log", "--log-level")),
        (("status",), ("--store", "--seeds", "--errors", "--json")),
        (("compare",), ("--json", "Exit code 1")),
        (("list",), ("--help",)),
    ],
)
def test_help(command, says):
    done = uard(*command, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert [s for s in says if s not in " ".join(done.stdout.split())] == []


def test_list_names_everything():
    done = uard("list")
    listed = {line.split()[0] for line in done.stdout.splitlines() if line.strip()}
    known = {*names.ENVIRONMENTS, *names.AGENTS, *mitigation.NAMED, *PANELS, *(s.name for s in studies.every())}
    assert (done.returncode, done.stderr) == (0, "")
    assert known - listed == set()


def test_run_prints_one_json_object(printed):
    answer = json.loads(printed)
    assert answer.keys() >= {"metrics", "steps_per_second", "steps", "seeds", "config", "key", "version"}
    assert answer["metrics"].keys() == set(METRICS)
    for summary in answer["metrics"].values():
        assert summary.keys() >= {"mean", "sd", "ci95", "iqm", "per_seed"}
        assert len(summary["per_seed"]) == 2
        assert summary["mean"] == pytest.approx(sum(summary["per_seed"]) / 2)
        low, high = summary["ci95"]
        assert low <= summary["mean"] <= high
    assert 0 <= answer["metrics"]["success_rate"]["mean"] <= 1
    assert answer["steps_per_second"] > 0
    assert 2 * 60 <= answer["steps"] <= 2 * 60 * 40
    assert answer["seeds"] == [0, 1]
    assert answer["version"] == __version__
    assert answer["config"]["environment"]["traps"] == [[2, 2]]
    assert (answer["config"]["environment"]["size"], answer["config"]["episodes"]) == (5, 60)


def test_the_same_command_gives_the_same_numbers(printed, tmp_path):
    done = uard(*RUN, "--json", "deep/er/out.json", "--store", "s.sqlite", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "hacks" in done.stdout
    first, again = json.loads(printed), json.loads((tmp_path / "deep/er/out.json").read_text())
    assert [again[k] for k in ("metrics", "key", "steps")] == [first[k] for k in ("metrics", "key", "steps")]
    stored = uard(*RUN, "--json", "-", "--store", "s.sqlite", cwd=tmp_path)
    third = json.loads(stored.stdout)
    assert third["metrics"] == first["metrics"]
    assert third["steps_per_second"] is None


OLD = "run --mitigation uard-0.1 --set-mitigation"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("run TrapGird", "environment = 'TrapGird': must be one of *did you mean 'TrapGrid'?"),
        ("run --agent qlearning", "agent = 'qlearning': must be one of *did you mean 'q-learning'?"),
        ("run --mitigation urad", "mitigation = 'urad': must be one of *did you mean 'uard'?"),
        (
            "run TomatoWatering",
            "agent = 'q-learning': must be one that can work in TomatoWatering, which*into tables: dqn, ensemble-dqn",
        ),
        ("run BoatRace --noise-fraction 0.3", "noise_fraction = 0.3: must be left out where no trap pays"),
        ("run --agent dqn --feedback tabel", "feedback = 'tabel': must be one of *did you mean 'table'?"),
        ("run --feedback model", "feedback = 'model': must be one of table"),
        ("run --agent dqn --set-agent batch=0", "batch = 0: must be a whole number in [1, 4096]"),
        ("reproduce grid-dep", "study = 'grid-dep': must be one of *did you mean 'grid-deep'?"),
        ("run --panel mian", "panel = 'mian': must be one of *did you mean 'main'?"),
        ("run --set sise=5", "environment setting = 'sise': must be one of *did you mean 'size'?"),
        (
            "run --mitigation uard-0.1 --set-mitigation lamda=5",
            "mitigation setting = 'lamda': must be one of *did you mean 'lam'?",
        ),
        ("run --set-agent headz=5", "agent setting = 'headz': must be one of *did you mean 'heads'?"),
        ("run --set size", "--set = 'size': must be name=value"),
        ("run --set size=5 --set size=6", "--set = 'size=6': must be left out: size was set to 5 before"),
        (
            "run --set-agent heads=1 --set-agent heads=1",
            "--set-agent = 'heads=1': must be left out: heads was set to 1",
        ),
        (f"run --set size={'9' * 5000}", "size = '99*must be a whole number in [2, 256]"),
        (f"run --set traps={'[' * 100_000}", "traps = '[[*must be a list of"),
        ("run --query doubtful", "query = 'doubtful': must be random, except on a simulator"),
        ("run --set size=-5", "size = -5: must be a whole number in [2, 256]"),
        ("run --set traps=[[0,0]]", "traps[0] = (0, 0): must be another cell than the start (0, 0)"),
        ("run --set traps=[[5,5]]", "traps[0] = (5, 5): must be another cell than the goal (5, 5)"),
        ("run --set trap_reward=NaN", "trap_reward = nan: must be a finite number"),
        (f"{OLD} lam=-1", "lam = -1.0: must be a finite number >= 0"),
        (f"{OLD} alpha=2", "alpha = 2.0: must be a finite number in [0, 1]"),
        (
            "run --mitigation uard-0.1 --set-mitigation standardise=False",
            "mitigation setting standardise = 'False': must be true or false",
        ),
        ("run --set-agent abstention=safe", "agent setting = 'abstention': must be one of abstention.rule"),
        ("run --seeds 0", "seeds = 0: must be a whole number in [1, 100000]"),
        ("run --seeds -3", "seeds = -3: must be"),
        ("run --episodes 0", "episodes = 0: must be a whole number in [1, "),
        ("run --noise -1", "noise = -1.0: must be a finite number >= 0"),
        ("run --noise nan", "noise = nan: must be a finite number >= 0"),
        ("run --noise-fraction -1", "noise_fraction = -1.0: must be"),
        ("run --noise 1 --noise-fraction 0.1", "noise = 1.0: must be left out"),
        ("run --rated 2", "rated = 2.0: must be a finite number in [0, 1]"),
        ("run --json file/out.json", "json = 'file/out.json': must be in a folder that can be written"),
        ("run --json .", "json = '.': must be a file, not a folder"),
        ("run --store file", "store = 'file': must be a result store"),
        ("run --store file/s.sqlite", "store = 'file/s.sqlite': must be in a folder that can be written"),
        ("run --store .", "store = '.': must be a file that can be written, not a folder"),
        ("run --store=", "store = '': must be a file that can be written, not a folder"),
        ("reproduce --store .", "store = '.': must be a file that can be written, not a folder"),
        ("reproduce --report=", "report = '': must be in a folder that can be written"),
        ("reproduce --report file", "report = 'file': must be in a folder that can be written"),
        ("run --tensorboard=", "tensorboard = '': must be in a folder"),
        ("run --json=", "json = '': must be a file that can be written"),
        (f"run {LONG}", "environment = 'xx*...: must be one of"),
        (f"run --store {LONG}", "store = 'xx*must be a file that can be written"),
        (f"run --json {LONG}", "json = 'xx*File name too long"),
        (f"run --log {LONG}", "log = 'xx*File name too long"),
        (f"run --tensorboard {LONG}", "tensorboard = 'xx*File name too long"),
        (f"doctor {LONG}", "log = 'xx*...: must be a file that ends in"),
        (f"doctor {LONG}.csv", "log = 'xx*File name too long"),
        (f"leaderboard --store {LONG}", "store = 'xx*...: must be a file that is there"),
        (f"leaderboard --out {LONG}", "store = 'results/uard.sqlite': must be a file that is there"),
        (f"status --store {LONG}", "store = 'xx*there is no such file"),
        (f"status {LONG}", "study = 'xx*...: must be one of"),
        (f"compare {LONG} file", "store = 'xx*there is no such file"),
        (f"migrate {LONG}", "path = '*...: must be"),
        (f"reproduce control --extract {LONG}", "extract = 'xx*File name too long"),
        (f"reproduce --report {LONG}", "report = 'xx*File name too long"),
        (f"reproduce control --mitigation {LONG}", "mitigation = 'xx*...: must be one of"),
        ("reproduce nonsense", "study = 'nonsense': must be one of abstention, "),
        ("reproduce contrl", "study = 'contrl': must be one of *did you mean 'control'?"),
        ("reproduce control --seeds 1", "seeds = 1: must be a whole number in [2, "),
        ("reproduce control --workers -1", "workers = -1: must be"),
        ("reproduce control --report out", "report = 'out': must be left out unless all grid studies are run"),
        ("reproduce --report file/out", "report = 'file/out': must be in a folder that can be written"),
        ("reproduce control --store file", "store = 'file': must be a result store"),
        ("reproduce control --failed --extract x.json", "extract = 'x.json': must be left out with --failed"),
        ("reproduce control --log file/log", "log = 'file/log': must be in a folder that can be written"),
        ("reproduce control --tensorboard file/tb", "tensorboard = 'file/tb': must be in a folder that can be written"),
        ("status --store none.sqlite", "store = 'none.sqlite': must be a result store, but there is no such file"),
        ("status --store file", "store = 'file': must be a result store"),
        ("status contrl --store file", "study = 'contrl': must be one of *did you mean 'control'?"),
        ("status --seeds 0", "seeds = 0: must be"),
        ("compare none.sqlite file", "store = 'none.sqlite': must be a result store, but there is no such file"),
        ("compare file none.sqlite", "store = 'file': must be a result store"),
        ("ledger J99", "claim = 'J99': must be one of A30, F2, "),
        ("ledger --seeds 1", "seeds = 1: must be"),
    ],
)
def test_silly_input_is_refused_in_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("this is mine, and no database\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        cli.main(arguments.split())
    out, error = capsys.readouterr()
    assert stopped.value.code == 2
    assert out == ""
    assert error.count("\n") == 1
    start, _, hint = message.partition("*")
    assert error.startswith(f"error: {start}")
    assert hint in error
    assert (tmp_path / "file").read_text() == "this is mine, and no database\n"
    assert not (tmp_path / "none.sqlite").exists()


@pytest.mark.parametrize(
    "arguments",
    ["run TrapGird", "run --set traps=[[0,0]]", "run --noise nan", "run --seeds many", "run --nope", "nonsense", ""],
)
def test_silly_input_ends_the_real_program_with_2(arguments):
    done = uard(*arguments.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("run --seeds two", "'two' must be a whole number"),
        ("run --seeds 1_0", "'1_0' must be a whole number"),
        ("reproduce control --seeds 2.5", "'2.5' must be a whole number"),
        ("run --noise much", "'much' must be a number"),
        ("run --noise-fraction much", "'much' must be a number"),
        ("run --steps many", "'many' must be a whole number"),
    ],
)
def test_what_is_no_number_is_said_in_words(arguments, says, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(arguments.split())
    assert stopped.value.code == 2
    assert says in " ".join(re.sub("[│─╭╮╰╯]", " ", capsys.readouterr().err).split())


@pytest.mark.parametrize("arguments", ["list", "run --help", "doctor CartPole-v1 --json -", "doctor CartPole-v1"])
def test_a_reader_who_has_gone_is_no_accident(arguments, tmp_path):
    """As in ``uard list | head -1``."""
    command = f"{UARD} {arguments} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


def test_a_run_that_diverges_ends_with_1(capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main([*RUN, "--set-agent", "init_scale=3e38", "--mitigation", "raw", "--json", "-"])
    out, error = capsys.readouterr()
    assert (stopped.value.code, out) == (1, "")
    assert "2 seeds failed, the rest is stored; first: Cell(" in error
    assert "training diverged: NaN or infinity" in error


def test_reproduce_trains_nothing_twice(tmp_path):
    command = ("reproduce", "control", "--seeds", "2", "--workers", "1", "--store", tmp_path / "s.sqlite")
    first, again = uard(*command, "--tensorboard", tmp_path / "tb", "--log", tmp_path / "log"), uard(*command)
    assert (first.returncode, again.returncode) == (0, 0)
    assert f"8 runs trained, 0 were in {tmp_path}/s.sqlite already" in first.stderr
    assert f"0 runs trained, 8 were in {tmp_path}/s.sqlite already" in again.stderr
    assert first.stdout == again.stdout
    assert "A random walker" in first.stdout
    assert len(list((tmp_path / "tb").glob("control_size_*/seed-[01]/events.*"))) == 8
    assert "INFO 8 of 8 seeds done" in (tmp_path / "log").read_text()


def test_what_failed_is_named_and_can_be_run_alone(tmp_path, monkeypatch, capsys):
    """The first two cells raise at first, and then no more."""
    monkeypatch.chdir(tmp_path)
    study, train, bad = studies.find(("control",))[0], Tabular.train, []
    bad += [r.cell for r in study.rows[:2]]

    def picky(self, batch, folder=None):
        if any(cell in bad for cell, _ in batch):
            raise ValueError("not [this] one")
        return train(self, batch, folder)

    monkeypatch.setattr(Tabular, "train", picky)
    command = ["reproduce", "control", "--seeds", "2", "--workers", "1", "--store", "s.sqlite"]
    for _ in range(2):
        with pytest.raises(SystemExit) as stopped:
            cli.main(command)
        out, error = capsys.readouterr()
        assert (stopped.value.code, out) == (1, "")
        assert "4 seeds failed, the rest is stored" in error
        assert "failed: control: size 6, horizon 40, seeds [0, 1]: ValueError: not [this] one" in error
        assert "only these again: uard reproduce control --seeds 2 --store s.sqlite --failed" in error
        assert "their tracebacks: uard status control --store s.sqlite --errors" in error
    cli.main(["status", "control", "--store", "s.sqlite", "--errors", "--json", "status.json"])
    out, _ = capsys.readouterr()
    assert "Traceback" in out
    assert json.loads((tmp_path / "status.json").read_text())["studies"] == [
        {"name": "control", "seeds": 2, "finished": 4, "claimed": 0, "failed": 4, "missing": 0, "last": ANY}
    ]
    bad.clear()
    cli.main([*command, "--failed"])
    out, error = capsys.readouterr()
    assert (out, "4 runs trained, 0 were in s.sqlite already" in error) == ("", True)
    cli.main(["status", "--store", "s.sqlite"])
    assert "control" in capsys.readouterr().out


def test_compare_says_whether_two_stores_agree(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cell = studies.find(("control",))[0].rows[0].cell
    for name, shift in (("a", 0.0), ("b", 0.0), ("c", 5.0)):
        with closing(Store(f"{name}.sqlite")) as store:
            rng = np.random.default_rng(0)
            logs = [rng.normal(10 + shift * (i % 2), 1, (3, 6)).astype(np.float32) for i in range(1, 17, 2)]
            store.put([(cell, s, Result(log, 30, np.zeros(2, np.int32), {})) for s, log in enumerate(logs)])
    cli.main(["compare", "a.sqlite", "b.sqlite"])
    assert "verdict: identical" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        cli.main(["compare", "a.sqlite", "c.sqlite", "--json", "c.json"])
    out, error = capsys.readouterr()
    assert (stopped.value.code, error) == (1, "")
    assert "verdict: differ" in out
    found = json.loads((tmp_path / "c.json").read_text())
    assert (found["differs"], found["identical"], found["cells"][0]["key"]) == (True, False, cell.key)


def test_json_goes_where_it_is_told_and_replaces_no_device(tmp_path):
    """The real program, for it is standard output that matters."""
    (tmp_path / "log.csv").write_text("reward,rating_a,rating_b\n" + "".join(f"{i},{i},{i + 0.1}\n" for i in range(50)))
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to("real.json")

    def doctor(target):
        done = uard("doctor", "log.csv", "--json", target, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    plain, expected = doctor("/dev/null"), json.loads(doctor("-"))
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    there = doctor("/dev/stdout")
    assert there.endswith(plain)
    assert json.loads(there.removesuffix(plain)) == expected
    doctor("link.json")
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "real.json").read_text()) == expected
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.json", "log.csv", "real.json"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a log and a store."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "log.csv").write_text("reward,rating_a,rating_b\n" + "".join(f"{i},{i},{i + 1}\n" for i in range(50)))
    store = ["--seeds", "2", "--store", str(folder / "s.sqlite")]
    cli.main(["reproduce", "control", *store, "--workers", "1", "--extract", str(folder / "extract.json")])
    return folder


@pytest.mark.parametrize(
    "command",
    [
        "doctor log.csv --json",
        "run --set size=5 --episodes 20 --seeds 1 --json",
        "best-of-n --seeds 2 --json",
        "status --store s.sqlite --json",
        "compare s.sqlite s.sqlite --json",
        "reproduce control --seeds 2 --store s.sqlite --extract",
        "leaderboard --store s.sqlite --out",
    ],
)
def test_every_output_goes_through_pipes_and_links_and_replaces_no_device(command, finished, tmp_path, monkeypatch):
    monkeypatch.chdir(finished)
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    os.mkfifo(tmp_path / "fifo")
    got = []
    reader = threading.Thread(target=lambda: got.append((tmp_path / "fifo").read_text()), daemon=True)
    reader.start()
    for name in ("fifo", "link"):
        cli.main([*command.split(), str(tmp_path / name)])
    reader.join(10)
    assert (tmp_path / "fifo").is_fifo()
    assert (tmp_path / "link").is_symlink()
    written = (tmp_path / "real").read_text()
    assert written.startswith(("{", "<!doctype html>"))
    assert len(got[0]) == pytest.approx(len(written), rel=0.1), "but for times"
    with suppress(PermissionError):  # only root may make one
        os.mknod(tmp_path / "null", 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        cli.main([*command.split(), str(tmp_path / "null")])
        assert (tmp_path / "null").is_char_device()
    assert {p.name for p in tmp_path.iterdir()} - {"null"} == {"fifo", "link", "real"}


def test_what_others_wrote_is_printed_as_it_is(capsys):
    terminal.table(["[b]a[/b]", "b"], [["x[/red]", "\x1b[31mred"], ["\r\x07", "y"]], "a [title]", marked=(1,))
    terminal.entries("t[/]", [("[name]", "\x9b0m [/text]", "")])
    terminal.warning(Console(highlight=False), "[bold]no[/bold]\x1b]0;title\x07")
    terminal.say(Console(highlight=False), "a\u202eb\udcff\u2028")
    terminal.table(["n\x1b"], [[f"{i}\r"] for i in range(600)], "many\x07")
    out = capsys.readouterr().out
    for text in ("[b]a[/b]", "x[/red]", r"\x1b[31mred", r"\r\x07", "a [title]", "t[/]", "[name]", r"\x9b0m [/text]"):
        assert text in out
    assert r"warning: [bold]no[/bold]\x1b]0;title\x07" in out
    assert r"a\u202eb\udcff\u2028" in out
    assert "many\\x07\nn\\x1b\n─────\n0\\r\n1\\r\n" in out
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]", out)


def test_an_interrupt_is_no_accident(tmp_path):
    store = tmp_path / "s.sqlite"
    command = [UARD, "reproduce", "scale", "stress", "--seeds", "2", "--workers", "2", "--store", str(store)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    process = subprocess.Popen(command, **pipes)
    deadline, finished = time.monotonic() + 60, 0
    while not finished and time.monotonic() < deadline:
        time.sleep(0.05)
        if store.exists():
            with closing(sqlite3.connect(store, timeout=10)) as db:
                ready = db.execute("select count(*) from sqlite_master where name = 'results'").fetchone()[0]
                finished = db.execute("select count(*) from results").fetchone()[0] if ready else 0
    os.killpg(process.pid, signal.SIGINT)
    out, error = process.communicate(timeout=30)
    assert (process.returncode, out) == (130, "")
    assert "interrupted; every finished cell is stored, the same command goes on from there" in error
    assert "Traceback" not in error
    with closing(sqlite3.connect(store)) as db:
        assert db.execute("pragma integrity_check").fetchone() == ("ok",)
        assert db.execute("select count(*) from results").fetchone()[0] >= finished > 0
