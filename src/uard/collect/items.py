"""What is rated: a clip of an agent, a text, or two of them side by side. Items are named by what is in them."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from uard import _checks
from uard.ratings.table import LONGEST

KINDS = ("clip", "text", "pair")
LONGEST_TEXT = 100_000  # characters: a page of more is not read by anybody
_MEDIA = re.compile(r"[0-9a-f]{64}\.(webp|npz)")
_ID = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, eq=False)
class Item:
    """Something that people rate. Two items with the same content are the same item.

    Examples:
        >>> item = text_item("What is 2 + 2?", "4")
        >>> item == text_item("What is 2 + 2?", "4"), item == text_item("What is 2 + 2?", "5")
        (True, False)

    Attributes:
        content: What it is, as plain data (JSON); ``clip_item``, ``text_item`` and ``pair_item`` say what of each kind.
    """

    content: Mapping[str, Any]

    def __post_init__(self) -> None:
        """Check that it is plain data of a known kind.

        Raises:
            InvalidValueError: it is not.
        """
        _checks.choose("kind", str(self.content.get("kind")), KINDS)
        object.__setattr__(self, "content", json.loads(self.as_json))

    @property
    def as_json(self) -> str:
        """The content as JSON in one spelling, of which the name is made."""
        try:
            return json.dumps(self.content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise _checks.InvalidValueError("content", self.content, f"plain data without NaN ({error})") from None

    @property
    def id(self) -> str:
        """Its name: 32 hexadecimal digits of the SHA-256 of its content."""
        return hashlib.sha256(self.as_json.encode()).hexdigest()[:32]

    @property
    def kind(self) -> str:
        """One of ``KINDS``."""
        return str(self.content["kind"])

    @property
    def reward(self) -> float | None:
        """What the environment paid, per step of a clip; None where that is not known."""
        value = self.content.get("reward")
        return None if value is None else float(value)

    @property
    def stratum(self) -> str:
        """Which part of the project it belongs to, such as the policy that acted; may be empty."""
        return str(self.content.get("stratum", ""))

    @property
    def media(self) -> tuple[str, ...]:
        """Names of the files that it needs."""
        return tuple(str(self.content[name]) for name in ("sheet", "data") if self.content.get(name))

    def __eq__(self, other: object) -> bool:
        """Whether the other has the same content."""
        return isinstance(other, Item) and self.as_json == other.as_json

    def __hash__(self) -> int:
        """Return a number that equal items share."""
        return hash(self.as_json)


def clip_item(
    sheet: str,
    frames: int,
    columns: int,
    size: tuple[int, int],
    *,
    data: str | None = None,
    fps: float = 20.0,
    reward: float | None = None,
    stratum: str = "",
    key: Any = None,
) -> Item:
    """Return a clip of an agent.

    Examples:
        >>> clip_item("0" * 64 + ".webp", frames=50, columns=8, size=(240, 240), reward=1.0).reward
        1.0

    Args:
        sheet: Name of the picture with all frames, row by row (``uard.collect.sheets``).
        frames: How many, >= 1.
        columns: Frames in a row of the sheet, >= 1.
        size: Width and height of a frame in pixels.
        data: Name of the file with observations, actions and rewards, or None.
        fps: Frames per second, > 0.
        reward: Mean observed reward per step, or None.
        stratum: Such as the policy that acted.
        key: What tells its only step from other state-actions, as plain data; None if nothing does.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    for name, value in (("sheet", sheet), ("data", data)):
        if value is not None and not _MEDIA.fullmatch(value):
            raise _checks.InvalidValueError(name, value, "the SHA-256 of a file with its ending, webp or npz")
    for name, value in (("frames", frames), ("columns", columns), ("width", size[0]), ("height", size[1])):
        _checks.whole(name, value, low=1, high=100_000)
    _checks.number("fps", fps, low=0, high=1000, open_low=True)
    width, height = size
    return Item(
        {"kind": "clip", "sheet": sheet, "data": data, "frames": frames, "columns": columns, "width": width}
        | {"height": height, "fps": float(fps), "reward": _reward(reward), "stratum": _stratum(stratum)}
        | {"key": key}
    )


def text_item(prompt: str, completion: str, *, reward: float | None = None, stratum: str = "") -> Item:
    """Return a completion of a prompt.

    Examples:
        >>> text_item("Say hello", "<b>hello</b>").content["completion"]
        '<b>hello</b>'

    Args:
        prompt: What was asked.
        completion: What was answered; both are shown as they are, markup included.
        reward: What a reward model or a judge said of it, or None.
        stratum: Such as the model that answered.

    Raises:
        InvalidValueError: naming the argument, its value and what is allowed.
    """
    for name, text in (("prompt", prompt), ("completion", completion)):
        _checks.instance(name, text, str, "text")
        if len(text) > LONGEST_TEXT:
            raise _checks.InvalidValueError(f"len({name})", len(text), f"at most {LONGEST_TEXT} characters")
        if any("\ud800" <= c <= "\udfff" for c in text):
            raise _checks.InvalidValueError(
                name, text, "text without halves of surrogate pairs, which no page can show"
            )
    if not completion.strip():
        raise _checks.InvalidValueError("completion", completion, "text that is not empty")
    return Item(
        {"kind": "text", "prompt": prompt, "completion": completion, "reward": _reward(reward)}
        | {"stratum": _stratum(stratum)}
    )


def pair_item(one: str, other: str, *, stratum: str = "") -> Item:
    """Return two items side by side; the same pair, whichever is named first.

    Examples:
        >>> pair_item("0" * 32, "1" * 32) == pair_item("1" * 32, "0" * 32)
        True

    Args:
        one: Name of an item.
        other: Name of another.
        stratum: As for the items.

    Raises:
        InvalidValueError: they are the same, or no names of items.
    """
    for name, value in (("one", one), ("other", other)):
        if not _ID.fullmatch(value):
            raise _checks.InvalidValueError(name, value, "the name of an item, 32 hexadecimal digits")
    if one == other:
        raise _checks.InvalidValueError("other", other, "another item")
    left, right = sorted((one, other))
    return Item({"kind": "pair", "left": left, "right": right, "stratum": _stratum(stratum, 2 * LONGEST + 3)})


def item_of(as_json: str) -> Item:
    """Return the item that ``Item.as_json`` wrote."""
    return Item(cast("dict[str, Any]", json.loads(as_json)))


def _stratum(name: str, most: int = LONGEST) -> str:
    """Return a stratum's name; that of a pair may name those of both sides."""
    _checks.instance("stratum", name, str, "text")
    if len(name) > most or not name.isprintable():
        raise _checks.InvalidValueError("stratum", name, f"at most {most} printable characters")
    return name


def _reward(value: float | None) -> float | None:
    if value is None:
        return None
    _checks.number("reward", value, low=-_checks.LARGEST, high=_checks.LARGEST)
    return float(value)
