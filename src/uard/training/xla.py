"""How XLA should compile and run our loops on a CPU. It reads all this when JAX starts, so it has to be set before.

*Compile small loops whole.* A training loop over small tables spends its time in starting kernels: about 20 a step,
0.1 us each. XLA can compile a small loop whole, as one native function, but by default only if it touches less than
1 KB. Raising that bound makes the tabular program 20 times faster (0.4 to 8 million steps a second). Loops with matrix
products are never compiled that way.

*One thread.* XLA splits the sums of a matrix product among its threads, one per core that the process may use, and a
sum that is split otherwise is rounded otherwise: PPO and TRPO gave other results on one core, on four and on sixteen.
With one thread a result depends neither on the number of cores nor on whether a worker, which has one core, or the
process itself trains. Several runs fill the cores, a process each.
"""

from __future__ import annotations

import hashlib
import os
import platform
import warnings
from pathlib import Path
from typing import Any

_FLAG = "xla_backend_extra_options"
_BOUND = "xla_cpu_small_while_loop_byte_threshold=10000000"
_THREADS = "NPROC"  # XLA takes so many threads instead of one per core

# Level 1 compiles in two thirds of the default's time and, for these loops, to no slower code.
COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}


_MOST = 1_000_000_000  # bytes of kept programs; what was not used for longest goes first
_WORTH_KEEPING = 0.0  # seconds of compilation: on a simulator, fifty small ones take 2 s together


def keep_programs() -> None:
    """Keep compiled programs on disk, so that a program of half a minute's compilation is compiled once per machine.

    In the user's cache folder, at most ``_MOST`` bytes, unless ``JAX_COMPILATION_CACHE_DIR`` names another folder; left
    out where nothing can be written. A program is native code for the processor that compiled it, so that a home that
    several machines share has a folder for each kind of processor.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "uard" / "xla" / _processor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
    jax.config.update("jax_compilation_cache_max_size", _MOST)


def device_name() -> str:
    """Return how many devices of which kind JAX computes on: "1 x cpu", or the name of a GPU."""
    import jax

    devices = jax.devices()
    return f"{len(devices)} x {devices[0].device_kind}"


def _processor() -> str:
    """Return a short name of this kind of processor: its architecture, and a digest of what it can do."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:  # not Linux
        text = platform.processor()
    features = sorted({line for line in text.splitlines() if line.startswith(("flags", "Features", "model name"))})
    digest = hashlib.sha256("\n".join(features or [text]).encode()).hexdigest()
    return f"{platform.machine()}-{digest[:12]}"


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


def configure() -> None:
    """Set both, the flag only if the user has not set it; warn if JAX has started without."""
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = {_THREADS: "1", "XLA_FLAGS": flags if _FLAG in flags else f"{flags} --{_FLAG}={_BOUND}".strip()}
    if all(os.environ.get(name) == value for name, value in wanted.items()):
        return
    from jax._src import xla_bridge

    if getattr(xla_bridge, "_backends", None):
        warnings.warn(
            "JAX was in use before uard.training was imported; tabular training will be about ten times slower, and "
            "results may differ in the last bits with the number of cores. Import uard.training first.",
            RuntimeWarning,
            stacklevel=3,
        )
        return
    os.environ.update(wanted)
