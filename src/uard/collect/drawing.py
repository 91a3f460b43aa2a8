"""Pictures of any Gymnasium environment, on a machine without a screen, too."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import UInt8

MODE = "rgb_array"
_LARGE = 256  # pixels, as of a sheet's frames
_DRAW = "import mujoco; context = mujoco.GLContext(16, 16); context.make_current(); context.free()"
_HELP = (
    "MuJoCo draws without a screen by EGL or OSMesa. Install one of them (Debian and Ubuntu: `apt install libegl1 "
    "libgl1-mesa-dri`, or `libosmesa6`) and set the environment variable MUJOCO_GL to egl or osmesa"
)


def check(env: gymnasium.Env[Any, Any]) -> None:
    """Check that an environment draws pictures.

    Examples:
        >>> import uard.envs
        >>> check(gymnasium.make("uard/TrapGrid6-v0", render_mode="ansi"))
        Traceback (most recent call last):
            ...
        uard._checks.InvalidValueError: render_mode = 'ansi': must be 'rgb_array', as in gymnasium.make(..., ...

    Args:
        env: An environment.

    Raises:
        InvalidValueError: it was made with another render mode, or has no pictures at all.
    """
    if env.render_mode == MODE:
        return
    modes = [str(mode) for mode in env.metadata.get("render_modes") or ()]
    if MODE in modes:
        allowed = f"{MODE!r}, as in gymnasium.make(..., render_mode={MODE!r})"
    else:
        name = "this environment" if env.spec is None else env.spec.id
        allowed = f"{MODE!r}, but {name} draws no pictures (it has {', '.join(modes) or 'no way to be seen'})"
    raise _checks.InvalidValueError("render_mode", env.render_mode, allowed)


def find_library(env: gymnasium.Env[Any, Any]) -> None:
    """Let MuJoCo draw without a screen: MUJOCO_GL is set to what works here, if there is no screen and it is not set.

    To be called before the environment's first ``reset``; others than MuJoCo's are left alone.

    Examples:
        >>> import uard.envs
        >>> find_library(gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array"))

    Args:
        env: An environment.
    """
    uses = "mujoco" in sys.modules or any(hasattr(env.unwrapped, name) for name in ("mujoco_renderer", "_simulator"))
    if not uses or "MUJOCO_GL" in os.environ or _has_screen():
        return
    found = _without_screen()
    if found is None:
        return
    os.environ["MUJOCO_GL"] = found
    for name in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
        if name in sys.modules:  # it has looked already, and found nothing there
            importlib.reload(sys.modules[name])


def simplify(env: gymnasium.Env[Any, Any]) -> None:
    """Let an environment of MuJoCo's draw ten times faster where there is no graphics card; others are left alone.

    Shadows, reflections and soft edges are left out, everywhere, so that pictures are the same everywhere; nothing of
    the physics changes. To be called after ``reset`` and before the first picture.

    Examples:
        >>> import uard.envs
        >>> simplify(gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array"))

    Args:
        env: An environment.
    """
    inner: Any = env.unwrapped
    ours = getattr(inner, "_simulator", None)
    model = next((m for m in (getattr(inner, "model", None), getattr(ours, "_model", None)) if _is_mujoco(m)), None)
    if model is None:
        return
    model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
    model.mat_reflectance[:] = 0
    camera: Any = getattr(inner, "mujoco_renderer", None)
    width, height = getattr(camera, "width", 0), getattr(camera, "height", 0)
    longer = max(width, height)
    if longer > _LARGE:  # a sheet's frames are no larger, and drawing takes time by the pixel
        camera.width, camera.height = (max(1, round(side * _LARGE / longer)) for side in (width, height))


def picture(env: gymnasium.Env[Any, Any], before: tuple[int, ...] | None = None) -> UInt8[np.ndarray, "H W 3"]:
    """Return a picture of an environment as it is now.

    Examples:
        >>> import uard.envs
        >>> env = gymnasium.make("uard/TrapGrid6-v0", render_mode="rgb_array")
        >>> _ = env.reset(seed=0)
        >>> picture(env).shape
        (400, 400, 3)

    Args:
        env: An environment that was reset.
        before: Shape of the pictures before it, which it must have, too; None if it is the first.

    Raises:
        InvalidValueError: it cannot draw here, draws no picture, or one of another size.
    """
    try:
        found: Any = env.render()
    except Exception as error:  # of libraries of graphics, of which each has its own
        help_ = f". {_HELP}" if "mujoco" in sys.modules and before is None else ""
        told = f"{type(error).__name__}: {error}".strip()
        raise _checks.InvalidValueError("render()", told, f"a picture, and the environment failed{help_}") from error
    shape: tuple[int, ...] = getattr(found, "shape", ())
    kind: Any = getattr(found, "dtype", None)
    if type(found) is not np.ndarray or kind != np.uint8 or len(shape) != 3 or shape[2] != 3 or 0 in shape:
        plain: object = cast("object", found) if isinstance(found, str | None) else f"a {type(found).__name__}"
        what = plain if kind is None else f"{kind} {shape}"
        raise _checks.InvalidValueError("render()", what, "a picture, an array (H, W, 3) of uint8")
    if before is not None and shape != before:
        raise _checks.InvalidValueError("render().shape", shape, f"{before}, as in the pictures before")
    return found


def speed(env: gymnasium.Env[Any, Any], fps: float | None) -> float:
    """Return how many frames a second show an environment in its own time, at most 30; ``fps`` if that is given.

    Examples:
        >>> import uard.envs
        >>> speed(gymnasium.make("uard/TrapGrid6-v0"), None)
        8.0
    """
    if fps is None:
        own = env.metadata.get("render_fps")
        return float(min(own, 30.0)) if isinstance(own, int | float) and own > 0 else 20.0
    _checks.number("fps", fps, low=0, high=1000, open_low=True)
    return float(fps)


def _is_mujoco(model: Any) -> bool:
    return hasattr(model, "mat_reflectance") and hasattr(getattr(model, "vis", None), "quality")


def _has_screen() -> bool:
    return not sys.platform.startswith("linux") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


def _without_screen() -> str | None:
    """Return what MuJoCo can draw with here; tried in another process, for a library that failed stays loaded."""
    if importlib.util.find_spec("mujoco") is None:
        return None
    for name in ("egl", "osmesa"):
        try:
            tried = subprocess.run(
                [sys.executable, "-c", _DRAW], env=os.environ | {"MUJOCO_GL": name}, capture_output=True, timeout=60
            )
        except (OSError, subprocess.TimeoutExpired):
            continue
        if tried.returncode == 0:
            return name
    return None
