"""Frozen dataclasses as JAX pytrees: numbers are traced, everything else is part of the program.

So a sweep over numbers never recompiles, and the core needs no JAX.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

_known: set[type] = set()


def traceable(value: Any) -> Any:
    """Register the classes of a (nested) frozen dataclass and return the value unchanged."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        _register(type(value))
        for f in dataclasses.fields(value):
            traceable(getattr(value, f.name))
    return value


def _register(cls: type) -> None:
    if cls in _known:
        return
    names = [f.name for f in dataclasses.fields(cls)]
    real = [f.type in (float, "float") for f in dataclasses.fields(cls)]

    def flatten(obj: Any) -> tuple[list[Any], tuple[Any, ...]]:
        values = [getattr(obj, n) for n in names]
        values = [float(v) if is_real and isinstance(v, int) else v for v, is_real in zip(values, real, strict=True)]
        numeric = tuple(_is_numeric(v) for v in values)
        rest = tuple(None if is_n else v for v, is_n in zip(values, numeric, strict=True))
        return [v for v, is_n in zip(values, numeric, strict=True) if is_n], (numeric, rest)

    def unflatten(aux: tuple[Any, ...], children: Any) -> Any:
        numeric, rest = aux
        # Past the constructor, as JAX asks of a pytree: fields may be tracers here, or anything that stands for a leaf,
        # which the constructor's checks would refuse.
        obj, left = object.__new__(cls), iter(children)
        for name, is_n, other in zip(names, numeric, rest, strict=True):
            object.__setattr__(obj, name, next(left) if is_n else other)
        return obj

    jax.tree_util.register_pytree_node(cls, flatten, unflatten)
    _known.add(cls)


def _is_numeric(value: Any) -> bool:
    # Integers shape arrays (heads, ddof), so they are part of the program; anything that is no plain setting is data.
    return not (value is None or isinstance(value, bool | int | str | tuple))
