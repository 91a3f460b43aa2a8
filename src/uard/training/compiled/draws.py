"""Random numbers of many steps at once, laid out so that XLA's compiler for the CPU computes eight of them together.

Threefry-2x32 with 20 rounds [Salmon et al. 2011], bit for bit what ``jax.random.bits`` gives for the same key. JAX
rolls its rounds into a loop, which costs three times as much inside another loop. Steps are the last axis: XLA makes
vectors of the innermost loop only, and a loop over three raters is too short for one.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
_PARITY = 0x1BD11BDA


def words(seed: Array, number: Array, count: int, steps: int) -> Array:
    """Return 32 random bits for each of some steps, (count, steps).

    Examples:
        >>> import jax
        >>> key = jax.random.wrap_key_data(jnp.array([7, 1], jnp.uint32), impl="threefry2x32")
        >>> bool((words(jnp.uint32(7), jnp.uint32(1), 3, 4) == jax.random.bits(key, (4, 3)).T).all())
        True

    Args:
        seed: First half of the key.
        number: Second half of the key.
        count: Words of a step.
        steps: Number of steps.
    """
    step, word = (lax.broadcasted_iota(jnp.uint32, (count, steps), axis) for axis in (1, 0))
    counter = step * jnp.uint32(count) + word
    keys = seed, number, seed ^ number ^ jnp.uint32(_PARITY)
    x, y = jnp.zeros_like(counter) + keys[0], counter + keys[1]
    for i in range(5):
        for turn in _ROTATIONS[i % 2]:
            x = x + y
            y = ((y << turn) | (y >> (32 - turn))) ^ x
        x, y = x + keys[(i + 1) % 3], y + keys[(i + 2) % 3] + jnp.uint32(i + 1)
    return x ^ y


# Giles' single-precision polynomials for the inverse error function, near the centre and in the tails.
_CENTRE = (
    2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503, -0.00417768164,
    0.246640727, 1.50140941,
)  # fmt: skip
_TAIL = (
    -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613, 0.00943887047,
    1.00167406, 2.83297682,
)  # fmt: skip


def normal(bits: Array) -> Array:
    """Turn 32 random bits into a standard normal, never beyond +-5.3, by the inverse of its distribution function.

    The probability keeps 23 bits and lies in the middle of its interval, so that it never rounds to 0 or 1.
    """
    p = ((bits >> 9).astype(jnp.float32) + jnp.float32(0.5)) * jnp.float32(2.0**-23)
    w = -jnp.log(4.0 * p * (1.0 - p))
    tail = w >= 5.0
    w = jnp.where(tail, jnp.sqrt(w) - 3.0, w - 2.5)
    y = jnp.zeros_like(w)
    for centre, far in zip(_CENTRE, _TAIL, strict=True):
        y = y * w + jnp.where(tail, jnp.float32(far), jnp.float32(centre))
    return jnp.float32(np.sqrt(2.0)) * y * (2.0 * p - 1.0)
