"""What has moved says where to."""

import importlib
import pickle
import re
import subprocess
import sys
from pathlib import Path

import pytest

import uard
from uard._support.moved import MODULES, NAMES, MovedModuleError

SOURCE = Path(uard.__file__).parent


def is_there(module):
    path = SOURCE / module.replace(".", "/")
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def test_old_names_are_free_and_new_ones_are_there():
    assert [name for name in MODULES if is_there(name)] == []
    assert [name for name in MODULES.values() if not is_there(name)] == []


@pytest.mark.parametrize("name", NAMES.values())
def test_new_names_resolve(name):
    module = next(m for m in (name, *(name.rsplit(".", n)[0] for n in (1, 2))) if is_there(m))
    found = importlib.import_module(f"uard.{module}")
    for part in name.removeprefix(module).split(".")[1:]:
        found = getattr(found, part)


@pytest.mark.parametrize("old", MODULES)
def test_an_old_name_says_what_it_is_called_now(old):
    top = old if old.partition(".")[0] not in MODULES else old.partition(".")[0]
    with pytest.raises(MovedModuleError, match=rf"^uard\.{re.escape(top)} is called uard\.\S+ now") as caught:
        importlib.import_module(f"uard.{old}")
    assert f"uard.{MODULES[old]}" in str(caught.value)


@pytest.mark.parametrize("statement", ["import uard.logs", "from uard import logs", "from uard.logs import read"])
def test_every_form_of_import_says_so(statement):
    done = subprocess.run([sys.executable, "-c", statement], capture_output=True, text=True, check=False)
    assert "uard.logs is called uard.ratings.readers now" in done.stderr.splitlines()[-1]
    assert "uard.logs.rollout is uard.ratings.rollout.rollout" in done.stderr


def test_so_does_a_pickle_of_before():
    with pytest.raises(MovedModuleError, match=r"uard\.stream is called uard\.ratings\.stream now"):
        pickle.loads(b"cuard.stream\nRewardStream\n.")


def test_names_that_never_were_are_errors_as_anywhere():
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'uard\.nonsense'$"):
        importlib.import_module("uard.nonsense")
    with pytest.raises(ImportError, match="cannot import name 'nonsense' from 'uard'"):
        exec("from uard import nonsense")
