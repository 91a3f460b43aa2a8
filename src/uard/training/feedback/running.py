"""What a tabular learner knows of its raters: running means per state-action (in JAX).

Row [s, a] holds (count, mean rating, mean lowest rating, mean sigma_h, mean observed reward).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from uard.method import uncertainty
from uard.method.mitigations import Feedback

FIELDS = 5


class Summary(NamedTuple):
    """What is kept of one visit's ratings; arrays of one shape."""

    mean: Array
    lowest: Array
    spread: Array


def empty(states: int, actions: int) -> Array:
    """Return the table of a learner that has heard nothing."""
    return jnp.zeros((states, actions, FIELDS), jnp.float32)


def summarise(ratings: Array, ddof: int) -> Summary:
    """Summarise ratings (..., K); with one rater sigma_h is 0 (its alarm is then the proxy's distance)."""
    raters = ratings.shape[-1]
    if raters > ddof and raters > 1:
        spread = uncertainty.sigma_human(ratings, ddof=ddof)
    else:
        spread = jnp.zeros(ratings.shape[:-1], ratings.dtype)
    return Summary(ratings.mean(-1), ratings.min(-1), spread)


def updated(row: Array, summary: Summary, proxy: Array, rated: Array) -> Array:
    """Return a row after one more visit; unchanged where ``rated`` is 0."""
    count = row[..., 0] + rated
    heard = jnp.stack([summary.mean, summary.lowest, summary.spread, proxy], axis=-1)
    share = (rated / jnp.maximum(count, 1.0))[..., None]
    return jnp.concatenate([count[..., None], row[..., 1:] + share * (heard - row[..., 1:])], axis=-1)


def read(rows: Array, raters: int) -> Feedback:
    """Read rows (..., 5) as ``Feedback``."""
    count, mean, lowest, spread, proxy = (rows[..., i] for i in range(FIELDS))
    return Feedback(count, mean, lowest, spread, proxy, jnp.asarray(raters, jnp.float32))
