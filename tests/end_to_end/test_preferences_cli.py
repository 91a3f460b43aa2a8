"""``uard preferences``, and how the doctor reads what tools export."""

import json

import pytest

from uard.cli import app as cli

PAIRS = "worker,left,right,choice\nann,x,y,left\nbob,y,x,right\ncat,x,y,tie\ncat,y,z,skip\n"
LONG = "clip,who,quality,score\na,ann,1,9\na,bob,?,9\nb,ann,2,9\nb,bob,0,9\nc,bob,3,9\n"


def run(capsys, *arguments):
    """Run a command and return its exit code and what it printed."""
    try:
        cli.main([*map(str, arguments)])
        code = 0
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


def test_counts(tmp_path, capsys):
    path = tmp_path / "pairs.csv"
    path.write_text(PAIRS)
    code, out, _ = run(capsys, "preferences", path, "--json", "-")
    counts = {"comparisons": 3, "ties": 1, "skipped": 1, "swapped": 1, "raters": 3, "agreement": pytest.approx(1 / 3)}
    assert code == 0
    assert json.loads(out).items() >= counts.items()
    assert "agreement of two raters" in run(capsys, "preferences", path)[1]
    path.write_text("a,b\n1,2\n")
    assert run(capsys, "preferences", path)[0] == 2
    path.write_text("chosen,rejected\nx,y\n")
    assert "not defined (no pair was judged by two)" in run(capsys, "preferences", path)[1]


def test_the_doctor_names_the_command(tmp_path, capsys):
    (tmp_path / "pairs.csv").write_text(PAIRS)
    code, _, error = run(capsys, "doctor", tmp_path / "pairs.csv")
    assert code == 2
    assert f"`uard preferences {tmp_path / 'pairs.csv'}`" in error


def test_options_of_the_long_form(tmp_path, capsys):
    path = tmp_path / "log.csv"
    path.write_text(LONG)
    options = ("--rater", "who", "--item", "clip", "--rating", "quality", "--missing", "?", "--missing", "0")
    code, out, _ = run(capsys, "doctor", path, *options, "--json", "-")
    answer = json.loads(out)
    assert (code, answer["rows"], answer["raters"], answer["rated"]) == (0, 3, ["ann", "bob"], 1.0)
    missing = [f["numbers"]["missing"] for f in answer["findings"] if f["code"] == "missing-ratings"]
    assert missing == [0.5]  # of three clips and two raters three ratings
    assert run(capsys, "doctor", path, *options[:-4])[0] == 2


def test_a_name_longer_than_any_file_has(capsys):
    code, _, error = run(capsys, "doctor", "x" * 300)
    assert code == 2
    assert "must be a file that ends in .csv" in error
