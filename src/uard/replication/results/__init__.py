"""Published results of the paper's studies (``uard.lab.views.published`` says what that is)."""

from __future__ import annotations

from importlib import resources

from uard.lab.views.published import ResultFiles


def files() -> ResultFiles:
    """Return where they are (entry point of ``uard.results``)."""
    studies = ("grid-deep.json", "mujoco-one.json", "mujoco-eight.json", "mujoco.json")  # of three seeds, the last
    return ResultFiles(resources.files(__name__), studies)
