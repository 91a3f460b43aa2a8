"""``uard collect record``, ``serve`` and ``simulate``: from an environment to ratings, with real processes."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from uard.collect import Project
from uard.ratings import readers
from uard.ratings.table import Answer

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for a child")


def collect(folder, *arguments, code=0):
    command = [sys.executable, "-m", "uard", "collect", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stderr
    return done


@pytest.fixture
def served(tmp_path):
    collect(tmp_path, "record", "TrapGrid", "grid", "--segments", 20, "--length", 1, "--low", -12, "--high", 12)
    command = [sys.executable, "-m", "uard", "collect", "serve", "grid", "--port", "0", "--raters", "ann"]
    page = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    told = dict(line.strip().split(": ", 1) for line in (next(page.stdout), next(page.stdout)))
    yield told["owner"].split()[0].removesuffix("/owner")
    page.send_signal(signal.SIGINT)
    page.wait(20)
    page.stdout.close()


def test_a_panel_at_the_page_says_what_its_law_says(served, tmp_path):
    who = "--panel", "single", "--environment", "TrapGrid"
    said = collect(tmp_path, "simulate", "grid", *who, "--url", served, "--idle", 1, "--json", "-")
    numbers = json.loads(said.stdout)
    assert numbers["errors"] == {}
    assert numbers["raters"]["simulated-1"] >= 20
    collect(tmp_path, "export", "grid", "answers.csv")
    log = readers.read(tmp_path / "answers.csv")
    assert len(log) == 20
    lies = log.reward == 4.0
    assert np.abs(log.ratings[~lies, 0] - log.reward[~lies]).max() < 1  # noise of sd 0.1
    assert (log.ratings[lies, 0] < 0).all()
    status = json.loads(collect(tmp_path, "status", "grid", "--json", "-").stdout)
    assert {r["name"]: r["answers"] for r in status["raters"]}["simulated-1"] == numbers["answers"]


def test_items_are_listed_by_name(tmp_path):
    (tmp_path / "sums.jsonl").write_text(
        '{"prompt": "2 + 2?", "completion": "4"}\n{"prompt": "2 + 2?", "completion": "5"}\n'
    )
    collect(tmp_path, "texts", "sums.jsonl", "sums", "--kind", "pairs")
    found = json.loads(collect(tmp_path, "items", "sums", "--json", "-").stdout)["items"]
    with Project.open(tmp_path / "sums").store() as store:
        assert [row["item"] for row in found] == [item.id for item in store.items()[0]]
    assert [row["kind"] for row in found] == ["text", "text", "pair"]
    shown = collect(tmp_path, "items", "sums").stdout
    assert all(row["item"] in shown for row in found)
    assert max(map(len, shown.splitlines())) <= 80


def test_where_people_rate_nobody_is_simulated_unasked(served, tmp_path):
    with Project.open(tmp_path / "grid").store() as store:
        store.put([Answer("a1", store.items()[0][0].id, "ann", 1.0)])
    refused = collect(tmp_path, "simulate", "grid", "--url", served, code=2)
    assert "ann has answered, and this is not undone" in " ".join(refused.stderr.split())
    said = collect(tmp_path, "simulate", "grid", "--url", served, "--beside-people", "--idle", 1)
    assert "answers; median" in said.stdout


def test_what_goes_wrong_is_said(served, tmp_path):
    again = collect(tmp_path, "serve", "grid", "--port", "0", code=2)
    assert f"another server has it already: {served}" in " ".join(again.stderr.split())
    port = served.rpartition(":")[2]
    (tmp_path / "other").mkdir()
    collect(tmp_path, "record", "TrapGrid", "second", "--segments", 2, "--length", 1)
    taken = collect(tmp_path, "serve", "second", "--port", port, code=2)
    assert f"port = {port}: must be free" in " ".join(taken.stderr.split())
    unknown = collect(tmp_path, "simulate", "grid", "--environment", "Hopper", "--url", served, code=2)
    assert "environment = 'Hopper': must be one of numbered states" in " ".join(unknown.stderr.split())
    assert "must be" in collect(tmp_path, "simulate", "nowhere", "--url", served, code=2).stderr
    assert os.path.exists(tmp_path / "grid" / "answers.sqlite")
