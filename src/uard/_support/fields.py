"""Fields of frozen dataclasses, changed by name."""

from __future__ import annotations

import dataclasses
from typing import Any

from uard import _checks


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
