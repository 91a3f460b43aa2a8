"""Which loop trains which family of agents on a simulator."""

from __future__ import annotations

from collections.abc import Callable

from uard import _checks
from uard.training.host.loop import Job, Loop
from uard.training.host.off_policy import OffPolicyLoop
from uard.training.host.on_policy import OnPolicyLoop

LOOPS: dict[str, Callable[[Job], Loop]] = {"rollout": OnPolicyLoop, "continuous-replay": OffPolicyLoop}


def loop_of(job: Job) -> Loop:
    """Return a run's loop.

    Raises:
        UnknownNameError: the agent is of a family that cannot be trained on a simulator.
    """
    return LOOPS[_checks.choose("agent.family", job.agent.family, LOOPS)](job)
