"""Hopper and Walker2d with a reward that lies, rated by people nobody tuned on: every listener beside both references.

Seeds are 100, 101 ...: none below was looked at here. The region in which Hopper and Walker2d crouch was made after
every rule and every model of raters was settled; posture was not.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

from uard.envs.locomotion.locomotion import Locomotion
from uard.envs.locomotion.regions import REGIONS, Crouch
from uard.lab.cell import Cell
from uard.lab.registry import continuous_agents
from uard.lab.studies.common import LOCOMOTION_STEPS, RAW
from uard.lab.study import Row, Study, row
from uard.method.mitigations import named
from uard.ratings.panels import MAIN, Panel, random_panel

FIRST_SEED, SEEDS = 100, 8
RATED = 0.15
RULES = ("uard", "mean-of-annotations", "median", "worst-of-annotations", "min-proxy-median")
MORE = (*RULES, "lcb", "uard-0.1")  # on Hopper
TASKS = (("hopper", "crouch"), ("hopper", "posture"), ("walker2d", "crouch"))
NOISY = ("uard", "mean-of-annotations", "worst-of-annotations", "min-proxy-median")
NOISES = (0.0, 0.1, 0.2, 0.3)  # of the bonus
FIVE = 5
SCALE = 0.5  # of the panels: rewards lie within -2 and 7, a grid's within -1 and 12


@cache
def panels() -> dict[str, Panel]:
    """Return the panel of each robot: the first two of five raters among the random ones with odd seeds above 1000.

    Examples:
        >>> [len(panel.raters) for panel in panels().values()]
        [5, 5]
    """
    drawn = (random_panel(seed, SCALE) for seed in range(1001, 2**31, 2))
    of_five = (panel for panel in drawn if len(panel.raters) == FIVE)
    return {robot: next(of_five) for robot in ("hopper", "walker2d")}


def _cell(environment: Locomotion, mitigation: Any, panel: Panel, noise: float = 0.0) -> Cell:
    agent = continuous_agents(small=True)["ppo"]
    return Cell(environment, mitigation, agent, panel, noise, RATED, steps=LOCOMOTION_STEPS)


def _listeners(environment: Locomotion, panel: Panel) -> Iterator[tuple[str, Cell]]:
    for name in MORE if environment.robot == "hopper" else RULES:
        yield name, _cell(environment, named(name), panel)


def _rows() -> Iterator[Row]:
    for robot, region in TASKS:
        place = {"robot": robot, "region": region}
        lies = Locomotion(robot, region=REGIONS[region]())
        honest = Locomotion(robot, region=REGIONS[region](), reference=True)
        yield row(_cell(lies, RAW, MAIN), **place, mitigation="raw", panel="none")
        yield row(_cell(honest, RAW, MAIN), **place, mitigation="true reward", panel="none")
        for name, cell in _listeners(lies, panels()[robot]):
            yield row(cell, **place, mitigation=name, panel="random")
    for name, cell in _listeners(Locomotion("hopper", region=Crouch()), MAIN):
        yield row(cell, robot="hopper", region="crouch", mitigation=name, panel="main")
    for robot, panel in panels().items():
        plain = Locomotion(robot, region=None)
        yield row(_cell(plain, RAW, MAIN), robot=robot, region="none", mitigation="raw", panel="none")
        for name, cell in _listeners(plain, panel):
            yield row(cell, robot=robot, region="none", mitigation=name, panel="random")


def _noise() -> Iterator[Row]:
    region = Crouch()
    for name in NOISY:
        for share in NOISES:
            cell = _cell(Locomotion("hopper", region=region), named(name), MAIN, share * region.bonus)
            yield row(cell, mitigation=name, noise=share)


def studies() -> tuple[Study, ...]:
    """Return what ``uard reproduce robots --first-seed 100 --seeds 8`` runs."""
    return (
        Study("robots", "Robots, raters nobody tuned on", "H4, G6, G7", tuple(_rows())),
        Study("robots-noise", "Robots, noisy raters", "H11, G11", tuple(_noise())),
    )
