"""Examples in docstrings run, and whatever a user calls has one."""

import doctest
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import pytest

PACKAGES = ("method", "ratings", "judges", "diagnosis", "adapters", "collect", "envs", "agents", "training", "lab")
DOCS = Path(__file__).parents[2] / "docs"
PARSER = doctest.DocTestParser()


def modules():
    """All modules of the packages, by name."""
    names = ["uard.plugins"]
    for package in (f"uard.{p}" for p in PACKAGES):
        found = pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.")
        names += [package, *(module.name for module in found)]
    return {name: importlib.import_module(name) for name in names}


def members(owner):
    """What an owner defines that has no leading underscore: name -> function or class."""
    module = owner.__module__ if inspect.isclass(owner) else owner.__name__
    return {
        name: value
        for name, value in vars(owner).items()
        if not name.startswith("_") and callable(value) and getattr(value, "__module__", None) == module
    }


def docstrings(module):
    """All docstrings of a module that may hold examples, its own first."""
    yield module.__name__, module.__doc__
    for name, value in members(module).items():
        yield f"{module.__name__}.{name}", value.__doc__
        if inspect.isclass(value):
            yield from ((f"{module.__name__}.{name}.{m}", f.__doc__) for m, f in members(value).items())


@pytest.mark.parametrize("name", modules())
def test_examples_run(name):
    """Names that the module's own docstring makes are known to all its examples."""
    module = importlib.import_module(name)
    known, output = vars(module), []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for owner, text in docstrings(module):
        test = PARSER.get_doctest(text or "", known, owner, None, 0)  # which works on a copy of the names
        runner.run(test, out=output.append, clear_globs=False)
        known = test.globs if owner == name else known
    assert runner.failures == 0, "".join(output)


def public():
    """What the reference lists, a module with all that it defines, and what the packages export."""
    pages = "\n".join(page.read_text() for page in DOCS.rglob("*.md"))
    exporting = {name for name, module in modules().items() if hasattr(module, "__all__")}
    for name in exporting | set(re.findall(r"^::: (\S+)", pages, re.M)) - {"uard"}:
        if name in modules():
            module = importlib.import_module(name)
            names = getattr(module, "__all__", members(module))
            yield from (f"{name}.{n}" for n in names if is_called(getattr(module, n)))
        else:
            yield name


def is_called(value):
    """Whether users call it; results, warnings and types are handed to them."""
    if inspect.isclass(value):
        protocol = getattr(value, "_is_protocol", False)
        return not (issubclass(value, BaseException) or hasattr(value, "_fields") or protocol)
    return inspect.isfunction(value)


@pytest.mark.parametrize("name", sorted(set(public())))
def test_whatever_is_called_has_an_example(name):
    module, _, attribute = name.rpartition(".")
    value = getattr(importlib.import_module(module), attribute)
    texts = (
        [value.__doc__, *(f.__doc__ for f in members(value).values())] if inspect.isclass(value) else [value.__doc__]
    )
    assert any(">>> " in (text or "") for text in texts)
