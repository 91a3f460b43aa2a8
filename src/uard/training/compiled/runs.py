"""Many runs in one compiled program.

A *lane* is one run as data: environment, agent, mitigation, seed. ``train`` runs any number of lanes one after the
other inside one program (``lax.fori_loop``), which on a CPU beats stepping them side by side: a lane's arrays stay in
the cache and no lane waits for another. On a GPU, which one small run cannot fill, they are stepped side by side
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

Run = Callable[[Any, Any], Any]  # (lane, program) -> a NamedTuple of arrays


def train(lanes: list[Any], run: Run, program: Any, fields: tuple[str, ...], room: int) -> list[dict[str, Any]]:
    """Run all lanes, which must agree in everything that is not a number, and return the asked-for fields of each.

    Args:
        lanes: Pytrees of one structure.
        run: Trains one lane.
        program: Second argument of ``run``; hashable.
        fields: Which fields of what ``run`` returns.
        room: The program has room for a multiple of this many lanes: fewer are no reason to compile again.
    """
    filled = lanes + [lanes[-1]] * (-(-len(lanes) // room) * room - len(lanes))
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x, narrow(x)) for x in leaves]), *filled)
    if jax.default_backend() != "cpu":
        out = side_by_side(stacked, run, program, fields)
    else:
        out = one_by_one(stacked, np.int32(len(lanes)), run, program, fields)
    host = jax.tree.map(np.asarray, out)
    return [jax.tree.map(lambda value, i=i: value[i], host) for i in range(len(lanes))]


def narrow(x: Any) -> Any:
    """Return the type in which a number is given to a program."""
    dtype = np.asarray(x).dtype
    return np.float32 if dtype == np.float64 else np.int32 if dtype == np.int64 else dtype


def signature(one: Any) -> str:
    """Lanes with equal signatures can be trained by one program."""
    leaves, tree = jax.tree.flatten(one)
    return f"{tree} {[np.shape(x) for x in leaves]}"


def _each(lanes: Any, count: Array, run: Run, program: Any, fields: tuple[str, ...]) -> dict[str, Any]:
    def pick(i: Array) -> dict[str, Any]:
        outcome = run(jax.tree.map(lambda x: x[i], lanes), program)._asdict()
        return {name: outcome[name] for name in fields}

    room = jax.tree.leaves(lanes)[0].shape[0]
    shapes = jax.eval_shape(pick, jnp.int32(0))
    out = jax.tree.map(lambda s: jnp.zeros((room, *s.shape), s.dtype), shapes)

    def body(i: Array, acc: dict[str, Any]) -> dict[str, Any]:
        return jax.tree.map(lambda a, x: lax.dynamic_update_index_in_dim(a, x, i, 0), acc, pick(i))

    return lax.fori_loop(0, count, body, out)


def _abreast(lanes: Any, run: Run, program: Any, fields: tuple[str, ...]) -> dict[str, Any]:
    outcome = jax.vmap(lambda lane: run(lane, program))(lanes)._asdict()
    return {name: outcome[name] for name in fields}


_FIXED = ("run", "program", "fields")
one_by_one = jax.jit(_each, static_argnames=_FIXED, compiler_options=COMPILER_OPTIONS)
side_by_side = jax.jit(_abreast, static_argnames=_FIXED)
