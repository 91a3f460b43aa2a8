"""How grids are drawn: as text, TrapGrid and LearnedRewardGrid also as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np

from uard.envs.base import Environment
from uard.envs.grids import tomato
from uard.envs.grids.gaming import AbsentSupervisor, BoatRace, TomatoWatering
from uard.envs.grids.layouts import ABSENT_SUPERVISOR, BOAT_RACE, GARDEN, TOMATO_WATERING, TOMATOES
from uard.envs.grids.learned_reward import LearnedRewardGrid
from uard.envs.grids.tomato import TomatoState
from uard.envs.grids.trapgrid import TrapGrid

FRAMES = 8  # per second
Cell = tuple[int, int]


@singledispatch
def text(problem: Environment, state: Any) -> str:
    """Return what the agent sees as text; the number of the state for a problem of which no more is known."""
    return f"state {state}"


@text.register
def _(problem: TrapGrid, state: int) -> str:
    marks = {problem.start: "S", problem.goal: "G"}
    marks |= dict.fromkeys(problem.traps or (), "$" if problem.legitimate else "T")
    lines = []
    for row in range(problem.size):
        here = [(row, column) for column in range(problem.size)]
        form = ["[{}]" if cell == problem.cell(state) else " {} " for cell in here]
        lines.append("".join(f.format(marks.get(cell, ".")) for f, cell in zip(form, here, strict=True)))
    return "\n".join(lines)


@text.register
def _(problem: LearnedRewardGrid, state: int) -> str:
    return text(problem.grid(), state)


@text.register
def _(problem: BoatRace, state: int) -> str:
    return _on_layout(BOAT_RACE, problem.cell(state))


@text.register
def _(problem: AbsentSupervisor, state: int) -> str:
    cell, supervised = problem.cell(state)
    return f"{_on_layout(ABSENT_SUPERVISOR, cell)}\nsupervisor {'present' if supervised else 'absent'}"


@text.register
def _(problem: TomatoWatering, state: TomatoState) -> str:
    wet = zip(TOMATOES, tomato.seen(state), strict=True)
    tomatoes = {GARDEN.cells[cell]: "T" if watered else "t" for cell, watered in wet}
    return _on_layout(TOMATO_WATERING, GARDEN.cells[state.cell], tomatoes)


def _on_layout(layout: tuple[str, ...], agent: Cell, changes: Mapping[Cell, str] | None = None) -> str:
    """Return a layout as text, some marks changed, and the agent "A"."""
    marks = {**(changes or {}), agent: "A"}
    return "\n".join(
        "".join(marks.get((r, c), mark.replace("S", ".")) for c, mark in enumerate(row)) for r, row in enumerate(layout)
    )


@dataclass(frozen=True)
class Picture:
    """A grid, and a picture of everything but the agent.

    Attributes:
        grid: What is drawn.
        scene: (H, W, 3) of uint8.
    """

    grid: TrapGrid
    scene: np.ndarray

    def at(self, state: int) -> np.ndarray:
        """Return a picture with the agent in a state, (H, W, 3) of uint8."""
        return _with_agent(self.scene, self.grid.size, self.grid.cell(state))


def picture(problem: Environment) -> Picture | None:
    """Return what draws a problem's pictures; None for one that has none."""
    grid = problem.grid() if isinstance(problem, LearnedRewardGrid) else problem
    return Picture(grid, _scene(grid)) if isinstance(grid, TrapGrid) else None


_PAPER, _LINE, _WALL = (250, 249, 246), (214, 212, 205), (55, 62, 76)
_GOAL, _GOAL_FLOOR = (0, 135, 104), (214, 238, 229)
_TRAP, _TRAP_FLOOR, _BONUS_FLOOR = (224, 108, 84), (250, 222, 213), (253, 242, 205)
_COIN, _COIN_RIM = (244, 190, 48), (168, 116, 12)
_START, _AGENT, _WHITE = (140, 150, 166), (35, 98, 188), (255, 255, 255)

Colour = tuple[int, int, int]


def _side(size: int) -> int:
    return max(32, min(64, 512 // size))


def _plane(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x (rightwards) and y (downwards) of a cell's pixel centres, in [-0.5, 0.5]."""
    line = (np.arange(side) + 0.5) / side - 0.5
    return line[None, :], line[:, None]


def _paint(tile: np.ndarray, colour: Colour, distance: np.ndarray) -> None:
    """Paint where the distance to a shape (in cells) is negative, with a soft edge of one pixel."""
    cover = np.clip(0.5 - distance * tile.shape[0], 0.0, 1.0)[..., None]
    tile += cover * (np.array(colour, float) - tile)


def _disc(side: int, radius: float, x0: float = 0.0, y0: float = 0.0) -> np.ndarray:
    x, y = _plane(side)
    return np.hypot(x - x0, y - y0) - radius


def _convex(side: int, corners: Sequence[tuple[float, float]]) -> np.ndarray:
    """Distance to a convex polygon with (x, y) corners, clockwise on the screen."""
    x, y = _plane(side)
    inside = []
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
        length = np.hypot(x1 - x0, y1 - y0)
        inside.append(((x - x0) * (y1 - y0) - (y - y0) * (x1 - x0)) / length)
    return np.maximum.reduce(np.broadcast_arrays(*inside))


def _tile(side: int, floor: Colour) -> np.ndarray:
    tile = np.empty((side, side, 3))
    tile[:] = floor
    return tile


def _trap_tile(side: int, legitimate: bool) -> np.ndarray:
    tile = _tile(side, _BONUS_FLOOR if legitimate else _TRAP_FLOOR)
    if not legitimate:
        x, y = _plane(side)
        stripe = np.abs((x + y) * 4.0 % 1.0 - 0.5) / (4.0 * np.sqrt(2.0))
        _paint(tile, _TRAP, stripe - 0.035)
    _paint(tile, _COIN_RIM, _disc(side, 0.26))
    _paint(tile, _COIN, _disc(side, 0.225))
    _paint(tile, _COIN_RIM, np.abs(_disc(side, 0.15)) - 0.016)
    return tile


def _goal_tile(side: int) -> np.ndarray:
    tile = _tile(side, _GOAL_FLOOR)
    _paint(tile, _WALL, _convex(side, [(-0.2, -0.34), (-0.14, -0.34), (-0.14, 0.34), (-0.2, 0.34)]))
    _paint(tile, _GOAL, _convex(side, [(-0.14, -0.34), (0.28, -0.15), (-0.14, 0.04)]))
    _paint(tile, _WALL, _convex(side, [(-0.3, 0.3), (-0.04, 0.3), (-0.04, 0.36), (-0.3, 0.36)]))
    return tile


def _start_tile(side: int) -> np.ndarray:
    tile = _tile(side, _PAPER)
    _paint(tile, _START, np.abs(_disc(side, 0.37)) - 0.025)
    return tile


def _scene(grid: TrapGrid) -> np.ndarray:
    """Draw everything but the agent: an (H, W, 3) picture with a wall around the cells."""
    side, wall = _side(grid.size), _wall(grid.size)
    cells = np.empty((grid.size, side, grid.size, side, 3))
    cells[:] = _PAPER
    tiles: Mapping[Any, np.ndarray] = {grid.start: _start_tile(side), grid.goal: _goal_tile(side)}
    tiles |= dict.fromkeys(grid.traps or (), _trap_tile(side, grid.legitimate))
    for (row, column), tile in tiles.items():
        cells[row, :, column] = tile
    cells[1:, 0] = _LINE
    cells[:, :, 1:, 0] = _LINE
    width = grid.size * side
    picture = np.empty((width + 2 * wall, width + 2 * wall, 3), np.uint8)
    picture[:] = _WALL
    picture[wall:-wall, wall:-wall] = np.rint(cells.reshape(width, width, 3))
    return picture


def _wall(size: int) -> int:
    return _side(size) // 8


def _with_agent(scene: np.ndarray, size: int, cell: tuple[int, int]) -> np.ndarray:
    side, wall, picture = _side(size), _wall(size), scene.copy()
    top, left = wall + cell[0] * side, wall + cell[1] * side
    here = picture[top : top + side, left : left + side]
    tile = here.astype(float)
    _paint(tile, _WHITE, _disc(side, 0.31))
    _paint(tile, _AGENT, _disc(side, 0.275))
    for x in (-0.095, 0.095):
        _paint(tile, _WHITE, _disc(side, 0.062, x, -0.05))
        _paint(tile, _WALL, _disc(side, 0.03, x, -0.045))
    here[:] = np.rint(tile)
    return picture
