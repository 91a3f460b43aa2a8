"""What is printed fits 80 columns, in any encoding, with colours on terminals only."""

import contextlib
import io
import itertools
import json
import os
import pty
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from uard.cli import app as cli
from uard.cli import catalogue, commands, terminal
from uard.lab import studies
from uard.lab.execution.store import Store
from uard.lab.result import Result

UARD = str(Path(sys.executable).parent / "uard")
LONG = "a_rater_whose_name_is_so_long_that_it_fills_more_than_half_of_a_line"
WIDTH = 80


@pytest.fixture(autouse=True)
def eighty(monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))


def printed(capsys, *arguments):
    """Run a command and return its exit code and its lines on standard output."""
    code = 0
    try:
        cli.main([*map(str, arguments)])
    except SystemExit as stopped:
        code = stopped.code
    return code, capsys.readouterr().out.splitlines()


def subcommands():
    every = {name: kind for name, kind in commands.own().items()}
    every |= {plugin.name: kind for plugin, kind in commands.brought()[0].items()}
    yield ()
    for name, kind in every.items():
        yield (name,)
        for hint in get_type_hints(kind, include_extras=True).values():
            yield from ((name, below) for below in names_in(hint))


def names_in(hint):
    """Yield the names that tyro's marks give to parts of a type."""
    for part in get_args(hint):
        if type(part).__name__ == "_SubcommandConfig":
            yield part.name
        yield from names_in(part)


@pytest.mark.parametrize("command", [*subcommands()], ids=" ".join)
def test_help_fits_and_is_broken_between_words_only_where_it_must(command, capsys):
    code, lines = printed(capsys, *command, "--help")
    assert code == 0
    assert max(map(len, lines)) <= WIDTH
    bare = [re.sub("^│ | *│$", "", line) for line in lines]
    for line, after in itertools.pairwise(bare):
        word = line.strip()
        indented = len(after) - len(after.lstrip()) == len(line) - len(line.lstrip())
        if word and after.strip() and " " not in word and indented and not word.startswith(("-", "[", "{", "╭", "╰")):
            assert len(line) + len(after.split()[0]) >= WIDTH - 4, f"broken after a word: {line!r} {after!r}"


def test_every_subcommand_is_tried():
    assert {("collect", "serve"), ("collect", "status"), ("run",), ("ledger",)} <= {*subcommands()}


def test_list_is_one_line_an_entry(capsys):
    code, lines = printed(capsys, "list")
    assert code == 0
    assert max(map(len, lines)) <= WIDTH
    every = [entry for entries in catalogue.catalogue().values() for entry in entries]
    shown = [line.split()[0] for line in lines if line.startswith("  ")]
    assert sorted(shown) == sorted(entry.name for entry in every)
    assert all(len(line.split()) > 1 for line in lines if line.startswith("  ")), "each is described"


@pytest.mark.parametrize("name", ["mitigations", "grid", "environments", "studies"])
def test_list_of_a_kind_is_a_part_of_the_whole(name, capsys):
    _, whole = printed(capsys, "list")
    code, part = printed(capsys, "list", name)
    assert (code, {*part} - {*whole}) == (0, set())
    assert 0 < len(part) < len(whole)


def details_of(capsys, name):
    code, lines = printed(capsys, "list", name)
    assert code == 0
    assert max(map(len, lines)) <= WIDTH
    return " ".join(" ".join(lines).split())


def test_details(capsys):
    grid = details_of(capsys, "TrapGrid8-Trap8")
    assert "trap_reward 8.0 What a trap seems to pay" in grid
    assert "try it: uard run TrapGrid8-Trap8 --set FIELD=VALUE" in grid
    assert "uard.method.mitigations.pooled.PooledDiscounting" in details_of(capsys, "uard")
    assert details_of(capsys, "ppo").count("ppo: agent") == 2  # a name of two kinds
    assert "--agent ppo" in details_of(capsys, "Hopper")  # tables cannot work there
    assert "rater 2: noise 0.1" in details_of(capsys, "main")
    assert "rater 1: " in details_of(capsys, "random:3")
    scale = details_of(capsys, "scale")
    assert "30 cells x 10 seeds = 300 runs" in scale, "36 rows, of which some are one cell"
    assert "run it: uard reproduce scale --seeds 10" in scale
    both = details_of(capsys, "panels")
    assert "panels (5)" in both
    assert "panels: study" in both


def test_what_is_listed_can_be_run(capsys):
    """The command that the details name is understood."""
    for name in ("TrapGrid", "dqn", "lcb", "main"):
        (command,) = re.findall(r"try it: uard (run[^=]*?)(?: --set\S* FIELD=VALUE)? *$", details_of(capsys, name))
        options = ["--episodes", "5", "--seeds", "1", "--json", "-"]
        code, lines = printed(capsys, *command.split(), *options)
        assert (code, "metrics" in json.loads("\n".join(lines))) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("list nothing", "name = 'nothing': must be one of those that `uard list` shows: environments"),
        ("list trapgrid8", "did you mean 'TrapGrid8'"),
        ("list mitigation", "did you mean 'mitigations'?"),
        ("list random:x", "random:x"),
        ("list ''", "name = ''"),
        ("list --json .", "json = '.': must be a file, not a folder"),
        (f"list {LONG * 5}", "name = 'a_rater"),
    ],
)
def test_silly_names_are_refused(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        cli.main([x.strip("'") for x in arguments.split()])
    out, error = capsys.readouterr()
    assert (stopped.value.code, out, error.count("\n")) == (2, "", 1)
    assert says in error


def test_list_as_json(capsys, tmp_path):
    _, lines = printed(capsys, "list", "TrapGrid6", "--json", "-")
    (entry,) = json.loads("\n".join(lines))["entries"]
    assert (entry["kind"], entry["fields"][0]["name"], entry["fields"][0]["value"]) == ("environment", "size", "6")
    printed(capsys, "list", "--json", tmp_path / "all.json")
    assert len(json.loads((tmp_path / "all.json").read_text())["kinds"]["mitigations"]) >= 25


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of ratings, preferences and scores with long names, and two stores, one of them damaged."""
    here = tmp_path_factory.mktemp("files")
    rng = np.random.default_rng(0)
    raters = ("ann", LONG, "cat", "dan")
    reward = rng.normal(size=60)
    head = ",".join(["reward", "part", *(f"rating_{r}" for r in raters)])
    rows = [f"{x},{'ab'[i % 2]}," + ",".join(f"{x + e:.3f}" for e in rng.normal(size=4)) for i, x in enumerate(reward)]
    (here / "log.csv").write_text("\n".join([head, *rows]) + "\n")
    pairs = [f"x{i},y{i},{'left' if i % 3 else 'right'},{r}" for i in range(20) for r in raters[:2]]
    (here / "pairs.csv").write_text("\n".join(["left,right,choice,annotator", *pairs]) + "\n")
    scores = [f"p{i // 4}," + ",".join(f"{i % 4 + e:.2f}" for e in rng.normal(size=3)) for i in range(120)]
    (here / "scores.csv").write_text("\n".join([f"prompt,tone,{LONG},clarity", *scores]) + "\n")
    cells = [row.cell for row in studies.find(("scale",))[0].rows[:8]]
    for name, shift in (("a", 0.0), ("b", 3.0)):
        with closing(Store(here / f"{name}.sqlite")) as store:
            jobs = [(c, s, rng.normal(9 + shift * k, 1, (3, 6))) for k, c in enumerate(cells) for s in range(8)]
            store.put([(c, s, Result(x.astype(np.float32), 30, np.zeros(2, np.int32), {})) for c, s, x in jobs])
    with closing(Store(here / "b.sqlite")) as store:
        store._db.execute("update results set data = x'00' where seed = 3")
        store._db.commit()
    return here


COMMANDS = [
    "doctor log.csv",
    "doctor log.csv --by part",
    "raters log.csv --by part",
    "preferences pairs.csv",
    "judges fit scores.csv --judges tone LONG clarity --prompt prompt",
    "leaderboard --store a.sqlite --out page.html",
    "leaderboard --store b.sqlite --out page.html",
    "status --store a.sqlite",
    "status --store b.sqlite",
    "compare a.sqlite b.sqlite",
    "run --set size=5 --episodes 20 --seeds 3",
    "list uard",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_fit(command, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    code, lines = printed(capsys, *command.replace("LONG", LONG).split())
    assert code in (0, 1)
    assert lines
    assert [line for line in lines if len(line) > WIDTH] == []
    if "log.csv" in command or "scores.csv" in command:
        assert any(LONG in line for line in lines), "a name is never broken"
    monkeypatch.setenv("COLUMNS", "200")
    _, more = printed(capsys, *command.replace("LONG", LONG).split())
    assert len(more) <= len(lines)


def test_leaderboard_ranks_here_too(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    _, lines = printed(capsys, "leaderboard", "--store", "a.sqlite", "--out", "page.html")
    ranked = [line.split()[0] for line in lines if re.search(r" \d+/\d+ ", line)]
    assert {"uard", "uard-0.1"} & {*ranked}


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
@pytest.mark.parametrize("command", ["list", "doctor log.csv", "raters log.csv", "--help", "run --help"])
def test_any_encoding_will_do(command, encoding, folder):
    environment = os.environ | {"PYTHONIOENCODING": encoding, "LANG": "C", "LC_ALL": "C"}
    done = subprocess.run([UARD, *command.split()], cwd=folder, env=environment, capture_output=True, check=False)
    assert b"Traceback" not in done.stderr
    assert done.returncode in (0, 1)
    assert done.stdout.decode(encoding)


def in_a_terminal(*arguments, **environment):
    """Run the program in a terminal of its own and return what it wrote there."""
    ours, theirs = pty.openpty()
    settings = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"TERM": "xterm-256color"} | environment
    process = subprocess.Popen([UARD, *arguments], stdout=theirs, stderr=theirs, stdin=theirs, env=settings)
    os.close(theirs)
    out = io.BytesIO()
    with contextlib.suppress(OSError):  # of a terminal that is closed
        while data := os.read(ours, 4096):
            out.write(data)
    process.wait()
    os.close(ours)
    return out.getvalue().decode()


COLOUR = re.compile("\x1b\\[[0-9;]*3[0-7]")


def test_colours_are_for_terminals_and_for_whoever_wants_them():
    assert COLOUR.search(in_a_terminal("list", "nothing"))
    assert not COLOUR.search(in_a_terminal("list", "nothing", NO_COLOR="1"))
    assert not COLOUR.search(in_a_terminal("run", "--help", NO_COLOR="1"))
    done = subprocess.run([UARD, "list", "panels"], capture_output=True, text=True, check=True)
    assert "\x1b" not in done.stdout


def test_long_messages_are_broken_between_words_in_a_terminal():
    shown = in_a_terminal("list", "trapgrid8")
    lines = re.sub("\x1b\\[[0-9;?]*[a-z]", "", shown).split("\r\n")
    assert max(map(len, lines)) <= WIDTH
    assert len(lines) > 2


@pytest.mark.parametrize("columns", ["0", "5", "nonsense"])
@pytest.mark.parametrize("command", ["--help", "list uard", "run NoSuchTask"])
def test_a_terminal_without_room_is_printed_to_as_well(command, columns):
    environment = os.environ | {"COLUMNS": columns}
    done = subprocess.run([UARD, *command.split()], capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode in (0, 2)
    assert "uard" in done.stdout or "NoSuchTask" in done.stderr


@pytest.mark.parametrize("arguments", ["--help >&-", "list >&-", "list nonsense 2>&-", "list >&- 2>&-"])
def test_a_closed_output_is_no_error(arguments):
    done = subprocess.run(f"{UARD} {arguments}", shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == (2 if "nonsense" in arguments else 0)
    assert "Traceback" not in done.stderr


def test_entries_whose_name_is_too_long_are_whole(capsys):
    terminal.entries("title", [(LONG * 2, "text", ""), ("b", "what b is " * 20, "(of a package 1.0)")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].strip() == LONG * 2
    assert lines[2].endswith("(of a package 1.0)")
    assert len(lines[2]) <= WIDTH
