"""All frames of a clip in one picture: a sprite sheet, row by row, as WebP.

A page loads one file per clip and shows any frame of it at once; a video would need a codec, and could not be stepped.
"""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import UInt8

MOST_FRAMES = 1024  # 32 x 32 of the largest ones
LARGEST_SIDE = 8192  # pixels of a sheet; phones show no larger pictures
_LARGE, _SMALL = 256, 160  # pixels: frames with a longer side above the one or below the other are scaled
_FEW, _SOME = 512, 4096  # colours
# WebP without loss finds repeated tiles if it may look for them; what is rendered has fewer, and is done fast. A
# rendered robot without loss is smaller than with, for sharp edges cost a lossy picture most.
_FORMS: tuple[tuple[float, dict[str, Any]], ...] = (
    (_FEW, {"lossless": True, "quality": 50, "method": 2}),
    (_SOME, {"lossless": True, "quality": 20, "method": 0}),
    (math.inf, {"quality": 85, "method": 2}),
)


class Sheet(NamedTuple):
    """A sprite sheet.

    Attributes:
        data: A WebP file.
        frames: How many there are.
        columns: Frames in a row.
        size: Width and height of a frame in pixels.
    """

    data: bytes
    frames: int
    columns: int
    size: tuple[int, int]


def fitted(frame: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a frame whose longer side has at most 256 pixels: a large one smaller, a small one enlarged.

    Small ones become as large as fits without blur: each pixel a square of whole pixels.

    Examples:
        >>> fitted(np.zeros((480, 360, 3), np.uint8)).shape, fitted(np.zeros((10, 8, 3), np.uint8)).shape
        ((256, 192, 3), (250, 200, 3))

    Args:
        frame: A picture.
    """
    height, width = frame.shape[:2]
    longer = max(height, width)
    if longer < _SMALL:
        return frame.repeat(_LARGE // longer, 0).repeat(_LARGE // longer, 1)
    if longer <= _LARGE:
        return frame
    image = _pillow()
    size = max(1, round(width * _LARGE / longer)), max(1, round(height * _LARGE / longer))
    # The mean of what a pixel covers: of few colours few new ones are made, and lines stay straight.
    return np.asarray(image.fromarray(frame).resize(size, image.Resampling.BOX))


def sheet_of(frames: UInt8[np.ndarray, "T H W 3"]) -> Sheet:
    """Return frames as one picture, about as many in a row as there are rows.

    Frames are ``fitted`` first. Pictures of up to 4096 colours, such as grids, are kept without loss.

    Examples:
        >>> frames = np.zeros((5, 200, 160, 3), np.uint8)
        >>> sheet = sheet_of(frames)
        >>> sheet.frames, sheet.columns, sheet.size, bool((frames_of(*sheet) == frames).all())
        (5, 3, (160, 200), True)

    Args:
        frames: (T, H, W, 3), T in [1, 1024].

    Raises:
        InvalidValueError: they are no such array.
        ModuleNotFoundError: Pillow is not installed; the message says how to get it.
    """
    shape, kind = getattr(frames, "shape", ()), getattr(frames, "dtype", None)
    if len(shape) != 4 or shape[3] != 3 or 0 in shape or shape[0] > MOST_FRAMES or kind != np.uint8:
        allowed = f"an array (T, H, W, 3) of uint8, with T in [1, {MOST_FRAMES}]"
        raise _checks.InvalidValueError("frames", f"{kind} {tuple(shape)}", allowed)
    scaled = np.stack([fitted(frame) for frame in frames])
    count, height, width = scaled.shape[:3]
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    tiles = np.zeros((rows * columns, height, width, 3), np.uint8)
    tiles[:count] = scaled
    whole = tiles.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
    colours = max(_colours(scaled[i]) for i in {0, count // 2, count - 1})
    form = next(form for most, form in _FORMS if colours <= most)
    file = io.BytesIO()
    _pillow().fromarray(whole).save(file, "WEBP", exact=True, **form)
    return Sheet(file.getvalue(), count, columns, (width, height))


def frames_of(data: bytes, frames: int, columns: int, size: tuple[int, int]) -> UInt8[np.ndarray, "T h w 3"]:
    """Return the frames of a sheet.

    Examples:
        >>> sheet = sheet_of(np.zeros((3, 160, 200, 3), np.uint8))
        >>> frames_of(*sheet).shape
        (3, 160, 200, 3)

    Args:
        data: Of the file.
        frames: How many there are.
        columns: Frames in a row.
        size: Width and height of a frame in pixels.

    Raises:
        InvalidValueError: the file is no picture, or not of that many frames.
        ModuleNotFoundError: Pillow is not installed.
    """
    image = _pillow()
    try:
        with image.open(io.BytesIO(data)) as file:
            whole = np.asarray(file.convert("RGB"))
    except (OSError, ValueError) as error:
        raise _checks.InvalidValueError("data", data[:20], f"the bytes of a picture ({error})") from None
    width, height = size
    rows = math.ceil(frames / columns)
    if whole.shape != (rows * height, columns * width, 3):
        allowed = f"{columns * width} x {rows * height}, for {frames} frames of {width} x {height}, {columns} in a row"
        raise _checks.InvalidValueError("sheet", f"{whole.shape[1]} x {whole.shape[0]}", allowed)
    tiles = whole.reshape(rows, height, columns, width, 3).swapaxes(1, 2).reshape(-1, height, width, 3)
    return tiles[:frames]


def _colours(frame: UInt8[np.ndarray, "H W 3"]) -> int:
    plain = frame.astype(np.uint32)
    return len(np.unique(plain[..., 0] << 16 | plain[..., 1] << 8 | plain[..., 2]))


def _pillow() -> Any:
    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise ModuleNotFoundError("clips are kept as pictures: pip install 'uard[collect]'", name="PIL") from None
    return cast("Any", Image)
