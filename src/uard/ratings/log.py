"""A log of rewards and ratings as one table: a row per step, a column per rater."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uard import _checks

if TYPE_CHECKING:
    from jaxtyping import Float, Integer, Shaped

NUMBERS = ("sigma_m", "true_reward")
LABELS = ("item", "episode", "step")


class Repeats(NamedTuple):
    """Earlier answers of raters who have rated something more than once; the last answer is the rating.

    Attributes:
        row: The rows of the log, counted from 0.
        rater: The columns of the log.
        rating: What the rater said there before, in reward units, in the order in which it was said.
    """

    row: Integer[np.ndarray, " r"]
    rater: Integer[np.ndarray, " r"]
    rating: Float[np.ndarray, " r"]


@dataclass(frozen=True, eq=False)
class RatingLog:
    """Rewards and people's ratings of them, one row per step.

    Examples:
        >>> log = RatingLog(np.array([0.0, 4.0]), np.array([[0.1, 0.0], [-1.0, 2.0]]), episode=np.array(["a", "a"]))
        >>> len(log), log.raters, log.place(1)
        (2, ('rating_1', 'rating_2'), 'row 2 (episode a)')

    Attributes:
        reward: Observed rewards, n >= 1, NaN where one is missing; None if the log holds none.
        ratings: Ratings in the reward's unit; NaN where one is missing. K = 0 if nobody rates.
        raters: Names of the K annotators; ``rating_1`` and so on if left out.
        sigma_m: Ensemble disagreement in the reward's unit, >= 0, or None.
        true_reward: What each step was really worth, or None.
        item: What was rated, or None where every row is another thing.
        episode: Name of each row's episode, or None.
        step: Name of each row's step, or None.
        by: Name of the part of the log that each row belongs to, or None.
        source: Where the log is from.
        repeats: Earlier answers of raters who rated a row more than once, or None.
    """

    reward: Float[np.ndarray, " n"] | None
    ratings: Float[np.ndarray, "n K"]
    raters: tuple[str, ...] = ()
    sigma_m: Float[np.ndarray, " n"] | None = None
    true_reward: Float[np.ndarray, " n"] | None = None
    item: Shaped[np.ndarray, " n"] | None = None
    episode: Shaped[np.ndarray, " n"] | None = None
    step: Shaped[np.ndarray, " n"] | None = None
    by: Shaped[np.ndarray, " n"] | None = None
    source: str = "log"
    repeats: Repeats | None = None

    def __post_init__(self) -> None:
        """Check shapes, that no sigma_m is negative, and that repeats are of rows and raters that are there.

        Raises:
            InvalidValueError: naming the column, its shape or the row, and what is allowed.
        """
        ratings = _checks.as_numpy("ratings", self.ratings)
        reward = None if self.reward is None else _checks.as_numpy("reward", self.reward)
        if reward is not None and (reward.ndim != 1 or not reward.size):
            raise _checks.InvalidValueError("reward.shape", reward.shape, "(n,) with at least one row")
        if ratings.ndim != 2 or not len(ratings) or (reward is not None and len(ratings) != len(reward)):
            rows, of = ("n >= 1", "row") if reward is None else (len(reward), "reward")
            raise _checks.InvalidValueError("ratings.shape", ratings.shape, f"({rows}, K), a row per {of}")
        raters = tuple(self.raters) or tuple(f"rating_{k + 1}" for k in range(ratings.shape[1]))
        if len(raters) != ratings.shape[1]:
            raise _checks.InvalidValueError("raters", raters, f"{ratings.shape[1]} names, one per column of ratings")
        checked: dict[str, Any] = {"reward": reward, "ratings": ratings, "raters": raters}
        for name in (*NUMBERS, *LABELS, "by"):
            column = getattr(self, name)
            if column is not None:
                column = _checks.as_numpy(name, column) if name in NUMBERS else np.asarray(column)
                if column.shape != (len(ratings),):
                    raise _checks.InvalidValueError(f"{name}.shape", column.shape, f"({len(ratings)},), one per row")
                checked[name] = column
        if "sigma_m" in checked and (checked["sigma_m"] < 0).any():
            row = int(np.argmax(checked["sigma_m"] < 0))
            raise bad_cell(self.source, row, "sigma_m", float(checked["sigma_m"][row]), "a number >= 0")
        if self.repeats is not None:
            _check_repeats(self.repeats, ratings.shape)
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.ratings)

    def place(self, row: int) -> str:
        """Name a row, counted here from 0: ``row 7 (episode 2, step 3)``, or by its item if it has neither."""
        named = [n for n in ("episode", "step") if getattr(self, n) is not None]
        named = named or (["item"] if self.item is not None else [])
        labels = [f"{n} {getattr(self, n)[row]}" for n in named]
        return f"row {row + 1}" + (f" ({', '.join(labels)})" if labels else "")


def _check_repeats(repeats: Repeats, shape: tuple[int, ...]) -> None:
    for name, values, size in (("row", repeats.row, shape[0]), ("rater", repeats.rater, shape[1])):
        if values.shape != repeats.rating.shape or ((values < 0) | (values >= size)).any():
            allowed = f"as many as there are earlier answers ({len(repeats.rating)}), each in 0..{size - 1}"
            raise _checks.InvalidValueError(f"repeats.{name}", values, allowed)


def bad_cell(source: str, row: int, column: str, value: object, allowed: str) -> _checks.InvalidValueError:
    """Return the error of a cell that holds no number.

    Examples:
        >>> str(bad_cell("log.csv", 6, "reward", "high", allowed="a number"))
        "log.csv: row 7, column 'reward' = 'high': must be a number"

    Args:
        source: What the log is called.
        row: Counted from 0.
        column: Name of the column.
        value: What the cell holds.
        allowed: What it may hold.
    """
    return _checks.InvalidValueError(f"{source}: row {row + 1}, column {column!r}", value, allowed)
