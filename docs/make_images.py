"""Draws the pictures that README and docs show, from real training: ``.venv/bin/python docs/make_images.py``."""

from pathlib import Path

from uard.lab import studies
from uard.lab.execution import runner
from uard.lab.execution.store import Store
from uard.lab.views.study_results import StudyResults
from uard.replication import figures


def main() -> None:
    """Train seed 0 of the scale study and draw the walks."""
    (study,) = studies.find(("scale",))
    store = Store(":memory:")
    runner.run(study.jobs([0]), store, workers=1)
    figure = figures.walks(StudyResults(store, [0], [study]))
    figure.savefig(Path(__file__).parent / "images" / "walks.png", dpi=80, bbox_inches="tight")


if __name__ == "__main__":
    main()
