"""Over-optimisation of learned reward models by GRPO: what a small language model becomes under each rule.

After Coste et al. (2024, arXiv 2310.02743) and Eisenstein et al. (2023, arXiv 2312.09244), small enough for two cores:
five reward models learned from what five annotators prefer, and a language model follows what a rule makes of their
scores. Gold, what answers are really worth, is looked at, and only ``true reward`` is trained on it. Seeds below 1000
are for development: on them learning rate and lengths were chosen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from uard.judges.rules import RULES
from uard.lab.cell import Cell
from uard.lab.language.setting import Grpo, Language
from uard.lab.language.task import CONDITIONS
from uard.lab.result import Result
from uard.lab.study import Row, Study, row
from uard.method.mitigations import named

FIRST_SEED, SEEDS = 1000, 8
STEPS = 50
BIN = 2  # steps of GRPO whose answers are a point of a curve
ALONE = {"one model": "raw", "true reward": "true-reward"}


def _rows() -> Iterator[Row]:
    for condition in CONDITIONS:
        for rule, mitigation in {**ALONE, **RULES}.items():
            cell = Cell(Language(condition), named(mitigation), Grpo(), steps=STEPS)
            yield row(cell, condition=condition, rule=rule)


def curves(cell: Cell, found: Mapping[int, Result]) -> dict[str, Any]:
    """Return what answers were worth along training, seed by seed.

    Args:
        cell: Of the study.
        found: Its results by seed.

    Returns:
        ``divergence``: KL from the start; ``gold``; ``proxy``: the mean of the judges' standardised scores; ``loose``
        and ``length``: words in no clause, and all; each (seeds, points), a point for every two steps.
    """
    size = BIN * cell.agent.batch
    lines = {"gold": 1, "proxy": 2, "loose": 0, "length": 4}
    each = {"divergence": [r.extra["divergence"] for r in found.values()]}
    each |= {name: [r.log[:, column] for r in found.values()] for name, column in lines.items()}
    return {name: np.stack([x.reshape(-1, size).mean(1) for x in seeds]) for name, seeds in each.items()}


def study() -> Study:
    """Return what ``uard reproduce grpo --seeds 8 --first-seed 1000`` runs."""
    return Study("grpo", "GRPO against learned reward models", "", tuple(_rows()), derive=curves)
