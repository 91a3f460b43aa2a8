"""Checks array shapes while the tests run: signatures written with jaxtyping are contracts.

Once this is imported, functions and methods of ``PACKAGES`` are wrapped as they are imported. A call whose arrays have
other shapes or types than the signature says must end in an error of the function's own. If it returns all the same, or
if what it returns has another shape, ``ShapeError`` is raised. The fields of named tuples that come or go are checked
too.

(jaxtyping's import hook cannot do this: it would refuse a call before our own errors, which the tests are about.)
"""

from __future__ import annotations

import functools
import importlib.abc
import importlib.machinery
import inspect
import sys
import types
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import BeartypeConf
from beartype.door import is_bearable

PACKAGES = ("uard.method", "uard.ratings", "uard.judges", "uard.diagnosis", "uard.adapters")
INTS_ARE_FLOATS = BeartypeConf(is_pep484_tower=True)


class ShapeError(AssertionError):
    """A function took or returned an array of another shape or type than its signature says."""


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if not fullname.startswith(PACKAGES):
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(fullname, spec.loader.path)
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    def exec_module(self, module: types.ModuleType) -> None:
        super().exec_module(module)
        classes = [c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__]
        for owner in (module, *classes):
            for name, value in list(vars(owner).items()):
                if inspect.isfunction(value) and value.__module__ == module.__name__:
                    setattr(owner, name, checked(value))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function, checked after each call that returns; itself if its signature says nothing of shapes."""
    hints = _hints(function.__annotations__, function.__globals__)
    if not hints or inspect.iscoroutinefunction(function):
        return function
    parameters = function.__code__.co_varnames[: function.__code__.co_argcount]
    known: set[Any] = set()  # what has been found right need not be checked again

    @functools.wraps(function)
    def wrapper(*args: Any, **options: Any) -> Any:
        result = function(*args, **options)
        values = dict(zip(parameters, args, strict=False), **options) | {"return": result}
        values = {name: values[name] for name in hints if name in values}
        kinds = tuple((name, _kind(value)) for name, value in values.items())
        if kinds not in known:
            _check(function.__qualname__, values, hints)
            known.add(kinds)
        return result

    return wrapper


def _kind(value: Any) -> Any:
    """Return all of a value that its checks depend on."""
    if hasattr(value, "dtype"):
        return type(value), tuple(value.shape), value.dtype
    return tuple(map(_kind, value)) if isinstance(value, tuple) else type(value)


def _check(where: str, values: dict[str, Any], hints: dict[str, Any]) -> None:
    with jaxtyping.jaxtyped("context"):  # in which one name is one size
        _check_each(where, values, hints)
    for name, value in values.items():
        if _fields(type(value)):  # its names are names of its own
            with jaxtyping.jaxtyped("context"):
                _check_fields(f"{where}: {name}", value)


def _check_each(where: str, values: dict[str, Any], hints: dict[str, Any]) -> None:
    for name, value in values.items():
        if not is_bearable(value, hints[name], conf=INTS_ARE_FLOATS):
            others = ", ".join(f"{n} {_text(v)}" for n, v in values.items() if n != name)
            raise ShapeError(f"{where}: {name} is {_text(value)}, not {_text(hints[name])}; with {others}")


def _check_fields(where: str, value: Any) -> None:
    fields = _fields(type(value))
    values = {name: getattr(value, name) for name in fields}
    _check_each(where, values, fields)
    for name, field in values.items():
        if _fields(type(field)):
            _check_fields(f"{where}.{name}", field)


def _text(value: Any) -> str:
    if inspect.isclass(value):
        return value.__name__
    return f"{value.dtype}{list(value.shape)}" if hasattr(value, "dtype") else repr(value)[:80]


@functools.cache
def _fields(kind: type) -> dict[str, Any]:
    """Return what a named tuple's fields must be; nothing for other classes."""
    if not (issubclass(kind, tuple) and hasattr(kind, "_fields")):
        return {}
    annotations = {name: getattr(hint, "__forward_arg__", hint) for name, hint in kind.__annotations__.items()}
    return _hints(annotations, vars(sys.modules[kind.__module__]))


def _hints(annotations: dict[str, Any], names: dict[str, Any]) -> dict[str, Any]:
    """Return those annotations that are shapes, or named tuples in which there are some."""
    hints = {}
    for name, text in annotations.items():
        try:  # jaxtyping's names are imported for the type checker only
            hint = eval(text, vars(jaxtyping) | names) if isinstance(text, str) else text
        except NameError:  # as others are
            continue
        if _has_shape(hint):
            hints[name] = hint
    return hints


def _has_shape(hint: Any) -> bool:
    if inspect.isclass(hint) and not typing.get_args(hint):
        return issubclass(hint, jaxtyping.AbstractArray) or bool(_fields(hint))
    return any(_has_shape(part) for part in typing.get_args(hint))


assert not any(name.startswith(PACKAGES) for name in sys.modules), "imported before they could be wrapped"
sys.meta_path.insert(0, _Finder())
