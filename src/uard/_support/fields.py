"""Fields of frozen dataclasses: changed by name, and checked by what their annotations say."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from uard import _checks

_SCALAR = re.compile(r"(?:typing\.)?(?:(Optional)\[)?(bool|int|float|str)\]?( \| None)?")


def check(config: Any) -> None:
    """Check the fields of a frozen dataclass that no range says enough of.

    These are what is annotated as true or false or as a text, and parts that are dataclasses themselves: one of the
    class that is annotated, of which the default is one.

    Raises:
        InvalidValueError: naming the field, the value and what is allowed.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if _kind(field.type)[0] in ("bool", "str"):
            scalar(field.name, value, field.type)
        part = _default(field)
        if dataclasses.is_dataclass(part) and type(part).__name__ == field.type:
            _checks.instance(field.name, value, type(part), f"of the class {field.type}, such as {part}")


def _default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def scalar(name: str, value: Any, annotation: Any) -> Any:
    """Return a field's value in the one form that its annotation allows, so that equal settings look alike.

    Examples:
        >>> scalar("lam", 2, float), scalar("seed", np.int64(2), "int"), scalar("region", (1, 2), tuple)
        (2.0, 2, (1, 2))

    Args:
        name: Of the field, for the error.
        value: If the annotation is ``bool``, ``int``, ``float`` or ``str``, or one of these or none: true or false, a
            whole number, a finite number, a text. Anything if it is another one.
        annotation: Evaluated or not.

    Raises:
        InvalidValueError: a value of another kind: 1 is not true, and 1.0 is no whole number.
    """
    kind, optional = _kind(annotation)
    if kind is None or (optional and value is None) or _checks.is_traced(value):
        return value
    form, check = _FORMS[kind]
    check(name, value)
    return form(value)


def _check_kind(name: str, value: Any, kinds: tuple[type, ...], allowed: str) -> None:
    if not isinstance(value, kinds):
        raise _checks.InvalidValueError(name, value, allowed)


_FORMS: dict[str, tuple[Callable[[Any], Any], Callable[[str, Any], None]]] = {
    "float": (float, _checks.number),
    "int": (int, partial(_checks.whole, low=-math.inf)),
    "bool": (bool, partial(_check_kind, kinds=(bool, np.bool_), allowed="true or false")),
    "str": (str, partial(_check_kind, kinds=(str,), allowed="a text")),
}


@cache
def _kind(annotation: Any) -> tuple[str | None, bool]:
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    found = _SCALAR.fullmatch(text)
    return (found[2], bool(found[1] or found[3])) if found else (None, False)


def changed(base: Any, changes: dict[str, Any], what: str) -> Any:
    """Return a frozen dataclass with some fields changed; nested ones by dotted names.

    Raises:
        UnknownNameError: an unknown field, with the nearest known one.
        InvalidValueError: a value of another kind than the field's.
    """
    fields = {f.name: f for f in dataclasses.fields(base) if f.init}
    given: dict[str, Any] = {}
    for name, value in changes.items():
        head, _, rest = name.partition(".")
        if head not in fields:
            raise _checks.UnknownNameError(f"{what} setting", name, fields)
        old = given.get(head, getattr(base, head))
        parts = [f"{head}.{f.name}" for f in dataclasses.fields(old)] if dataclasses.is_dataclass(old) else []
        if bool(rest) != bool(parts):
            raise _checks.InvalidValueError(f"{what} setting", name, f"one of {', '.join(parts)}" if parts else head)
        if rest:
            value = changed(old, {rest: value}, f"{what}.{head}")
        elif isinstance(old, bool) and not isinstance(value, bool):
            raise _checks.InvalidValueError(f"{what} setting {name}", value, "true or false")
        elif isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        elif isinstance(value, list):
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
        given[head] = value
    return dataclasses.replace(base, **given)
