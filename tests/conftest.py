from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import quick  # isort: skip  (sets what JAX reads when it is imported)
import shapes  # noqa: F401  isort: skip  (checks the arrays of what is imported of uard after it)
import uard.training  # noqa: F401  isort: skip  (sets XLA's flags, which must come before the first use of JAX)
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import settings

jax.config.update("jax_numpy_dtype_promotion", "strict")

settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=100)
settings.register_profile("explore", deadline=None, max_examples=2000)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], AbstractContextManager[Path]]:
    """Lock a folder that all processes of this test run share: what the first makes in it, the others find."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root

    @contextmanager
    def locked(name: str) -> Iterator[Path]:
        (root / name).mkdir(exist_ok=True)
        with (root / f"{name}.lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield root / name

    return locked


@pytest.fixture
def as_users_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the processes that a test starts the flags and the cache of compiled programs that users have."""
    for name in quick.SETTINGS:
        monkeypatch.delenv(name)


@dataclass(frozen=True)
class Backend:
    """One array library at one precision; ``jit`` compiles what is called."""

    name: str
    kind: Any
    dtype: Any
    jit: bool = False

    def array(self, values: Any) -> Any:
        values = np.asarray(values)
        dtype = self.dtype if values.dtype.kind == "f" else None
        if self.kind is torch.Tensor:
            return torch.tensor(values, dtype=dtype)
        return (jnp if self.kind is jax.Array else np).asarray(values, dtype)

    def tree(self, values: Any) -> Any:
        return jax.tree.map(self.array, values)

    def call(self, function: Any, *arguments: Any) -> Any:
        return (jax.jit(function) if self.jit else function)(*self.tree(arguments))

    def agrees(self, function: Any, *arguments: Any) -> None:
        """Check that the function gives this library's arrays, of this precision, with NumPy's float64 numbers."""
        result, expected = self.call(function, *arguments), function(*arguments)
        for got, want in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
            if type(want) is float and type(got) is float:
                assert got == want
                continue
            assert isinstance(got, self.kind)
            if np.asarray(want).dtype.kind == "f":
                assert got.dtype == self.dtype
            tolerance = 1e-12 if np.finfo(str(got.dtype).removeprefix("torch.")).bits == 64 else 2e-6
            assert tuple(got.shape) == np.shape(want)
            np.testing.assert_allclose(np.asarray(got), want, rtol=tolerance, atol=tolerance)


BACKENDS = (
    Backend("numpy-32", np.ndarray | np.generic, np.float32),
    Backend("jax", jax.Array, np.float32),
    Backend("jax-jit", jax.Array, np.float32, jit=True),
    Backend("torch-32", torch.Tensor, torch.float32),
    Backend("torch-64", torch.Tensor, torch.float64),
)


@pytest.fixture(params=BACKENDS, ids=lambda b: b.name)
def backend(request: pytest.FixtureRequest) -> Backend:
    return request.param
