"""How a release is made: what must agree, and the wheel in an environment of its own."""

import importlib.util
import shutil
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import uard

ROOT = Path(__file__).parents[2]


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release", ROOT / "tools" / "release.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RELEASE = script()


def test_version_changelog_and_citation_agree_here():
    assert RELEASE.version() == uard.__version__
    texts = ((ROOT / name).read_text() for name in ("CHANGELOG.md", "CITATION.cff"))
    assert RELEASE.disagreements(uard.__version__, *texts) == []


@pytest.mark.parametrize(
    ("version", "changelog", "citation", "said"),
    [
        ("1.2.0", "# Changes\n\n## 1.2.0\n", "version: 1.2.0", ""),
        ("1.2.0", "## [1.2.0] (2026-01-01)", 'version: "1.2.0"', ""),
        ("1.2.0.dev0", "## 1.2.0 (unreleased)", "version: 1.2.0.dev0", ""),
        ("1.2.0", "## 1.2.0 (unreleased)", "version: 1.2.0", "unreleased"),
        ("1.2.0", "## 1.2.01", "version: 1.2.0", "no heading"),
        ("1.2.0", "## 1.2.0", "version: 1.1.0", "of version 1.1.0"),
        ("1.2.0", "## 1.2.0", "title: x", "of version None"),
    ],
)
def test_what_does_not_agree_is_named(version, changelog, citation, said):
    found = RELEASE.disagreements(version, changelog, citation)
    assert len(found) == bool(said)
    assert said in " ".join(found)


def test_the_citation_is_what_its_format_asks_for():
    """Citation File Format 1.2.0: what must be there, and the persons of the paper."""
    data = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= data.keys()
    assert (data["cff-version"], data["type"], data["license"]) == ("1.2.0", "software", "MIT")
    assert data["version"] == uard.__version__
    assert data["authors"] == [{"name": "The uard authors"}]
    (paper,) = data["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    assert paper["title"] == "Uncertainty-Aware Reward Discounting for Mitigating Reward Hacking"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return RELEASE.build(tmp_path_factory.mktemp("dist"))


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_what_it_lacks_is_named(built, tmp_path):
    sdist, wheel = built
    assert sdist.is_file()
    assert RELEASE.unlike(wheel) == []
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    ends = {Path(name).suffix for name in names}
    assert {".j2", ".css", ".js", ".json", ".toml", ".webp"} <= ends
    assert {"uard/lab/published/panels.json", "uard/replication/ledger/claims.toml"} <= names
    package = tmp_path / "uard"
    shutil.copytree(RELEASE.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "new.css").write_text("")
    (package / "_version.py").unlink()
    assert RELEASE.unlike(wheel, package) == ["lacks uard/new.css", "holds uard/_version.py"]


@pytest.mark.slow
def test_metadata_are_those_of_an_index(built, tmp_path):
    RELEASE.check_metadata(built)
    broken = tmp_path / "uard-1-py3-none-any.whl"
    with zipfile.ZipFile(broken, "w") as archive:
        archive.writestr("uard-1.dist-info/METADATA", "Metadata-Version: 2.4\nName: uard\nVersion: 1\n\n")
    if importlib.util.find_spec("twine") is None:
        with pytest.raises(RELEASE.NotReadyError, match="Summary, Requires-Python, License-Expression"):
            RELEASE.check_metadata([broken])


@pytest.mark.slow
def test_the_wheel_works_in_an_environment_of_its_own(built, tmp_path):
    """With the dependencies that are installed here, so that no network is needed; not with this checkout."""
    (tmp_path / "empty").mkdir()
    python = RELEASE.install(built[1], tmp_path / "venv", offline=True)
    RELEASE.smoke(python, tmp_path / "empty")
    assert not any(ROOT.samefile(p) for p in (tmp_path / "venv").parents)


@pytest.mark.slow
def test_what_is_not_right_stops_a_release(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(RELEASE, "disagreements", lambda *_: ["CHANGELOG.md has no heading"])
    assert RELEASE.main(["--offline", "--dirty", "--out", str(tmp_path)]) == 1
    assert "no   version, changelog and citation agree: CHANGELOG.md has no heading" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_command_that_fails_says_what_it_printed(tmp_path):
    with pytest.raises(RELEASE.NotReadyError, match=r"(?s)failed:.*over there"):
        RELEASE.run(sys.executable, "-c", "print('over there'); raise SystemExit(3)", cwd=tmp_path)
