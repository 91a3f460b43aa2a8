"""``uard judges fit``: from a log of scores to a panel."""

import json

import numpy as np
import pytest

from uard.cli import app as cli
from uard.judges import JudgePanel


def run(capsys, *arguments):
    """Run the command and return its exit code and what it printed."""
    try:
        cli.main(["judges", *map(str, arguments)])
        code = 0
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


@pytest.fixture
def log(tmp_path):
    random = np.random.default_rng(0)
    lines = []
    for i in range(120):
        quality = random.normal()
        scores = {"clarity": quality + 0.3 * random.normal(), "tone": 50 + 9 * quality + 3 * random.normal()}
        scores["prompt only"] = i // 6 % 7
        lines.append(json.dumps({"prompt": f"p{i // 6}", "gold": quality, "scores": scores}))
    (tmp_path / "scores.jsonl").write_text("\n".join(lines))
    return tmp_path / "scores.jsonl"


def test_a_panel_is_written_and_told(log, capsys, tmp_path):
    file = tmp_path / "panel.json"
    code, out, err = run(capsys, "fit", log, "-o", file, "--truth", "gold", "--json", tmp_path / "told.json")
    assert code == 0
    assert "120 completions, 3 judges" in " ".join(out.split())
    assert "never tells the completions of one prompt apart: left out" in " ".join(out.split())
    assert "independent judges: " in " ".join(out.split())
    assert str(file) in err
    panel = JudgePanel.load(file, ["clarity", "tone", "prompt only"])
    assert panel.judges[1].location == pytest.approx(50, abs=3)
    told = json.loads((tmp_path / "told.json").read_text())
    assert told["judges"][2]["tells_apart"] is False
    assert told["effective"]["against"] == "true_reward"


def test_rules_and_judges_are_chosen(log, capsys, tmp_path):
    code, _, _ = run(capsys, "fit", log, "--judges", "tone", "clarity", "--rule", "lowest", "-o", tmp_path / "p.json")
    assert code == 0
    assert JudgePanel.load(tmp_path / "p.json").names == ("tone", "clarity")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--rule", "best"), "rule = 'best'"),
        (("--proxy", "truth"), "proxy = 'truth'"),
        (("--judges", "clarty", "tone"), "did you mean 'clarity'"),
        (("--judges", "tone"), "at least two judges"),
        (("--truth", "worth"), "column = 'worth'"),
        (("--missing", "x", "--prompt", "q"), "column = 'q'"),
        (("--failures", "tone"), "failures = 'tone': must be judge=score"),
        (("--failures", "tone=low"), "failures = 'tone=low': must be judge=score"),
        (("--failures", "ton=-1"), "did you mean 'tone'"),
        (("--judges", "clarity,tone"), "names with spaces between them"),
        (("-o", "/proc/panel.json"), "panel = '/proc/panel.json': must be a file that can be written"),
    ],
)
def test_silly_options(log, capsys, arguments, message):
    code, out, err = run(capsys, "fit", log, *arguments)
    assert (code, out) == (2, "")
    assert message in " ".join(err.split())


def test_declared_failures_are_in_the_panel(log, capsys, tmp_path):
    file = tmp_path / "panel.json"
    assert (
        run(capsys, "fit", log, "-o", file, "--missing", "-1", "--failures", "tone=0", "--failures", "tone=99")[0] == 0
    )
    assert [judge.sentinels for judge in JudgePanel.load(file).judges] == [(-1.0,), (-1.0, 0.0, 99.0), (-1.0,)]


def test_an_output_is_no_input(log, capsys):
    before = log.read_text()
    code, _, err = run(capsys, "fit", log, "-o", log)
    assert code == 2
    assert "error" in err
    assert log.read_text() == before


def test_what_is_no_log(tmp_path, capsys):
    (tmp_path / "log.csv").write_text("a,b\n1,2\n")
    code, _, err = run(capsys, "fit", tmp_path / "log.csv")
    assert code == 2
    assert "name the judges' columns with judges (--judges)" in " ".join(err.split())
    code, _, err = run(capsys, "fit", tmp_path / "log.csv", "--judges", "a", "b")
    assert code == 2
    assert "scores of judge 'a' = 1: must be at least 10" in " ".join(err.split())
