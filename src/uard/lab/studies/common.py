"""What several studies share: grids, panels, and agents without a mitigation."""

from __future__ import annotations

from uard.agents.tabular import QLearning
from uard.lab.trainers.base import Trainer
from uard.method.mitigations import Mitigation, named

SIZES = (6, 8, 10)  # of the grids
PANELS = ("main", "appendix")
# Rules that learn from what raters say without weighing it: rivals in every study of a mitigation.
SIMPLE = (
    "mean-of-annotations",
    "median",
    "worst-of-annotations",
    "lcb",
    "min-proxy-mean",
    "min-proxy-median",
    "excess",
)
RAW = named("raw")
WALKER = QLearning(heads=1, epsilon=1.0, epsilon_decay=1.0, epsilon_min=1.0)  # moves at random for ever
LOCOMOTION_STEPS = 200_000  # in MuJoCo, on a CPU


def can_use(mitigation: Mitigation, trainer: Trainer) -> bool:
    """Whether a trainer can give a mitigation all that it asks for.

    Examples:
        >>> from uard.lab.registry import AGENTS, ENVIRONMENTS, trainer
        >>> can_use(named("true-reward"), trainer(AGENTS["ppo"], ENVIRONMENTS["TrapGrid6"]))
        False
    """
    return trainer.knows_truth or not mitigation.reads_truth
