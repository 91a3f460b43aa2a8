"""Configurations as plain data, made of registered names and values, and the keys that are made of them.

A class has a name and no address, so that moving it to another module loses no result. Ours have their own names; those
that entry points of other packages name stand behind the name of their package, and can so never be mistaken for ours.
A class that nobody has registered stands behind its module:

    >>> type_name(dict), type_name(LookupError)
    ('builtins/dict', 'builtins/LookupError')
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from functools import cache
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from uard import _checks, plugins
from uard._support.fields import scalar

FORMAT = 3  # of configurations and keys; results with keys of an older one are brought over by ``uard migrate``
LOCAL = "<locals>."
_locals: WeakKeyDictionary[type, str] = WeakKeyDictionary()
_numbers = (f"#{i}" for i in itertools.count(1))
TYPE = "type"  # beside a configuration's fields, the name of its class


def type_name(cls: type) -> str:
    """Return the name of a class in configurations.

    Its own if it is uard's; ``package/Class`` if an entry point of its package names it, so that it may move; else
    ``module/Class``, for a package may have two classes of that name. One that is local to a function has a number,
    too, for two calls of the function make two classes.

    Examples:
        >>> from uard.lab.cell import Cell
        >>> type_name(Cell), type_name(json.JSONDecoder)
        ('Cell', 'json.decoder/JSONDecoder')
    """
    package = cls.__module__.partition(".")[0]
    if package == "uard":
        return cls.__qualname__
    if LOCAL in cls.__qualname__:
        return f"{cls.__module__}/{cls.__qualname__}{_locals.setdefault(cls, next(_numbers))}"
    return f"{package if _is_registered(cls, package) else cls.__module__}/{cls.__qualname__}"


def check_names(config: Any) -> None:
    """Check that a configuration can be found again by another process.

    Examples:
        >>> from uard.lab.cell import Cell
        >>> check_names(Cell().config())

    Raises:
        InvalidValueError: a class is local to a function, which makes another one whenever it is called.
    """
    if isinstance(config, list):
        for part in config:
            check_names(part)
    if isinstance(config, dict):
        if LOCAL in config[TYPE]:
            allowed = "a class outside functions: no other process could find its results, so no file keeps them"
            raise _checks.InvalidValueError("class", config[TYPE].rpartition("#")[0], allowed)
        for part in config.values():
            check_names(part)


def _is_registered(cls: type, package: str) -> bool:
    for plugin in (p for kind in plugins.NAMED for p in plugins.found(kind)):
        if plugin.entry.attr == cls.__qualname__ and plugin.entry.module.partition(".")[0] == package:
            try:
                if plugin.get() is cls:
                    return True
            except plugins.PluginError:  # a broken one is told where it is asked for
                continue
    return False


def plain(value: Any) -> Any:
    """Turn (nested) dataclasses into dictionaries of all their fields, with the name of their class as ``type``.

    Tuples become lists; any other value stays as it is. A field that a class got later says ``omitted_at`` in its
    metadata: with that value, which is what older results were made with, they keep their keys.

    Examples:
        >>> from uard.agents.networks import Network
        >>> plain((Network(hidden=32), 0.5))
        [{'type': 'Network', 'hidden': 32, 'learning_rate': 0.001, 'value_scale': 10.0, 'activation': 'relu'}, 0.5]
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        cls = type(value)
        held = {f.name: getattr(value, f.name) for f in _fields(cls)}
        omitted = [f.name for f in _fields(cls) if held[f.name] == f.metadata.get("omitted_at", dataclasses.MISSING)]
        return {TYPE: type_name(cls), **{name: plain(v) for name, v in held.items() if name not in omitted}}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


def key_of(config: dict[str, Any], trainer: str, version: int) -> str:
    """Return a cell's key: 32 hexadecimal digits.

    Examples:
        >>> from uard.lab.cell import Cell
        >>> cell = Cell()
        >>> key_of(plain(cell), cell.trainer.name, cell.trainer.version) == cell.key
        True

    Args:
        config: What ``plain`` made of it.
        trainer: Name of the kind of training.
        version: Of the code of that kind of training.

    Raises:
        ValueError: the configuration holds NaN or infinity.
    """
    named = {"format": FORMAT, "trainer": [trainer, version], "cell": config}
    text = json.dumps(named, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def settled(name: str, value: Any) -> Any:
    """Bring equal settings (2 and 2.0, 0.0 and -0.0, NumPy's numbers) to one form, so that their keys are equal.

    Examples:
        >>> settled("traps", (np.int64(3), -0.0))
        (3, 0.0)

    Args:
        name: Of the setting, for the error.
        value: A setting, or a frozen dataclass of settings.

    Raises:
        InvalidValueError: a setting that cannot be part of a key.
    """
    if _checks.is_frozen(value):
        return _settled_fields(name, value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, tuple):
        return tuple(settled(f"{name}[{i}]", v) for i, v in enumerate(value))
    if isinstance(value, float):
        _checks.number(name, value)
        return value if value else 0.0
    if not (value is None or isinstance(value, bool | int | str)):
        allowed = "a number, text, true, false, none, or a tuple or frozen dataclass of these"
        raise _checks.InvalidValueError(name, value, allowed)
    return value


def _settled_fields(name: str, value: Any) -> Any:
    changes = {}
    for f in _fields(type(value)):
        if f.name == TYPE:
            raise _checks.InvalidValueError(f"{name}.{TYPE}", value, f"without a field named {TYPE!r}")
        old = getattr(value, f.name)
        new = scalar(f"{name}.{f.name}", settled(f"{name}.{f.name}", old), f.type)
        if type(new) is not type(old) or repr(new) != repr(old):
            changes[f.name] = new
    return dataclasses.replace(value, **changes) if changes else value


@cache
def _fields(cls: type) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(cls)
