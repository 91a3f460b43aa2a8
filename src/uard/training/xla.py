"""How XLA should compile our loops on a CPU.

A training loop over small tables spends its time in starting kernels: about 20 a step, 0.1 us each. XLA can compile
a small loop whole, as one native function, but by default only if it touches less than 1 KB. Raising that bound makes
the tabular program 20 times faster (0.4 to 8 million steps a second). The bound is read when JAX starts its backend,
so it has to be in the environment before that; loops with matrix products are never compiled that way.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

_FLAG = "xla_backend_extra_options"
_BOUND = "xla_cpu_small_while_loop_byte_threshold=10000000"

# Level 1 compiles in two thirds of the default's time and, for these loops, to no slower code.
COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}


def keep_programs() -> None:
    """Keep compiled programs on disk, so that a program of half a minute's compilation is compiled once per machine.

    In the user's cache folder, unless ``JAX_COMPILATION_CACHE_DIR`` names another; left out where nothing can be
    written.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "uard" / "xla"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 2.0)


HELD = 16  # programs that a process keeps
_held: set[Any] = set()


def make_room(program: Any) -> None:
    """Forget all compiled programs when this one would be one too many; call it before a program is compiled.

    A program of a deep agent takes some 1500 memory mappings. Linux allows a process 65 530, and a study of fifty
    programs in one process was ended by "LLVM ERROR: Unable to allocate section memory".
    """
    if program not in _held and len(_held) >= HELD:
        import jax

        jax.clear_caches()
        _held.clear()
    _held.add(program)


def compile_small_loops_whole() -> None:
    """Set the flag, unless the user has set it; warn if JAX's backend has started without it."""
    flags = os.environ.get("XLA_FLAGS", "")
    if _FLAG in flags:
        return
    from jax._src import xla_bridge

    if getattr(xla_bridge, "_backends", None):
        warnings.warn(
            "JAX was in use before uard.training was imported; tabular training will be about ten times slower. "
            "Import uard.training first.",
            RuntimeWarning,
            stacklevel=3,
        )
        return
    os.environ["XLA_FLAGS"] = f"{flags} --{_FLAG}={_BOUND}".strip()
