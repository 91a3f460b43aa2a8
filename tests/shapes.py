"""Checks array shapes while the tests run: signatures written with jaxtyping are contracts.

``install`` wraps the functions and methods of some packages as they are imported. A call whose arrays have other shapes
or types than the signature says must end in an error of the function's own; if it returns, or if what it returns has
another shape, the test fails.
"""

from __future__ import annotations

import functools
import importlib.abc
import importlib.machinery
import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from beartype import beartype
from jaxtyping import AbstractArray, TypeCheckError, jaxtyped


def install(packages: Sequence[str]) -> None:
    """Wrap what is imported of these packages from now on."""
    early = [name for name in sys.modules if name.startswith(tuple(f"{p}." for p in packages))]
    assert not early, f"imported before they could be wrapped: {early}"
    sys.meta_path.insert(0, _Finder(tuple(packages)))


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, packages: tuple[str, ...]):
        self.packages = packages

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        if not any(name == p or name.startswith(f"{p}.") for p in self.packages):
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(name, spec.loader.path)
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    def exec_module(self, module: types.ModuleType) -> None:
        super().exec_module(module)
        for owner, name, function in list(_functions(module)):
            checked = _checked(function)
            if checked is not None:
                setattr(owner, name, checked)


def _functions(module: types.ModuleType) -> Iterator[tuple[Any, str, Callable[..., Any]]]:
    for owner in (
        module,
        *(c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__),
    ):
        for name, value in vars(owner).items():
            if inspect.isfunction(value) and value.__module__ == module.__name__:
                yield owner, name, value


def _checked(function: Any) -> Callable[..., Any] | None:
    """Return the function with its array annotations checked; None if it has none."""
    arrays = {name: hint for name, hint in _hints(function).items() if _has_shape(hint)}
    if not arrays:
        return None
    twin = types.FunctionType(function.__code__, function.__globals__, function.__name__, None, function.__closure__)
    twin.__defaults__, twin.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    twin.__annotations__, twin.__qualname__, twin.__module__ = arrays, function.__qualname__, function.__module__
    strict = jaxtyped(typechecker=beartype)(twin)

    @functools.wraps(function)
    def wrapper(*args: Any, **options: Any) -> Any:
        try:
            return strict(*args, **options)
        except TypeCheckError as violation:
            function(*args, **options)  # its own error, which says more, is what a user would see
            raise violation

    return wrapper


def _hints(function: Any) -> dict[str, Any]:
    hints = {}
    for name, text in function.__annotations__.items():
        try:
            hints[name] = eval(text, function.__globals__) if isinstance(text, str) else text
        except (NameError, AttributeError):  # imported for the type checker only
            continue
    return hints


def _has_shape(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return True
    return any(_has_shape(part) for part in typing.get_args(hint))
