"""Raters whom nobody has tuned anything on: random panels on random grids and random MDPs.

Scenario n is ``random_grid(n)`` or ``RandomMDP(seed=n)``, rated by ``random_panel(n)`` on ``random_share(n)`` of the
steps. Scenarios of the study ``panels-development`` may be tuned on (``is_for_development``); those of ``panels``,
which are reported, may not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from uard.envs.base import TableEnvironment
from uard.envs.grids.random_tasks import RandomMDP, random_grid
from uard.lab.cell import Cell
from uard.lab.studies.common import RAW, SIMPLE, WALKER
from uard.lab.study import LazyRows, Row, Study, row
from uard.method.mitigations import Mitigation, named
from uard.ratings.panels import Panel, random_panel, random_share

OURS, ONE_VETO = "uard", "uard, 1 veto"
OWN = (OURS, ONE_VETO, "uard-0.1", "uard-paper")  # forms of ours, which are no rivals of it
ORACLE, FLOOR = "true-reward", "random walk"  # between which regret is measured
RIVALS = ("raw", *SIMPLE, "witness", "uard-0.1", "uard-paper")
GRIDS, MDPS = "random grids", "random MDPs"
SCALE = 0.3
"""Of a panel that rates a random MDP. Biases, noise and ranges of ``random_panel`` are in units of a grid whose goal
pays 10; the largest reward that is meant of a random MDP is a prize of 3."""
PUBLISHED = ("true_return", "hacks", "success_rate")


class Scenario(NamedTuple):
    """A task and who rates it.

    Attributes:
        environment: The task.
        panel: Who rates.
        rated: Share of the steps that the panel is asked about.
    """

    environment: TableEnvironment
    panel: Panel
    rated: float


def scenario(tasks: str, seed: int) -> Scenario:
    """Draw a scenario.

    Examples:
        >>> drawn = scenario(GRIDS, 7)
        >>> drawn.environment.size, len(drawn.panel.raters), drawn.rated
        (9, 7, 1.0)

    Args:
        tasks: ``GRIDS`` or ``MDPS``.
        seed: Of the task, the panel and the share.
    """
    if tasks == MDPS:
        return Scenario(RandomMDP(seed=seed), random_panel(seed, SCALE), random_share(seed))
    return Scenario(random_grid(seed), random_panel(seed), random_share(seed))


def mitigations() -> dict[str, Mitigation]:
    """Return what is compared, and the oracle, by the study's labels."""
    rivals = {name: named(name) for name in (*RIVALS, ORACLE)}
    return rivals | {OURS: named(OURS), ONE_VETO: named(OURS, vetoes=1)}


def rows(seeds: Sequence[tuple[str, int]]) -> tuple[Row, ...]:
    """Return all mitigations and the random walk in every scenario.

    Args:
        seeds: Scenarios as ``scenario`` takes them.
    """
    compared, made = mitigations(), []
    for tasks, seed in seeds:
        environment, panel, rated = scenario(tasks, seed)
        cells = {name: Cell(environment, m, panel=panel, rated=rated) for name, m in compared.items()}
        cells[FLOOR] = Cell(environment, RAW, WALKER)
        made += [row(cell, tasks=tasks, scenario=seed, mitigation=name) for name, cell in cells.items()]
    return tuple(made)


def studies(development: bool = False) -> tuple[Study, ...]:
    """Return what ``uard reproduce panels`` runs: 200 grids and 100 MDPs; or 60 of each that may be tuned on."""
    if development:
        seeds = [(tasks, seed) for tasks in (GRIDS, MDPS) for seed in range(0, 120, 2)]
        name, title, answers = "panels-development", "Random panels to tune on", "for whoever tunes"
    else:
        seeds = [(GRIDS, seed) for seed in range(1, 400, 2)] + [(MDPS, seed) for seed in range(1, 200, 2)]
        name, title, answers = "panels", "Random panels that nothing was tuned on", "generality, held out"
    build: Callable[[], tuple[Row, ...]] = partial(rows, seeds)
    lazy = LazyRows(build, len(seeds) * (len(RIVALS) + 4))  # ours twice, oracle, random walk
    return (Study(name, title, answers, lazy, brief=PUBLISHED, development=development),)
