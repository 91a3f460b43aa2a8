"""``uard raters``: who said what in a file of ratings."""

import json

import pytest

from uard.cli import app as cli

ANSWERS = "question,system,clip,who,score,rank\n" + "".join(
    f"q{q},{system},q{q}{system},{who},{5 * (system == 'b') + q % 3 + k},{1 + (system == 'a')}\n"
    for q in range(15)
    for system in "ab"
    for k, who in enumerate(("ann", "bob"))
)
OPTIONS = ("--rater", "who", "--item", "clip", "--rating", "score", "--by", "system")


def run(capsys, *arguments):
    """Run the command and return its exit code and what it printed."""
    try:
        cli.main(["raters", *map(str, arguments)])
        code = 0
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "answers.csv"
    file.write_text(ANSWERS)
    return file


def test_table_and_json(path, capsys, tmp_path):
    code, out, _ = run(capsys, path, *OPTIONS, "--json", tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert code == 0
    assert "30 items, 2 raters, 60 answers; bias is against the other raters" in " ".join(out.split())
    assert [r["bias"]["value"] for r in found["raters"]] == pytest.approx([-1.0, 1.0])  # bob gives one more
    assert [s["name"] for s in found["agreement"]["within"]] == ["a", "b"]
    assert found["effective"]["against"] == "part"
    assert json.loads(run(capsys, path, *OPTIONS, "--json", "-")[1]) == found


def test_ranks_within_questions(path, capsys):
    options = ("--rank", "rank", "--within", "question", "--json", "-")
    order = json.loads(run(capsys, path, *OPTIONS, *options)[1])["order"]
    assert (order["own"], order["within"], order["groups"]) == ("ranks", "question", 15)
    assert all(row["alike"]["value"] == 1.0 for row in order["rows"])  # b is always the better one
    assert {row["pairs"] for row in order["rows"]} == {15, 30}


def test_bad_input(path, capsys, tmp_path):
    assert run(capsys, path, *OPTIONS, "--within", "story")[0] == 2
    (tmp_path / "wide.csv").write_text("reward,rating_ann,rating_bob\n1,inf,2\n2,2,2\n")
    code, _, error = run(capsys, tmp_path / "wide.csv")
    assert (code, "row 1, column 'rating_ann' = inf" in " ".join(error.split())) == (2, True)
    wide = ("--ratings", "rating_bob", "--rank", "reward")
    error = run(capsys, tmp_path / "wide.csv", *wide)[2]
    assert "left out: it is for a file of one answer per row" in " ".join(error.split())
    (tmp_path / "none.csv").write_text("reward,rating_ann\n1,\n2,\n")
    code, out, _ = run(capsys, tmp_path / "none.csv")
    assert (code, "no answers" in out, "nan" in out.lower()) == (0, True, False)
