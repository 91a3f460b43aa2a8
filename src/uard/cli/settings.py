"""How ``--set`` and its like are read."""

from __future__ import annotations

import dataclasses
import json
from types import NoneType
from typing import Annotated, Any, cast, get_args

from tyro.conf import UseAppendAction, arg
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from uard import _checks
from uard._support.fields import changed
from uard.method.mitigations import Mitigation, named

Pairs = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE")]
Words = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="WORD")]
Names = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")]


def numbers() -> ConstructorRegistry:
    """Return how options that are numbers are read, with errors in words: ``1_000`` and ``two`` are none."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def _text(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if {*get_args(info.type)} != {str, NoneType}:
            return None
        return PrimitiveConstructorSpec(1, "STR", lambda texts: texts[0], _text_or_none, lambda v: [str(v)])

    @registry.primitive_rule
    def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        kinds = {*get_args(info.type)} - {NoneType} or {info.type}  # what is left out is None
        if kinds not in ({int}, {float}) or not ({*get_args(info.type)} <= {int, float, NoneType}):
            return None
        (kind,) = cast(set[Any], kinds)
        metavar, allowed = ("INT", "a whole number") if kind is int else ("FLOAT", "a number")

        def read(texts: list[str]) -> Any:
            try:
                if "_" not in texts[0]:
                    return kind(texts[0])
            except ValueError:
                pass
            raise ValueError(f"{_checks.short(texts[0])} must be {allowed}")

        def fits(value: Any) -> bool:
            return isinstance(value, kind) or (value is None and kind is not info.type)

        return PrimitiveConstructorSpec(1, metavar, read, fits, lambda v: [str(v)])

    return registry


def _text_or_none(value: Any) -> bool:
    return value is None or isinstance(value, str)


def settings(pairs: tuple[str, ...], option: str = "--set") -> dict[str, Any]:
    """Read ``name=value`` pairs; values are JSON, or else text.

    Raises:
        InvalidValueError: a pair without ``=``, or a second value for a name.
    """
    out: dict[str, Any] = {}
    for pair in pairs:
        name, sign, value = pair.partition("=")
        if not sign or not name:
            raise _checks.InvalidValueError(option, pair, "name=value, such as size=12 or 'traps=[[2,5],[7,3]]'")
        if name in out:
            raise _checks.InvalidValueError(
                option, pair, f"left out: {name} was set to {_checks.short(out[name])} before"
            )
        try:
            out[name] = json.loads(value)
        except (ValueError, RecursionError):  # of a number of 5000 digits, too
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
