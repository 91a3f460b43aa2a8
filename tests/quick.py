"""Compiling takes most of a test run: programs that run once are compiled in a third of the time, and kept for others.

It is imported before JAX. ``as_users_compile`` gives the processes of a test what users have.
"""

from __future__ import annotations

import os
from pathlib import Path

SETTINGS = {
    "XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    " --xla_llvm_disable_expensive_passes=true",
    "JAX_COMPILATION_CACHE_DIR": str(Path.home() / ".cache" / "uard" / "xla-tests"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
}
for _name, _value in SETTINGS.items():
    os.environ.setdefault(_name, _value)
