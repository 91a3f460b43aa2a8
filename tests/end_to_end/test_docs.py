"""README and docs: every Python block runs, every quick command works, and the headline numbers are true."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from uard.lab import studies
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.views import grpo, panels, robots
from uard.lab.views.published import packaged
from uard.lab.views.study_results import StudyResults

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.M | re.S)


def blocks(language: str) -> dict[str, str]:
    found = {
        str(p.relative_to(ROOT)): "\n".join(code for lang, code in BLOCK.findall(p.read_text()) if lang == language)
        for p in PAGES
    }
    return {name: code for name, code in found.items() if code.strip()}


@pytest.mark.parametrize("page", blocks("python"))
def test_python_blocks_run(page: str, tmp_path: Path) -> None:
    script = tmp_path / "block.py"
    script.write_text(blocks("python")[page])
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr


def commands() -> list[str]:
    text = "\n".join(blocks("bash").values()).replace("\\\n", " ")
    lines = [line.partition(" #")[0].strip() for line in text.splitlines()]
    return [c for c in lines if c.startswith(("uard run", "uard list"))]


@pytest.mark.parametrize("command", commands())
def test_commands_work(command: str, tmp_path: Path) -> None:
    argv = [str(Path(sys.executable).parent / "uard"), *shlex.split(command)[1:]]
    done = subprocess.run(argv, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr


def test_links_between_pages_exist() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


ROWS = {
    "Q-learning on the raw reward": {"agent": "baseline", "panel": "main"},
    "a random walk": {"agent": "random walk", "panel": "main"},
    "`uard-paper`, as printed": {"agent": "uard-paper"},
    "`uard`": {"agent": "uard"},
}


def test_what_the_readme_says_of_robots_is_what_was_published() -> None:
    assert robots.headline(robots.published()) in (ROOT / "README.md").read_text()


def test_what_the_guide_says_of_learned_reward_models_is_what_was_published() -> None:
    assert grpo.headline(grpo.published()) in (ROOT / "docs" / "guides" / "judges.md").read_text()


def test_what_the_readme_says_of_random_panels_is_what_was_published() -> None:
    (study,) = studies.find(("panels",))
    assert panels.headline(panels.regrets(study, packaged().per_seed)) in (ROOT / "README.md").read_text()


def test_headline_table_is_true() -> None:
    text = (ROOT / "README.md").read_text().split("<!-- headline")[1].split("<!-- end")[0]
    (study,) = studies.find(("scale",))
    store, seeds = Store(":memory:"), range(10)
    rows = [r for r in study.rows if r["size"] == 10 and r["agent"] != "uard-consistent"]
    runner.run([(r.cell, s) for r in rows for s in seeds], store, workers=1)
    results = StudyResults(store, seeds, [study])
    lines = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")][2:]
    assert len(lines) == 5
    for name, panel, *printed in lines:
        labels = {"panel": panel} | ROWS[name] | {"size": 10}
        for metric, shown in zip(("hacks", "success_rate", "true_return"), printed, strict=True):
            ours = results.get("scale", metric, **labels)
            mean, sd = (float(x) for x in shown.split("±"))
            # Rounding, and what another processor's arithmetic may change: half a standard deviation.
            assert abs(mean - ours.mean) <= 0.05 + 0.5 * ours.sd, (name, metric, shown, ours)
            assert abs(sd - ours.sd) <= 0.05 + 0.5 * ours.sd, (name, metric, shown, ours)
