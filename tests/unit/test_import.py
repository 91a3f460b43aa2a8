import subprocess
import sys

import pytest

import uard

HEAVY = ("jax", "torch", "gymnasium", "scipy", "matplotlib")


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


@pytest.mark.parametrize("name", uard.__all__)
def test_public_names_resolve(name):
    assert getattr(uard, name) is not None
    assert name in dir(uard)


def test_other_names_do_not_resolve():
    with pytest.raises(AttributeError, match="module 'uard' has no attribute 'nonsense'"):
        uard.nonsense  # noqa: B018
