import subprocess
import sys
from pathlib import Path

import pytest

import uard

HEAVY = ("jax", "jaxtyping", "torch", "gymnasium", "scipy", "matplotlib")


def run(code):
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_is_fast():
    code = "import time; t = time.perf_counter(); import uard; print(time.perf_counter() - t)"
    assert min(float(run(code)) for _ in range(3)) < 0.3


@pytest.mark.parametrize(
    "use",
    [
        "",
        "from uard import *",
        "import uard.method.mitigations as m; m.named('uard')",
        "import uard.method.calibration, uard.method.stability",
    ],
)
def test_the_method_needs_nothing_heavy(use):
    assert run(f"import sys, uard; {use}\nprint([m for m in {HEAVY} if m in sys.modules])").strip() == "[]"


def modules(*packages):
    """Names of all modules in some packages; none is imported."""
    source = Path(uard.__file__).parent
    found = (file for package in packages for file in (source / package).rglob("*.py"))
    parts = (file.relative_to(source.parent).with_suffix("").parts for file in found)
    return sorted(".".join(p[:-1] if p[-1] == "__init__" else p) for p in parts)


@pytest.mark.parametrize(
    "names",
    [
        ", ".join(modules("adapters")),
        ", ".join(modules("method", "ratings", "judges", "diagnosis")),
        "uard.cli.app, uard.plugins",
    ],
)
def test_all_but_the_laboratory_is_imported_without_jax(names):
    code = f"import sys, warnings; warnings.simplefilter('ignore'); import {names}"  # others' warnings are theirs
    assert run(f"{code}; print('jax' in sys.modules)") == "False\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["doctor", "log.csv"],
        ["doctor", "log.csv", "--set-mitigation", "kappa=0", "--json", "out.json"],
        ["doctor", "none.csv"],
        ["doctor", "--nope"],
        ["reproduce", "--help"],
    ],
)
def test_the_doctor_and_help_load_no_jax(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{i / 50},{i / 50},{i / 50 + 0.01}\n" for i in range(50))
    (tmp_path / "log.csv").write_text(f"reward,rating_a,rating_b\n{rows}")
    code = f"""
import sys
from uard.cli.app import main
try:
    main({arguments})
except SystemExit:
    pass
print([m for m in ("jax", "optax", "matplotlib", "uard.lab.registry") if m in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == "[]"


def test_without_the_laboratory_commands_say_what_to_install():
    code = "import sys; sys.modules[{0!r}] = None; from uard.cli.app import main; main({1!r})"
    for missing, arguments in (("tyro", ["list"]), ("jax", ["list"]), ("rich", ["doctor", "x.csv"])):
        command = [sys.executable, "-c", code.format(missing, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr.startswith("the laboratory is not installed: pip install 'uard[lab]' (")


@pytest.mark.parametrize("name", uard.__all__)
def test_public_names_resolve(name):
    assert getattr(uard, name) is not None
    assert name in dir(uard)


def test_other_names_do_not_resolve():
    with pytest.raises(AttributeError, match="module 'uard' has no attribute 'nonsense'"):
        uard.nonsense  # noqa: B018
