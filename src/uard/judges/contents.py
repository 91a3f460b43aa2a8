"""What tells prompts and completions apart: what is in them, not how they print or where they lie in memory."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Hashable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, fields, is_dataclass
from numbers import Number
from typing import Any, cast

import numpy as np


def content_of(value: Any) -> Hashable:
    """Return a key that two values share if they are of one kind and have the same content.

    Texts, numbers, lists, tuples, sets, dictionaries (in their order) and dataclasses are told apart by what is in
    them, arrays and tensors by kind, shape and numbers, images of Pillow by what they show and are tagged with. Other
    objects are equal if they say so and can be hashed, else each is itself only. What is not sure counts as different.

    Examples:
        >>> one, other = [{"role": "user", "content": "why?"}], [{"role": "user", "content": "why?"}]
        >>> content_of(one) == content_of(other), content_of(1) == content_of(True)
        (True, False)
        >>> long = np.zeros(10_000)
        >>> content_of(long) == content_of(long.copy()), content_of(long) == content_of(long + 1)
        (True, False)

    Args:
        value: Anything.
    """
    if type(value) is str:
        return value
    try:
        return _key(value)
    except Exception:  # of a file that is closed, or a list within itself
        return _Itself(value)


@dataclass(frozen=True, eq=False)
class _Itself:
    """An object that equals nothing else; it is kept, so that no other takes its place in memory."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def _key(value: Any) -> Hashable:
    kind = cast("type[Any]", type(value))
    if kind is str:
        return value
    if value is None or kind is bytes or isinstance(value, int | str):
        return kind, value
    if isinstance(value, list | tuple):
        return (kind, *map(_key, cast("list[Any]", value)))
    if isinstance(value, dict | Mapping):  # of the first nearly all are, and the second takes a while to find out
        mapping = cast("Mapping[Any, Any]", value)
        return (kind, *map(_key, mapping), *map(_key, mapping.values()))
    if isinstance(value, AbstractSet):
        return kind, frozenset(map(_key, cast("AbstractSet[Any]", value)))
    if isinstance(value, np.generic) or hasattr(value, "__dlpack__"):  # which arrays of all libraries have
        return kind, _of_array(value)
    if isinstance(value, Number):
        return kind, repr(value)  # 0.0 equals -0.0, Decimal("1.0") equals Decimal("1.00"), and no NaN equals itself
    if (pillow := sys.modules.get("PIL.Image")) is not None and isinstance(value, pillow.Image):
        return kind, _of_image(value)
    if kind.__eq__ is object.__eq__:
        return _Itself(value)
    if is_dataclass(value):
        return (kind, *[_key(getattr(value, field.name)) for field in fields(value) if field.compare])
    hash(value)
    return kind, value


def _of_array(value: Any) -> Hashable:
    if hasattr(value, "detach"):
        return str(value.dtype), tuple(value.shape), _digest(_bytes_of_tensor(value))
    array = np.asarray(value)
    kind = str(array.dtype), array.shape
    if array.dtype.hasobject:
        return *kind, _key(array.tolist())
    hidden: Any = np.ma.getmaskarray(value) if np.ma.isMaskedArray(value) else None
    return *kind, _digest(array), None if hidden is None else _digest(hidden)


def _bytes_of_tensor(tensor: Any) -> np.ndarray:
    try:
        return tensor.numpy(force=True)
    except TypeError:  # NumPy has no bfloat16
        return tensor.detach().reshape(-1).view(sys.modules["torch"].uint8).numpy(force=True)


def _of_image(image: Any) -> Hashable:
    if getattr(image, "is_animated", False):  # it shows one picture of several
        return _Itself(image)
    palette = image.getpalette() if image.mode in {"P", "PA"} else None
    return image.mode, image.size, _digest(np.asarray(image)), _key(palette), _key(image.info)


def _digest(array: np.ndarray) -> bytes:
    return hashlib.blake2b(array.tobytes(), digest_size=32).digest()
