import json
import subprocess
import sys
from pathlib import Path

import pytest

from uard import __version__
from uard.cli import app as cli

UARD = str(Path(sys.executable).parent / "uard")
HONEST = "reward,rating_ann,rating_bob\n" + "".join(f"{i / 50},{i / 50 + 0.001},{i / 50 - 0.001}\n" for i in range(50))
LIE = "reward,rating_ann,rating_bob\n" + "0,0.1,-0.1\n" * 45 + "4,-0.1,0.1\n" * 5


def doctor(capsys, *arguments):
    """Run the command and return its exit code and what it printed."""
    try:
        cli.main(["doctor", *map(str, arguments)])
        code = 0
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


@pytest.fixture
def log(tmp_path):
    def write(text, name="log.csv"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_the_real_program(log):
    command = [UARD, "doctor", str(log(LIE)), "--mitigation", "uard-operator"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.splitlines()[-1] == "findings: 1 danger"


def test_exit_codes(log, capsys):
    honest, lie, alone = log(HONEST, "honest.csv"), log(LIE), log("reward,rating\n" + "0,0.1\n0,-0.1\n" * 20, "one.csv")
    assert doctor(capsys, honest, "--strict", "--mitigation", "uard-operator")[0] == 0
    assert doctor(capsys, lie)[0] == 0  # uard avoids it: a note
    assert doctor(capsys, lie, "--strict")[0] == 0
    assert doctor(capsys, lie, "--mitigation", "uard-operator")[0] == 1
    assert doctor(capsys, lie, "--mitigation", "uard-0.1", "--set-mitigation", "proxy_is_rater=false")[0] == 1
    assert doctor(capsys, alone)[0] == 0  # one rater: a warning
    assert doctor(capsys, alone, "--strict")[0] == 1


def test_json(log, capsys, tmp_path):
    code, out, _ = doctor(capsys, log(LIE), "--mitigation", "uard-operator", "--json", "-")
    answer = json.loads(out)
    assert code == 1
    assert answer["version"] == __version__
    assert (answer["rows"], answer["raters"], answer["mitigation"]) == (
        50,
        ["rating_ann", "rating_bob"],
        "uard-operator",
    )
    (found,) = answer["findings"]
    assert found.keys() == {"code", "severity", "evidence", "consequence", "remedy", "numbers", "how"}
    assert (found["code"], found["numbers"]["rows"]) == ("reward-contradicted", 5)
    code, out, _ = doctor(capsys, log(LIE), "--json", tmp_path / "deep" / "out.json")
    assert "reward-contradicted" in out
    assert json.loads((tmp_path / "deep" / "out.json").read_text())["findings"][0]["severity"] == "note"


def test_json_of_a_log_with_nothing_in_it(log, capsys):
    """What is not defined is null: NaN is no JSON."""
    code, out, _ = doctor(capsys, log("reward,rating_1\nnan,1\n1,inf\n"), "--json", "-")
    answer = json.loads(out, parse_constant=lambda name: pytest.fail(name))
    assert (code, answer["agreement"], answer["calibration"]) == (1, None, None)
    assert [f["code"] for f in answer["findings"]] == ["not-finite", "no-ratings"]


@pytest.mark.parametrize(("panel", "code"), [("main", 0), ("colluding", 1)])
def test_environments(capsys, panel, code):
    got, out, _ = doctor(capsys, "uard/TrapGrid6-v0", "--set", f"panel={panel}", "--steps", 400)
    assert got == code
    assert ("colluding-raters" in out) == (panel == "colluding")
    assert "uard/TrapGrid6-v0, 400 random steps, seed 0: 400 rows, 3 raters" in " ".join(out.split())


def test_columns(log, capsys):
    path = log(LIE.replace("reward", "score").replace("rating_ann", "ann"))
    code, out, _ = doctor(capsys, path, "--reward", "score", "--ratings", "ann", "rating_bob")
    assert code == 0
    assert "2 raters (ann, rating_bob)" in " ".join(out.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("nope.csv", "log = 'nope.csv': must be a file that can be read (No such file or directory)"),
        ("log.csv --reward rewrd", "log.csv: column = 'rewrd': must be one of rating_ann, rating_bob, reward (did you"),
        ("log.csv --ratings ann", "log.csv: column = 'ann': must be one of rating_ann, rating_bob, reward"),
        ("log.csv --mitigation raw", "mitigation = 'raw': must be a form of the filter"),
        ("log.csv --mitigation urad", "mitigation = 'urad': must be one of "),
        ("log.csv --set-mitigation kapa=1", "mitigation setting = 'kapa': must be one of "),
        ("log.csv --set-mitigation risk=-1", "risk = -1.0: must be"),
        ("log.csv --json .", "json = '.': must be a file, not a folder"),
        ("empty.csv", "log = 'empty.csv': must be a CSV file whose first line names its columns"),
        ("nothing", "log = 'nothing': must be a file that ends in .csv"),
        ("uard/TrapGird6-v0", "log = 'uard/TrapGird6-v0': must be a file that ends in .csv"),
        ("module:os", "log = 'module:os': must be a file that ends in .csv"),
        (":", "log = ':': must be a file that ends in .csv"),
        ("uard/TrapGrid6-v0 --set pannel=main", "keyword of TrapGrid6 = 'pannel': must be one of goal, "),
        ("CartPole-v1 --set panel=main", "keyword of CartPole-v1 = 'panel': must be one of render_mode, "),
        (
            "uard/TrapGrid6-v0 --set size=5 --set size=6",
            "--set = 'size=6': must be left out: size was set to 5 before",
        ),
        ("uard/TrapGrid6-v0 --by item", "--by = 'item': must be left out: it is for a file"),
        ("uard/TrapGrid6-v0 --reward score", "--reward = 'score': must be left out: it is for a file"),
        ("log.csv --set a=b", "--set = ('a=b',): must be left out: it is for an environment, and log.csv is none"),
        ("log.csv --steps 5", "--steps = 5: must be left out: it is for an environment"),
        ("log.csv --seed 0", "--seed = 0: must be left out: it is for an environment"),
        ("log.csv --by nope", "log.csv: column = 'nope': must be one of rating_ann, rating_bob, reward"),
        ("uard/TrapGrid6-v0 --set panel=mian", "panel = 'mian': must be one of"),
        ("uard/TrapGrid6-v0 --steps 0", "steps = 0: must be a whole number in [1, 1e+07]"),
        ("uard/TrapGrid6-v0 --seed -1", "seed = -1: must be a whole number >= 0"),
    ],
)
def test_bad_input(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(LIE)
    Path("empty.csv").write_text("")
    code, out, error = doctor(capsys, *arguments.split())
    assert (code, out) == (2, "")
    assert error.startswith(f"error: {message}")
    assert error.count("\n") == 1


def test_agreement_within_parts(log, capsys):
    text = "reward,rating_ann,rating_bob,system\n" + "0,0.1,-0.1,a\n1,1.1,0.9,a\n5,4.8,5.2,b\n5,5.2,4.8,b\n" * 10
    code, out, _ = doctor(capsys, log(text), "--by", "system", "--json", "-")
    answer = json.loads(out)
    a, b = answer["strata"]
    assert (code, a["name"], a["rows"], b["name"]) == (0, "a", 20, "b")
    assert a["agreement"] > 0.9
    assert b["agreement"] < 0
    assert a["low"] <= a["agreement"] <= a["high"]
    assert len(answer["agreement_interval"]) == 2
    _, out, _ = doctor(capsys, log(text), "--by", "system")
    assert "            within a: 0." in out


@pytest.mark.parametrize("size", ["1e-310", "5e-324", "1e-200", "1e99", "1e308"])
def test_json_of_numbers_of_any_size(log, capsys, size):
    rows = "".join(f"{i % 2 * float(size)},{i % 3 * float(size) / 3},{i % 2 * float(size)}\n" for i in range(40))
    _, out, error = doctor(capsys, log("reward,rating_1,rating_2\n" + rows), "--json", "-")
    assert json.loads(out, parse_constant=lambda name: pytest.fail(name))["rows"] == 40
    assert error == ""
