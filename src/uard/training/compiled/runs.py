"""Many runs in one compiled program.

A *run* is data: environment, agent, mitigation, seed. ``train`` runs any number of runs one after the
other inside one program (``lax.fori_loop``), which on a CPU beats stepping them side by side: a run's arrays stay in
the cache and no run waits for another. On a GPU, which one small run cannot fill, they are stepped side by side
(``vmap``). Whatever is not a number is fixed when the program is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from uard.training.xla import COMPILER_OPTIONS

TrainOne = Callable[[Any, Any], Any]  # (run, program) -> a NamedTuple of arrays


def train(
    runs: list[Any], train_one: TrainOne, program: Any, fields: tuple[str, ...], room: int
) -> list[dict[str, Any]]:
    """Train all runs, which must agree in everything that is not a number, and return the asked-for fields of each.

    Args:
        runs: Pytrees of one structure.
        train_one: Trains one run.
        program: Second argument of ``train_one``; hashable.
        fields: Which fields of what ``train_one`` returns.
        room: The program has room for a multiple of this many runs: fewer are no reason to compile again.
    """
    filled = runs + [runs[-1]] * (-(-len(runs) // room) * room - len(runs))
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x, narrow(x)) for x in leaves]), *filled)
    if jax.default_backend() != "cpu":
        out = side_by_side(stacked, train_one, program, fields)
    else:
        out = one_by_one(stacked, np.int32(len(runs)), train_one, program, fields)
    host = jax.tree.map(np.asarray, out)
    return [jax.tree.map(lambda value, i=i: value[i], host) for i in range(len(runs))]


def narrow(x: Any) -> Any:
    """Return the type in which a number is given to a program."""
    dtype = np.asarray(x).dtype
    return np.float32 if dtype == np.float64 else np.int32 if dtype == np.int64 else dtype


def signature(one: Any) -> str:
    """Runs with equal signatures can be trained by one program."""
    leaves, tree = jax.tree.flatten(one)
    return f"{tree} {[np.shape(x) for x in leaves]}"


def _one_by_one(runs: Any, count: Array, train_one: TrainOne, program: Any, fields: tuple[str, ...]) -> dict[str, Any]:
    def pick(i: Array) -> dict[str, Any]:
        trained = train_one(jax.tree.map(lambda x: x[i], runs), program)._asdict()
        return {name: trained[name] for name in fields}

    room = jax.tree.leaves(runs)[0].shape[0]
    shapes = jax.eval_shape(pick, jnp.int32(0))
    out = jax.tree.map(lambda s: jnp.zeros((room, *s.shape), s.dtype), shapes)

    def body(i: Array, acc: dict[str, Any]) -> dict[str, Any]:
        return jax.tree.map(lambda a, x: lax.dynamic_update_index_in_dim(a, x, i, 0), acc, pick(i))

    return lax.fori_loop(0, count, body, out)


def _side_by_side(runs: Any, train_one: TrainOne, program: Any, fields: tuple[str, ...]) -> dict[str, Any]:
    trained = jax.vmap(lambda run: train_one(run, program))(runs)._asdict()
    return {name: trained[name] for name in fields}


_FIXED = ("train_one", "program", "fields")
one_by_one = jax.jit(_one_by_one, static_argnames=_FIXED, compiler_options=COMPILER_OPTIONS)
side_by_side = jax.jit(_side_by_side, static_argnames=_FIXED)
