"""The paper's experiments as data, in the groups in which they are run."""

from __future__ import annotations

from uard.lab.study import Study
from uard.replication.studies import deep, grids, locomotion


def groups() -> dict[str, tuple[Study, ...]]:
    """Return the studies by the name under which they are run together (entry point of ``uard.studies``)."""
    scales = (locomotion.SMOKE, locomotion.STANDARD, locomotion.PAPER)
    sizes = {f"mujoco-{scale.name}": locomotion.studies(scale) for scale in scales}
    return {"grid": grids.studies(), "grid-deep": deep.studies(), **sizes}
