"""Published results of the paper's studies (``uard.lab.views.published`` says what that is)."""

from __future__ import annotations

from importlib import resources

from uard.lab.views.published import ResultFiles


def files() -> ResultFiles:
    """Return where they are (entry point of ``uard.results``)."""
    mujoco = ("mujoco-one.json", "mujoco-eight.json", "mujoco.json", "mujoco-drift.json")  # of a cell, the last
    studies = ("grid-deep.json", *mujoco)
    return ResultFiles(resources.files(__name__), studies)
