"""What several studies share: grids, panels, and agents without a mitigation."""

from __future__ import annotations

from uard.agents.tabular import QLearning
from uard.method.mitigations import named

SIZES = (6, 8, 10)  # of the grids
PANELS = ("main", "appendix")
RAW = named("raw")
WALKER = QLearning(heads=1, epsilon=1.0, epsilon_decay=1.0, epsilon_min=1.0)  # moves at random for ever
LOCOMOTION_STEPS = 200_000  # in MuJoCo, on a CPU
