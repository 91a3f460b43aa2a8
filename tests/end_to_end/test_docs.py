"""README and docs: every Python block runs, every quick command works, and every number is that of a stored result."""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

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


def numbers() -> ModuleType:
    """``docs/make_numbers.py``, which is no part of a package."""
    spec = importlib.util.spec_from_file_location("make_numbers", ROOT / "docs" / "make_numbers.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


NUMBERS = numbers()


def test_every_number_in_a_block_is_what_was_published() -> None:
    """If this fails after results were published anew, ``python docs/make_numbers.py`` writes the pages."""
    stale = [page.name for page, _, _ in NUMBERS.stale(NUMBERS.PUBLISHED)]
    assert not stale, f"python docs/make_numbers.py would change {', '.join(stale)}"


def test_the_check_names_the_page_and_the_block_that_differ(tmp_path: Path) -> None:
    """A copy of the script, README and docs, in which one number was changed by hand."""
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("*.png", "__pycache__"))
    shutil.copytree(ROOT / "benchmarks" / "results", tmp_path / "benchmarks" / "results")
    text = (ROOT / "README.md").read_text()
    true = NUMBERS.headline().splitlines()[-1]
    assert true in text
    (tmp_path / "README.md").write_text(text.replace(true, true.replace("0.", "9.", 1)))
    command = [sys.executable, str(tmp_path / "docs" / "make_numbers.py")]
    done = subprocess.run([*command, "--check"], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout) == (1, "README.md: headline is not what it should be\n"), done.stderr
    assert subprocess.run(command, capture_output=True, timeout=300, check=False).returncode == 0
    assert (tmp_path / "README.md").read_text() == text


def test_a_block_that_nobody_makes_is_an_error() -> None:
    with pytest.raises(KeyError, match="no-such-block"):
        NUMBERS.filled("<!-- numbers: no-such-block -->1<!-- end -->", NUMBERS.PUBLISHED)


def test_blocks_are_closed_and_every_maker_is_used() -> None:
    text = "\n".join(page.read_text() for page in PAGES)
    assert text.count("<!-- numbers: ") == text.count("<!-- end -->") == len(NUMBERS.BLOCK.findall(text))
    assert {name for name, _ in NUMBERS.BLOCK.findall(text)} == set(NUMBERS.PUBLISHED | NUMBERS.TRAINED)


SETTINGS = {  # what may have digits outside of blocks and code: how something is set, never what came of it
    "README.md": ("Python 3.11", "95 % interval", "coming from 0.1"),
    "docs/choose.md": ("0 is as good", "1 as bad", "little below 0", "95 % interval", "within 0.05", "80 % power"),
    "docs/limits.md": (
        "who says -1 where all others say 10",
        "unless it is denied by -10",
        "10 000 steps",
        "1 % of the steps",
        "10x10",
        "200 000 steps",
        "Theorem 1 ",
        "1e-150 to 1e150",
        "1e-15 to 1e15",
        "nearer to 1.",
    ),
}


@pytest.mark.parametrize("page", SETTINGS)
def test_no_result_is_typed_in_by_hand(page: str) -> None:
    text = NUMBERS.BLOCK.sub("", BLOCK.sub("", (ROOT / page).read_text()))
    text = re.sub(r"`[^`]*`|\]\([^)]*\)", "", text)  # code, and targets of links
    text = " ".join(text.split())
    for setting in SETTINGS[page]:
        assert setting in text, f"{setting} is not needed any more"
        text = text.replace(setting, "")
    text = re.sub(r"\b[A-Za-z]+\d\w*", "", text)  # names, such as Walker2d
    assert not re.findall(r".{0,40}\d.{0,40}", text)


def test_the_readme_is_one_screen_and_a_half() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 100
    assert len(NUMBERS.headline().splitlines()) == 2 + 5


def test_what_the_decision_page_says_in_words_follows_from_its_tables() -> None:
    """If this fails, results have changed, and docs/choose.md has to be read and written again."""
    assert NUMBERS.choose_short().endswith("`excess`, `uard` or `uard, 1 veto`.")
    robots = dict(line.strip("| ").split(" | ", 1) for line in NUMBERS.choose_robots().splitlines()[2:])
    assert not any("(more)" in told for told in robots.values())
    apart = {name for name, told in robots.items() if "`mean-of-annotations` (less)" in told}
    lies = {name for name in robots if "nothing lies" not in name}
    assert apart == {name for name in lies if "walker2d" in name or "main panel" in name}
    judges = NUMBERS.choose_judges()
    assert set(re.findall(r"`[\w -]+`", judges)) == {"`uard`", "`one model`"}
    assert "| label noise, at KL 1 |" in next(line for line in judges.splitlines() if "`one model`" in line)


def test_headline_table_is_true() -> None:
    """The paper's table is trained again, and may differ by what another processor's arithmetic changes."""
    blocks = dict(NUMBERS.BLOCK.findall((ROOT / "docs" / "paper.md").read_text()))
    lines = [line for line in blocks["paper"].splitlines() if line.startswith("|")][2:]
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in lines]
    assert [tuple(row[:2]) for row in rows] == list(NUMBERS.PAPER_ROWS)
    for name, panel, *printed in rows:
        found = NUMBERS.paper_row(NUMBERS.paper_results(), name, panel)
        for ours, shown in zip(found, printed, strict=True):
            mean, sd = (float(x) for x in shown.split("±"))
            # Rounding, and half a standard deviation.
            assert abs(mean - ours.mean) <= 0.05 + 0.5 * ours.sd, (name, shown, ours)
            assert abs(sd - ours.sd) <= 0.05 + 0.5 * ours.sd, (name, shown, ours)
