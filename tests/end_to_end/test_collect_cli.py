"""``uard collect``: from an environment or a file to a project, and to a table."""

import csv
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from uard.cli import app as cli
from uard.cli.projects import round_up
from uard.collect import Project, Request, sheets
from uard.ratings.table import Answer


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    """Run a command in an empty folder, and return its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def running(*arguments):
        try:
            cli.main(["collect", *map(str, arguments)])
            code = 0
        except SystemExit as stopped:
            code = stopped.code
        out, err = capsys.readouterr()
        return code, out, " ".join(err.split())

    return running


def items_of(folder):
    with Project.open(folder).store() as store:
        return store.items()[0]


def test_a_grid_is_recorded_rated_and_exported(run, tmp_path):
    code, _, err = run("record", "TrapGrid", "grid", "--segments", 12, "--length", 1)
    assert code == 0
    assert "12 clips (random), 24 frames, observed reward per step" in err
    assert "raters are asked: How much reward does this deserve? (slider from -" in err
    assert err.endswith("next: uard collect serve grid --raters ann,bob")
    items = items_of("grid")
    assert {i.stratum for i in items} == {"random"}
    assert all(len(i.content["key"]) == 2 for i in items)

    code, out, err = run("invite", "grid", "ann", "--url", "https://rate.example.org/")
    assert code == 0
    assert out.startswith("https://rate.example.org/enter/")
    with Project.open("grid").store() as store:
        store.invite("bob")
        store.put([Answer("a1", items[0].id, "ann", 0.5, scale="slider -4..4", given_at=3.0)])
        store.put([Answer("a2", items[0].id, "bob", choice="skip")])
    code, out, err = run("status", "grid")
    assert code == 0
    assert "12 items, 1 of them rated, 0 by as many as wanted" in out
    assert err.endswith("next: uard collect serve grid")
    code, out, _ = run("status", "grid", "--json", "-")
    told = json.loads(out)
    assert (told["items"], told["wanted"], told["open_requests"]) == (12, 36, 0)
    assert [(r["name"], r["answers"], r["skipped"], r["entered"]) for r in told["raters"]] == [
        ("ann", 1, 0, False),
        ("bob", 1, 1, False),
    ]

    code, _, err = run("export", "grid", "said.csv")
    assert code == 0
    assert "2 answers in said.csv. Next: uard raters said.csv" in err
    with open("said.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert (rows[0]["item"], rows[0]["rater"], float(rows[0]["rating"])) == (items[0].id, "ann", 0.5)
    assert run("export", "grid", "said.json")[0] == 0
    assert json.loads((tmp_path / "said.json").read_text())
    assert run("export", "grid", "all.txt", "--form", "record")[0] == 0


def test_a_project_keeps_its_question(run):
    assert run("record", "TrapGrid6", "grid", "--segments", 4, "--kind", "stars", "--stars", 3, "--high", 2)[0] == 0
    question = Project.open("grid").question
    assert (question.kind, question.stars, question.high) == ("stars", 3, 2.0)
    code, _, err = run("record", "TrapGrid6", "grid", "--kind", "thumbs")
    assert code == 2
    assert "--kind = 'thumbs': must be left out: it stands in grid/project.toml" in err
    assert run("record", "TrapGrid6", "grid", "--segments", 3, "--stratum", "again", "--seed", 5)[0] == 0
    assert {i.stratum for i in items_of("grid")} == {"random", "again"}


def test_pairs(run):
    code, _, err = run("record", "TrapGrid6", "grid", "--segments", 6, "--length", 4, "--kind", "pairs", "--pairs", 5)
    assert code == 0
    assert "Which of the two is better? (pairs)" in err
    assert "5 pairs" in err
    assert [i.kind for i in items_of("grid")].count("pair") == 5
    assert Project.open("grid").question.kind == "pairs"


def test_the_agent_of_a_finished_run_acts(run, capsys):
    for mitigation in ("raw", "true-reward"):
        cli.main(
            ["run", "TrapGrid6", "--seeds", "1", "--episodes", "200", "--mitigation", mitigation, "--store", "runs.db"]
        )
    capsys.readouterr()
    code, _, err = run("record", "TrapGrid6", "grid", "--policy", "uard:runs.db")
    assert code == 2
    assert "must be uard:STORE@CELL, with the beginning of one cell's key: @" in err
    assert not os.path.exists("grid")
    key = next(part for part in err.split("@")[1:] if "TrueReward" in part)[:8]
    code, _, err = run("record", "TrapGrid6", "grid", "--policy", f"uard:runs.db@{key}", "--segments", 4)
    assert code == 0
    assert "seed 0), " in err
    project = Project.open("grid")
    longest = max(items_of("grid"), key=lambda item: item.content["frames"])
    with np.load(project.media(longest.content["data"])) as found:
        assert found["rewards"][-1] == 10.0  # it goes to the goal
        assert (found["rewards"][:-1] < 0).all()  # past the traps
    for policy, message in (
        (f"uard:runs.db@{key}:7", "with a seed that is finished: [0]"),
        (f"uard:runs.db@{key}:x", "with a seed that is a number"),
        ("uard:none.db", "must be a result store that is there"),
    ):
        code, _, err = run("record", "TrapGrid6", "grid", "--policy", policy)
        assert code == 2
        assert message in err
    code, _, err = run("record", "TrapGrid8", "grid", "--policy", "uard:runs.db")
    assert code == 2
    assert "a store with a finished run in this environment" in err


@pytest.mark.parametrize("name", ["PPO", "A2C", "DQN"])
def test_an_agent_of_stable_baselines3_acts(run, name):
    sb3 = pytest.importorskip("stable_baselines3")
    import gymnasium

    import uard.envs

    assert uard.envs
    env = gymnasium.make("uard/TrapGrid6-v0")
    small = {"buffer_size": 10} if name == "DQN" else {}
    getattr(sb3, name)("MlpPolicy", env, device="cpu", **small).save("agent.zip")
    code, _, err = run("record", "TrapGrid6", "grid", "--policy", "sb3:agent.zip", "--segments", 3, "--length", 4)
    assert code == 0
    assert f"({name} agent)" in err
    code, _, err = run("record", "TrapGrid8", "grid", "--policy", "sb3:agent.zip")
    assert code == 2
    assert "observation_space of agent.zip = Discrete(36): must be Discrete(64), as the environment's" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("BoatRace",), "environment = 'BoatRace': must be one that draws pictures"),
        (("Trapgrid8",), "did you mean 'TrapGrid8'?"),
        (("Nope-v3",), "must be the id of a Gymnasium environment"),
        (("no_such_module:Nope-v3",), "must be one that can be made here"),
        (("TrapGrid", "--set", "sise=3"), "keyword of TrapGrid = 'sise': must be one of"),
        (("TrapGrid", "--policy", "clever"), "--policy = 'clever': must be random, sb3:FILE or uard:STORE"),
        (("TrapGrid", "--policy", "sb3:none.zip"), "must be a file that can be read (No such file"),
        (("TrapGrid", "--policy", "sb3:text.zip"), "must be a zip file that Stable-Baselines3's save() has written"),
        (("TrapGrid", "--segments", "0"), "segments = 0: must be a whole number"),
        (("TrapGrid", "--length", "5000"), "length = 5000: must be a whole number in [1, 1023]"),
        (("TrapGrid", "--low", "3", "--high", "2"), "--high = 2.0: must be more than --low, 3"),
        (("TrapGrid", "--stars", "1"), "stars = 1: must be a whole number in [2, 10]"),
        (("TrapGrid", "--fps", "0"), "fps = 0.0: must be a finite number in (0, 1000]"),
    ],
)
def test_bad_input_leaves_nothing_behind(run, tmp_path, arguments, message):
    (tmp_path / "text.zip").write_text("no zip")
    code, _, err = run("record", arguments[0], "grid", *arguments[1:])
    assert code == 2
    assert message in err
    assert not (tmp_path / "grid").exists()


def test_texts(run, tmp_path):
    rows = [{"prompt": f"{i} + 1?", "chosen": str(i + 1), "rejected": "<b>no</b>"} for i in range(3)]
    (tmp_path / "answers.jsonl").write_text("\n".join(map(json.dumps, rows)))
    code, _, err = run("texts", "answers.jsonl", "sums")
    assert code == 0
    assert "6 completions of 3 prompts" in err
    assert "3 pairs next: uard collect serve sums --raters ann,bob" in err
    code, _, err = run("texts", "answers.jsonl", "stars", "--kind", "stars")
    assert "How good is this answer? (stars from 1 to 5)" in err
    (tmp_path / "bad.jsonl").write_text('{"prompt": "a", "completion": 3}')
    code, _, err = run("texts", "bad.jsonl", "none")
    assert code == 2
    assert "bad.jsonl: row 1, column 'completion' = 3" in err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("command", ["status", "invite", "export", "serve"])
def test_a_project_that_is_none(run, command):
    more = {"invite": ("ann",), "export": ("a.csv",)}.get(command, ())
    code, _, err = run(command, "nowhere", *more)
    assert code == 2
    assert "project = 'nowhere': must be a folder that `uard collect record` or `uard collect texts` has made" in err


def test_what_changed_after_it_was_recorded_is_told(run):
    run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)
    project, (one, other) = Project.open("grid"), items_of("grid")
    project.media(one.content["sheet"]).write_bytes(b"another picture")
    project.media(other.content["data"]).unlink()
    code, _, err = run("status", "grid")
    assert code == 0
    assert f"item {one.id} is not shown: " in err
    assert "was changed after it was recorded" in err
    assert "is missing" in err


def test_an_export_must_have_a_form_and_destroys_nothing(run):
    run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)
    code, _, err = run("export", "grid", "said.txt")
    assert code == 2
    assert "or --form says what it holds" in err
    (sheet,) = [p for p in os.listdir("grid/media") if p.endswith(".webp")][:1]
    for own in ("answers.sqlite", "project.toml", f"media/{sheet}", "media/new.csv", "serving.lock"):
        for command in (
            ("export", "grid", f"grid/{own}", "--form", "csv"),
            ("status", "grid", "--json", f"grid/{own}"),
            ("items", "grid", "--json", f"grid/{own}"),
            ("simulate", "grid", "--json", f"grid/{own}"),
        ):
            code, _, err = run(*command)
            assert code == 2
            assert "must be another file than those of the project grid" in err
    os.link(f"grid/media/{sheet}", "clip.csv")
    os.symlink("grid", "link")
    os.symlink("grid/project.toml", "question.csv")
    for name in ("clip.csv", "link/project.toml", "question.csv", "grid/media/../answers.sqlite"):
        code, _, err = run("status", "grid", "--json", name)
        assert (code, "must be another file than those of the project grid" in err) == (2, True)
    assert run("export", "grid", "grid/said.csv")[0] == run("export", "grid", "grid/said.csv")[0] == 0  # not ours
    os.link("grid/answers.sqlite", "other.csv")
    code, _, err = run("export", "grid", "other.csv")
    assert code == 2
    assert "which it would destroy" in err
    assert len(items_of("grid")) == 2


def test_pairs_that_cannot_be_drawn_make_no_project(run, tmp_path):
    for option, value in (("--pairs", 0), ("--seed", -1)):
        code, _, err = run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1, option, value)
        assert code == 2
        assert f"{option} = {value}" in err
        assert not (tmp_path / "grid").exists()


def test_a_link_is_to_a_page(run):
    assert "already" not in run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)[2]
    again = run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)[2]
    assert "all of them were in the project already: another --seed makes others" in again
    code, _, err = run("invite", "grid", "ann", "--url", "javascript:alert(1)")
    assert code == 2
    assert "url = 'javascript:alert(1)': must be an address such as" in err
    assert "ann, a new rater" in run("invite", "grid", "ann")[2]
    assert "a new rater" not in run("invite", "grid", "ann")[2]


def test_an_item_that_is_not_there_is_named(run, tmp_path):
    run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)
    with (tmp_path / "grid" / "project.toml").open("a") as file:
        file.write('[[gold]]\nitem = "3f9a"\nvalue = 0.0\n')
    code, _, err = run("status", "grid")
    assert code == 0
    assert "[[gold]] names an item that is not in the project: 3f9a" in err
    code, _, err = run("serve", "grid", "--port", 70_000)
    assert code == 2
    assert "[[gold]] names an item that is not in the project: 3f9a" in err


def test_an_address_that_is_none_invites_nobody(run):
    run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)
    code, _, err = run("simulate", "grid", "--url", "x")
    assert code == 2
    assert "url = 'x': must be an address such as" in err
    with Project.open("grid").store() as store:
        assert store.raters() == ()


def test_a_store_of_another_version_is_left_alone(run, tmp_path):
    import sqlite3

    run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)
    with sqlite3.connect(tmp_path / "grid" / "answers.sqlite") as db:
        db.execute("PRAGMA user_version = 99")
    code, _, err = run("status", "grid")
    assert code == 2
    assert "made by a newer uard" in err


def test_without_the_extra_it_is_said_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    code, _, _ = run("record", "TrapGrid", "grid", "--segments", 2)
    assert "pip install 'uard[collect]'" in code


@pytest.mark.parametrize(
    ("value", "rounded"), [(2.13, 2.5), (0.1, 0.1), (1.0, 1.0), (0.0, 1.0), (9.2e-7, 1e-6), (87, 100.0), (6.0, 6.0)]
)
def test_ranges_are_easy_to_read(value, rounded):
    assert round_up(value) == rounded


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the library is chosen on Linux only")
def test_hopper_is_recorded_without_a_screen(tmp_path):
    """In a process of its own, for what draws is chosen once."""
    pytest.importorskip("mujoco")
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-m", "uard", "collect", "record", "Hopper-v5", "hopper", "--segments", "6"]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    if "EGL or OSMesa" in ended.stderr:
        pytest.skip("neither EGL nor OSMesa is installed, and the message says so")
    assert ended.returncode == 0, ended.stderr
    assert "6 clips (random)" in ended.stderr
    project = Project.open(tmp_path / "hopper")
    with project.store() as store:
        content = max((item.content for item in store.items()[0]), key=lambda c: c["frames"])
    size = content["width"], content["height"]
    data = project.media(content["sheet"]).read_bytes()
    frames = sheets.frames_of(data, content["frames"], content["columns"], size)
    assert size == (256, 256)
    assert len(np.unique(frames[0].reshape(-1, 3), axis=0)) > 50  # something is to be seen
    assert (frames[0] != frames[-1]).any()


def answered(folder, rater, value=1.0, **more):
    """Answer all that a rater is asked."""
    from uard.collect.asking import top_up

    project = Project.open(folder)
    with project.store() as store:
        if rater not in {r.name for r in store.raters()}:
            store.invite(rater)
        while top_up(project, store, rater, 5):
            for lease in store.lease(rater, 99):
                sides = {side: lease.item.content[side] for side in ("left", "right") if lease.item.kind == "pair"}
                said = {"kind": lease.kind, "given_at": 2.0} | sides | more
                name = f"{rater}-{lease.id}"
                store.put([Answer(name, lease.item.id, rater, None if more else value, **said)], lease.id)


def edited(folder, **fields):
    path = os.path.join(folder, "project.toml")
    with open(path) as file:
        lines = file.read().split("\n")
    changed = [f"{n} = {fields[n]}" if (n := line.split(" = ")[0]) in fields else line for line in lines]
    with open(path, "w") as file:
        file.write("\n".join(changed))


def test_the_next_step_is_the_export_when_all_that_was_asked_is_answered(run, tmp_path):
    run("record", "TrapGrid6", "grid", "--segments", 9, "--length", 1)
    items = [item.id for item in items_of("grid")]
    edited("grid", overlap=2, repeats=0.5)
    with open("grid/project.toml", "a") as file:
        for name, table in zip(items, ("practice", "gold", "example"), strict=False):
            file.write(f'\n[[{table}]]\nitem = "{name}"\nvalue = 0.0\n')
    answered("grid", "ann")
    code, out, err = run("status", "grid")
    assert "6 items, 6 of them rated, 0 by as many as wanted" in out
    assert "6 of 12 answers that are wanted; 0 questions given out" in out
    assert err.endswith("next: uard collect serve grid --raters NAMES, for 1 more rater")
    answered("grid", "bob", choice="skip")
    code, out, err = run("status", "grid")
    assert code == 0
    assert "6 items, 6 of them rated, 6 by as many as wanted" in out
    assert "12 of 12 answers that are wanted; 0 questions given out" in out
    assert err.endswith("next: uard collect export grid answers.csv")
    with Project.open("grid").store() as store:
        store.ask([Request(items[5], "ann", "repeat")])
    assert run("status", "grid")[2].endswith("next: uard collect serve grid")


@pytest.mark.parametrize(
    ("kind", "said", "reads"),
    [
        ("slider", {}, "raters"),
        ("stars", {}, "raters"),
        ("thumbs", {"choice": "up"}, "raters"),
        ("pairs", {"choice": "left"}, "preferences"),
        ("slider", {"choice": "skip"}, None),
        ("pairs", {"choice": "cannot tell"}, None),
    ],
)
def test_what_reads_an_export_is_named(run, kind, said, reads):
    run("record", "TrapGrid6", "grid", "--segments", 4, "--length", 1, "--kind", kind, "--high", 2.0, "--low", -2.0)
    for rater in ("ann", "bob"):
        answered("grid", rater, 2.0, **said)
    _, _, err = run("export", "grid", "said.csv")
    assert (f". Next: uard {reads} said.csv" if reads else "answers in said.csv") in err
    if reads is None:
        assert "Next" not in err
        return
    cli.main([reads, "said.csv"])


def test_texts_that_cannot_be_paired_make_no_project(run, tmp_path):
    path = tmp_path / "t.jsonl"
    path.write_text('{"prompt": "a", "completion": "b"}\n{"prompt": "c", "completion": "d"}\n')
    code, _, err = run("texts", "t.jsonl", "talk", "--kind", "pairs")
    assert code == 2
    assert "--kind = 'pairs': must be another one: t.jsonl has no two completions of one prompt" in err
    assert not (tmp_path / "talk").exists()
    code, _, err = run("record", "TrapGrid6", "grid", "--kind", "pairs", "--segments", 1)
    assert code == 2
    assert "--segments = 1: must be a whole number >= 2" in err
    assert not (tmp_path / "grid").exists()
    path.write_text('{"prompt": "a", "completion": "b"}\n{"prompt": "a", "completion": "d"}\n')
    assert "1 pair" in run("texts", "t.jsonl", "talk", "--kind", "pairs")[2]
    path.write_text('{"prompt": "a", "completion": "new"}\n')
    code, _, err = run("texts", "t.jsonl", "talk")
    assert code == 0
    assert "0 pairs: they are made when raters ask for more" in err


def test_a_stratum_that_cannot_be_shown_is_named_by_its_row(run, tmp_path):
    for name in ("\ud800", "a\nb", "m" * 1_000_000):
        rows = [{"prompt": "a", "completion": "b", "model": m} for m in ("fine", name)]
        (tmp_path / "t.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
        code, _, err = run("texts", "t.jsonl", "talk")
        assert code == 2
        assert "row 2, column model" in err.replace("'", "")
        assert "at most 200 printable characters" in err
        assert not (tmp_path / "talk").exists()


def test_an_archive_has_a_state_and_an_export(run, tmp_path, monkeypatch):
    run("record", "TrapGrid6", "grid", "--segments", 2, "--length", 1)
    answered("grid", "ann")
    monkeypatch.setattr("uard.collect.schema.is_read_only", lambda path: True)
    assert "2 items, 2 of them rated" in run("status", "grid")[1]
    assert "2 answers in said.csv" in run("export", "grid", "said.csv")[2]
    code, _, err = run("invite", "grid", "bob")
    assert code == 2
    assert "Copy the project's whole folder to where it can be written" in err
