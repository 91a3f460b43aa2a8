"""Section 0: where the filter acts decides what the agent does; the paper does not say where."""

from __future__ import annotations

import math

import numpy as np

from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.method.bellman import GreedyPath
from uard.method.weights import reciprocal_weight
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.raters import annotator_sigmas
from uard.replication.audit.solutions import SIZES, at_traps, in_words, solved, walk
from uard.replication.verdicts import Part


def checks() -> list[Check]:
    """Return the checks of this section: both descriptions of the annotators."""
    return [_reading("0.main", "main, population SD"), _reading("0.appendix", "appendix, ddof 0")]


def consistent_values(grid: TrapGrid, weight: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the (S, A) values whose backup follows argmax J (reading R5), and whether they settle."""
    task = grid.task()
    reward, onwards = np.asarray(task.reward, float), np.where(task.terminal, 0.0, paper.GAMMA)
    q, rows, residual = np.zeros_like(reward), np.arange(len(reward)), math.inf
    for _ in range(1000):
        new = reward + onwards * q[rows, (q * weight).argmax(1)][task.next_state]
        residual, q = float(np.abs(new - q).max()), new
        if residual < 1e-9:
            break
    return q, residual < 1e-9


def walks(grid: TrapGrid, trap: float, elsewhere: float) -> tuple[dict[str, GreedyPath], bool]:
    """Return the greedy walk by reading, and whether the values of the last reading settle.

    Args:
        grid: The grid.
        trap: sigma_h at traps.
        elsewhere: sigma_h of all other steps.
    """
    weight = reciprocal_weight(paper.BETA * at_traps(grid, trap, elsewhere), paper.LAMBDA)
    raw = solved(grid)
    consistent, settles = consistent_values(grid, weight)
    scores = {
        "raw": raw,
        "T_lambda": solved(grid, weight),
        "acts on J": raw * weight,
        "backs up J's action": consistent * weight,
    }
    return {reading: walk(grid, q) for reading, q in scores.items()}, settles


def _kind(path: GreedyPath) -> str:
    if path.reached_goal:
        return "crosses" if path.total_visits else "solves"
    return "hacks" if path.total_visits else "hovers"


def _table(size: int, by_reading: dict[str, GreedyPath], settles: bool) -> dict[str, float | str]:
    table: dict[str, float | str] = {}
    for reading, path in by_reading.items():
        unsettled = reading == "backs up J's action" and not settles
        table[f"{size}, {reading}"] = in_words(path) + (", values do not settle" if unsettled else "")
        if reading == "acts on J":
            table[f"{size}, {reading}: true return"] = round(paper.STEP_REWARD * len(path.actions), 6)
    return table


def _reading(name: str, annotators: str) -> Check:
    paths = {size: walks(paper_grid(size), *annotator_sigmas()[annotators]) for size in SIZES}

    def grids(reading: str, kind: str) -> int:
        return sum(_kind(by_reading[reading]) == kind for by_reading, _ in paths.values())

    return Check(
        name,
        recomputed={k: v for size, found in paths.items() for k, v in _table(size, *found).items()},
        others={
            "annotators": annotators,
            "lambda": paper.LAMBDA,
            "grids": len(SIZES),
            "solved by T_lambda": grids("T_lambda", "solves"),
            "solved by acting on J": grids("acts on J", "solves"),
            "solved by J's values": grids("backs up J's action", "solves"),
            "hacked by T_lambda": grids("T_lambda", "hacks"),
            "hovered on by acting on J": grids("acts on J", "hovers"),
            "hovered on by J's values": grids("backs up J's action", "hovers"),
        },
        claims=(
            Part(
                "learning by T_lambda avoids and arrives on every grid", lambda n: n["solved by T_lambda"] == n["grids"]
            ),
            Part("acting on J avoids and arrives on every grid", lambda n: n["solved by acting on J"] == n["grids"]),
            Part(
                "backing up the value of J's own action avoids and arrives on every grid",
                lambda n: n["solved by J's values"] == n["grids"],
            ),
        ),
        findings=(
            Part("T_lambda hacks on every grid", lambda n: n["hacked by T_lambda"] == n["grids"]),
            Part("acting on J hovers on every grid", lambda n: n["hovered on by acting on J"] == n["grids"]),
            Part(
                "backing up the value of J's own action does the same on every grid, and does not hack",
                lambda n: {n["solved by J's values"], n["hovered on by J's values"]} == {0, n["grids"]},
            ),
        ),
    )
