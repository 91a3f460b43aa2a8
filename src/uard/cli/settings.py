"""How ``--set`` and its like are read."""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated, Any

from tyro.conf import UseAppendAction, arg

from uard import _checks
from uard._support.fields import changed
from uard.method.mitigations import Mitigation, named

Pairs = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE")]
Words = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="WORD")]
Names = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")]


def settings(pairs: tuple[str, ...], option: str = "--set") -> dict[str, Any]:
    """Read ``name=value`` pairs; values are JSON, or else text.

    Raises:
        InvalidValueError: a pair without ``=``, or a name that was there before.
    """
    out: dict[str, Any] = {}
    for pair in pairs:
        name, sign, value = pair.partition("=")
        if not sign or not name:
            raise _checks.InvalidValueError(option, pair, "name=value, such as size=12 or 'traps=[[2,5],[7,3]]'")
        if name in out:
            raise _checks.InvalidValueError(option, pair, f"given once for each name: {name} has {out[name]!r} already")
        try:
            out[name] = json.loads(value)
        except json.JSONDecodeError:
            out[name] = value
    return out


def mitigation(name: str, changes: dict[str, Any]) -> Mitigation:
    """Return a mitigation by name, some fields changed (``filter.lam`` and the like for the filter's)."""
    base: Any = named(name)
    short = {f.name for f in dataclasses.fields(base.filter)} if hasattr(base, "filter") else set()
    known = short | {f.name for f in dataclasses.fields(base)}
    for setting in changes:
        _checks.choose("mitigation setting", setting.partition(".")[0], known)
    return changed(base, {f"filter.{k}" if k in short else k: v for k, v in changes.items()}, "mitigation")
