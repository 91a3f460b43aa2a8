"""Every example is a script that does what its guide says."""

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, folder: Path, *options: str) -> str:
    command = [sys.executable, str(EXAMPLES / name), *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["gymnasium_wrapper.py", "sb3_dqn.py"])
def test_hacks_without_and_none_with_the_filter(name: str, tmp_path: Path) -> None:
    found = re.findall(r"(with|without) +the filter: +([\d.]+) hacks, true return +([-\d.]+)", run(name, tmp_path))
    hacks, value = ({kind: float(row[i]) for kind, *row in found} for i in range(2))
    assert hacks["without"] > 10
    assert hacks["with"] < 0.5
    assert value["with"] > value["without"] + 20


def test_ppo_on_a_hopper_is_trained_and_judged_both_ways(tmp_path: Path) -> None:
    lines = run("sb3_hopper.py", tmp_path, "--steps", "2048", "--episodes", "1").splitlines()
    assert [re.sub(r"[-\d.]+", "x", " ".join(line.split())) for line in lines] == [
        f"{kind} the filter: x hacks, true return x" for kind in ("without", "with")
    ]


def test_a_study_with_intervals(tmp_path: Path) -> None:
    rows = run("study.py", tmp_path).splitlines()[1:]
    visits = {tuple(r.split()[:2]): float(r.split()[2]) for r in rows}
    assert len(visits) == 8
    assert visits["0.0", "raw"] > 10 > 1 > visits["0.0", "uard"]


def test_a_csv_of_ratings(tmp_path: Path) -> None:
    assert "DANGER" in run("csv_of_ratings.py", tmp_path)


def test_a_task_of_verifiers(tmp_path: Path) -> None:
    found = re.findall(r"reward ([-+\d.]+), believed to (\d+) %", run("verifiers_task.py", tmp_path))
    (topic, _), (filler, _), (hack, believed) = found
    assert float(topic) > float(filler) > float(hack)
    assert int(believed) < 10


def test_people_rate_while_an_agent_trains(tmp_path: Path) -> None:
    """From an empty store to an agent that avoids the traps and reaches the goal, by raters at a real page."""
    numbers = json.loads(run("people_rate.py", tmp_path, "--json", "--episodes", "800"))
    assert numbers["ratings"] > 300
    assert numbers["goal_rate"] > 0.9
    assert numbers["hacks"] < 3  # without ratings it hacks 17 times


def test_ten_minutes_does_what_its_page_says(tmp_path: Path) -> None:
    printed = run("ten_minutes.py", tmp_path)
    page = (EXAMPLES.parent / "docs" / "ten-minutes.md").read_text()
    shown = page.split("<!-- numbers: ten-minutes -->")[1].split("```")[1].removeprefix("text")
    number = re.compile(r"-?\d+(?:\.\d+)?")
    assert number.sub("x", printed).split() == number.sub("x", shown).split()
    for ours, theirs in zip(number.findall(printed), number.findall(shown), strict=True):
        # What another processor's arithmetic may change: which of two equal actions is taken.
        assert float(ours) == pytest.approx(float(theirs), rel=0.2, abs=0.5)
    without, with_it = (list(map(float, number.findall(line))) for line in printed.splitlines()[:2])
    assert without[0] > with_it[0] > with_it[1] > 0 > without[1]  # paid less, worth more
    assert without[2] > 10 > 2 > with_it[2]


def test_ten_minutes_is_no_matter_of_the_seed() -> None:
    found = runpy.run_path(str(EXAMPLES / "ten_minutes.py"))
    for seed in range(1, 4):
        filtered = found["ReliabilityWrapper"](
            found["Corridor"](), ratings=found["people"](np.random.default_rng(seed))
        )
        assert found["learn"](found["Corridor"](), seed)[1] < 0 < 5 < found["learn"](filtered, seed)[1]


@pytest.mark.parametrize("name", sorted(p.name for p in EXAMPLES.glob("*.py")))
def test_every_example_has_a_test(name: str) -> None:
    assert name in Path(__file__).read_text() or name in "".join(
        p.read_text() for p in (Path(__file__).parents[1] / "adapters").glob("*.py")
    )
