"""Builds a release and tries it as a stranger would: ``python tools/release.py [--offline] [--out dist]``.

In this order, and it stops at the first that fails: the tree is clean and what it says of itself agrees (version,
changelog, CITATION.cff); sdist and wheel are built, from the sdist; their metadata are checked; the wheel holds every
file of the package and nothing else; it is installed into a new environment with its extra ``lab`` and tried in an
empty folder. Nothing is uploaded. ``--offline`` borrows the dependencies of the environment that this runs in.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
import zipfile
from collections.abc import Callable, Sequence
from email.parser import Parser
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "uard"


class NotReadyError(Exception):
    """What has to be mended before a release."""


def version(root: Path = ROOT) -> str:
    """Return the version that the package has, without importing it."""
    found = re.search(r'__version__ = "([^"]+)"', (root / "src" / "uard" / "_version.py").read_text(encoding="utf-8"))
    if found is None:
        raise NotReadyError("src/uard/_version.py has no __version__")
    return found[1]


def disagreements(version: str, changelog: str, citation: str) -> list[str]:
    """Return what does not agree with a version.

    >>> disagreements("1.2.0", "## 1.1.0", "version: 1.2.0")
    ['CHANGELOG.md has no heading "## 1.2.0"']

    Args:
        version: Of the package; one with ``.dev`` is not released yet, and its heading may say so.
        changelog: Text of CHANGELOG.md.
        citation: Text of CITATION.cff.
    """
    base, _, development = version.partition(".dev")
    found = []
    heading = re.search(rf"^## \[?{re.escape(base)}\]?(?=\s|$)(.*)$", changelog, re.M)
    if heading is None:
        found.append(f'CHANGELOG.md has no heading "## {base}"')
    elif not development and "unreleased" in heading[1]:
        found.append(f"CHANGELOG.md still says that {base} is unreleased")
    cited = re.search(r"^version: [\"']?([^\"'\n]+)", citation, re.M)
    if cited is None or cited[1].strip() != version:
        found.append(f"CITATION.cff is of version {cited[1] if cited else None}, the package of {version}")
    return found


def unlike(wheel: Path, package: Path = PACKAGE) -> list[str]:
    """Return what a wheel lacks of a package's files, and what it holds beside them."""
    wanted = {
        f"{package.name}/{path.relative_to(package).as_posix()}"
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    return [f"lacks {name}" for name in sorted(wanted - held)] + [f"holds {name}" for name in sorted(held - wanted)]


def check_tree() -> None:
    """Check that everything is committed."""
    done = subprocess.run(["git", "status", "--porcelain"], cwd=ROOT, capture_output=True, text=True, check=True)
    if done.stdout:
        raise NotReadyError(f"the tree is not clean:\n{done.stdout}")


def check_words() -> None:
    """Check that version, changelog and citation agree."""
    texts = ((ROOT / name).read_text(encoding="utf-8") for name in ("CHANGELOG.md", "CITATION.cff"))
    if found := disagreements(version(), *texts):
        raise NotReadyError("; ".join(found))


def build(out: Path) -> tuple[Path, Path]:
    """Build the sdist, and the wheel from it, without a network; return both."""
    done = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise NotReadyError(f"python -m build failed:\n{done.stdout}{done.stderr}")
    (sdist,), (wheel,) = (list(out.glob(f"uard-{version()}{end}")) for end in (".tar.gz", "-py3-none-any.whl"))
    return sdist, wheel


def check_metadata(files: Sequence[Path]) -> None:
    """Check metadata with twine if it is at hand, else that they can be read and name what an index needs."""
    if importlib.util.find_spec("twine"):
        done = subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *map(str, files)], check=False)
        if done.returncode:
            raise NotReadyError("twine check failed")
        return
    from packaging.metadata import Metadata

    for file in (f for f in files if f.suffix == ".whl"):
        with zipfile.ZipFile(file) as archive:
            (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
            text = archive.read(name).decode()
        Metadata.from_email(text, validate=True)
        fields = Parser().parsestr(text)
        lost = [k for k in ("Name", "Version", "Summary", "Requires-Python", "License-Expression") if not fields[k]]
        if lost or not fields.get_payload():
            raise NotReadyError(f"{file.name}: metadata lack {', '.join(lost) or 'a description'}")


def install(wheel: Path, folder: Path, offline: bool) -> Path:
    """Install a wheel into a new environment and return its Python.

    Args:
        wheel: What is installed.
        folder: Of the environment.
        offline: Whether dependencies are borrowed from the environment that this runs in.
    """
    venv.create(folder, with_pip=not offline, symlinks=os.name != "nt")
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    if not offline:
        run(python, "-m", "pip", "install", "--quiet", f"{wheel}[lab]", cwd=folder)
        return python
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip())
    # A path is borrowed after all of its own, and files *.pth in it are not obeyed: an editable uard is not seen.
    paths = dict.fromkeys(sysconfig.get_path(name) for name in ("purelib", "platlib"))
    (site / "borrowed.pth").write_text("\n".join(paths), encoding="utf-8")
    borrowed = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    done = subprocess.run([*borrowed, "--ignore-installed", str(wheel)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotReadyError(f"pip install failed:\n{done.stdout}{done.stderr}")
    return python


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command in a folder, without what this process knows of other packages; return what it prints."""
    known = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    done = subprocess.run([*map(str, command)], cwd=cwd, env=known, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotReadyError(f"{' '.join(map(str, command))} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


LIGHT = """
import sys, uard
from uard.method.mitigations import named
named("uard")
print(uard.__version__, uard.__file__, [m for m in ("jax", "torch", "matplotlib") if m in sys.modules])
"""
STORED = """
from uard.lab import studies
from uard.lab.views.published import broken, packaged_json
from uard.replication.ledger import CLAIMS
assert not broken() and CLAIMS
assert studies.find(("scale",)) and studies.find(("panels",))
assert packaged_json("robots.json")["cells"] and packaged_json("mujoco-eight.json")["cells"]
"""


def smoke(python: Path, folder: Path) -> None:
    """Try what was installed, in an empty folder: import, list, run, published results and plugins."""
    found, path, loaded = run(python, "-c", LIGHT, cwd=folder).split(maxsplit=2)
    if found != version() or python.parents[1] not in Path(path).parents or loaded.strip() != "[]":
        raise NotReadyError(f"import uard gives version {found} of {path} and loads {loaded}")
    uard = python.with_name("uard")
    listed = run(uard, "list", cwd=folder)
    if lost := [name for name in ("TrapGrid", "uard-paper", "scale") if name not in listed]:
        raise NotReadyError(f"uard list does not know {', '.join(lost)}")
    command = (
        "run",
        "TrapGrid",
        "--set",
        "size=4",
        "--episodes",
        "50",
        "--seeds",
        "2",
        "--json",
        "-",
    )
    printed = run(uard, *command, cwd=folder)
    json.loads(printed)
    run(python, "-c", STORED, cwd=folder)


def steps(out: Path, offline: bool, dirty: bool) -> list[tuple[str, Callable[[], object]]]:
    """Return what is done, in order, with words for whoever watches."""
    made: list[Path] = []

    def contents() -> None:
        if found := unlike(made[1]):
            raise NotReadyError(f"the wheel {'; '.join(found)}")

    def tried() -> None:
        with tempfile.TemporaryDirectory() as parent:
            folder = Path(parent)
            (folder / "empty").mkdir()
            smoke(install(made[1], folder / "venv", offline), folder / "empty")

    first: list[tuple[str, Callable[[], object]]] = [] if dirty else [("everything is committed", check_tree)]
    return [
        *first,
        ("version, changelog and citation agree", check_words),
        ("sdist and wheel", lambda: made.extend(build(out))),
        ("metadata", lambda: check_metadata(made)),
        ("the wheel holds the package", contents),
        ("installed into a new environment, and tried", tried),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Do all steps; return 1 at the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--offline", action="store_true", help="borrow the dependencies of this environment")
    parser.add_argument("--dirty", action="store_true", help="do not ask whether everything is committed")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="where sdist and wheel go")
    chosen = parser.parse_args(arguments)
    for words, step in steps(chosen.out, chosen.offline, chosen.dirty):
        try:
            step()
        except NotReadyError as error:
            print(f"no   {words}: {error}", file=sys.stderr)
            return 1
        print(f"yes  {words}", flush=True)
    print(f"{chosen.out} holds uard {version()}. docs/releasing.md says what comes next.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
