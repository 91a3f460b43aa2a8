"""Which jobs are trained together, and in which order."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from functools import lru_cache

from uard.lab.cell import Cell

Job = tuple[Cell, int]  # a cell and a seed


@lru_cache(maxsize=50_000)
def shape_of(cell: Cell) -> tuple[Hashable, float]:
    """Return program and cost: equal programs are likely to share a compiled one, and cost is how long a seed takes."""
    return cell.trainer.program(cell), cell.trainer.cost(cell)


def batches(jobs: Iterable[Job], largest: int | None = None) -> list[list[Job]]:
    """Group jobs that one call can train and that take equally long; the longest groups come first.

    Args:
        jobs: Each once.
        largest: Most jobs of a group, if less than the trainer takes.
    """
    groups: dict[tuple[Hashable, float], list[Job]] = {}
    for job in jobs:
        groups.setdefault(shape_of(job[0]), []).append(job)
    cut = []
    for group in groups.values():
        most = group[0][0].trainer.at_once
        most = most if largest is None else min(most, largest)
        cut += [group[i : i + most] for i in range(0, len(group), most)]
    return sorted(cut, key=lambda batch: -cost_of(batch))


def cost_of(batch: list[Job]) -> float:
    """Return how long a batch takes."""
    return shape_of(batch[0][0])[1] * len(batch)
