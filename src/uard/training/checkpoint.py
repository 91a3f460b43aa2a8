"""Checkpoints: one file that is either whole or not there, and that knows what it is of."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import jax
import numpy as np

from uard import _checks
from uard._support import files

VERSION = 1


class CheckpointError(ValueError):
    """A checkpoint that cannot be gone on from: truncated, altered, or of another configuration."""


def save(path: Path, config: str, state: Any) -> None:
    """Write a pytree of arrays; what was there before stays until the new file is whole.

    Examples:
        >>> import tempfile
        >>> state = {"weights": np.ones(2)}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(Path(folder, "checkpoint"), "TrapGrid6, seed 0", state)
        ...     load(Path(folder, "checkpoint"), "TrapGrid6, seed 0", like=state)["weights"].tolist()
        [1.0, 1.0]

    Args:
        path: Its folder is made.
        config: What the run is, as one line of text; ``load`` refuses another one.
        state: Leaves that are arrays.

    Raises:
        InvalidValueError: a configuration of several lines.
        FloatingPointError: a leaf holds NaN or infinity; nothing is written then.
    """
    if "\n" in config:
        raise _checks.InvalidValueError("config", config, "one line of text")
    leaves = {
        jax.tree_util.keystr(place): np.asarray(leaf) for place, leaf in jax.tree_util.tree_leaves_with_path(state)
    }
    for name, leaf in leaves.items():
        if np.issubdtype(leaf.dtype, np.floating) and not np.isfinite(leaf).all():
            raise FloatingPointError(f"{name} holds NaN or infinity; {path} was not written")
    body = io.BytesIO()
    # No names: a member's place says what it is, and zip files do not like brackets.
    np.savez(body, *leaves.values())
    data = body.getvalue()
    head = f"uard checkpoint {VERSION}\n{config}\n{hashlib.sha256(data).hexdigest()}\n".encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(path) as file:
        file.write(head)
        file.write(data)


def load(path: Path, config: str, like: Any) -> Any:
    """Read what ``save`` wrote.

    Examples:
        >>> import tempfile
        >>> state = {"weights": np.ones(2)}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(Path(folder, "checkpoint"), "TrapGrid6, seed 0", state)
        ...     load(Path(folder, "checkpoint"), "TrapGrid6, seed 1", like=state)
        Traceback (most recent call last):
            ...
        uard.training.checkpoint.CheckpointError: ... is of another configuration: TrapGrid6, seed 0, not TrapGrid6, ...

    Args:
        path: The file.
        config: Of the run that is to go on.
        like: A state of the same structure; arrays may differ in the length of their first axis.

    Returns:
        The state, its leaves NumPy arrays.

    Raises:
        CheckpointError: with what is wrong and what to do.
        FileNotFoundError: there is no such file.
    """
    redo = f"; delete {path} to begin again"
    parts = path.read_bytes().split(b"\n", 3)
    if len(parts) < 4 or parts[0] != f"uard checkpoint {VERSION}".encode():
        raise CheckpointError(f"{path} is no checkpoint of this version, or is truncated{redo}")
    if parts[1].decode() != config:
        raise CheckpointError(f"{path} is of another configuration: {parts[1].decode()}, not {config}{redo}")
    if hashlib.sha256(parts[3]).hexdigest().encode() != parts[2]:
        raise CheckpointError(f"{path} is truncated or was altered: its checksum does not match{redo}")
    with np.load(io.BytesIO(parts[3])) as found:
        leaves = [found[f"arr_{i}"] for i in range(len(found.files))]
    old, tree = jax.tree.flatten(like)
    if [_form(x) for x in leaves] != [_form(x) for x in old]:
        raise CheckpointError(f"{path} does not fit this version of the program{redo}")
    return jax.tree.unflatten(tree, leaves)


def _form(x: Any) -> tuple[Any, ...]:
    return np.asarray(x).dtype, np.ndim(x), np.shape(x)[1:]
