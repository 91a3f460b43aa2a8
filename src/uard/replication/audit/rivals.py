"""Section i: the comparisons with EDAC and SUNRISE (G14, G15)."""

from __future__ import annotations

from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.verdicts import Part


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [_counts(), _sunrise()]


def fewest_events(percent: float, decimals: int = 1) -> tuple[int, int]:
    """Return the smallest (remaining, all) counts whose reduction prints as ``percent``."""
    total = 1
    while True:
        for left in range(total + 1):
            if abs(round(100.0 * (1.0 - left / total), decimals) - percent) < 1e-9:
                return left, total
        total += 1


def _counts() -> Check:
    percent = paper.PERCENT["exploits"].value
    left, total = fewest_events(percent)
    return Check(
        "i.counts",
        printed={"reduction %": percent, "spikes named": paper.FIGURES["G14"].number("spikes")},
        recomputed={"EDAC at least": float(total), "UARD then": float(left)},
        findings=(Part("EDAC has more activations than are named", lambda n: n["EDAC at least"] > n["spikes named"]),),
    )


def _sunrise() -> Check:
    figure = paper.FIGURES["G15"]
    spike, gap, below = (figure.number(name) for name in ("SUNRISE above", "gap", "UARD below"))
    left = "UARD's reward if SUNRISE's is 1.4"
    return Check(
        "i.sunrise",
        printed={"SUNRISE above": spike, "gap": gap, "UARD below": below, "ratio above": figure.number("ratio above")},
        recomputed={
            left: round(spike - gap, 9),
            "SUNRISE's reward for five times": gap * 5.0 / 4.0,
            "UARD's reward then": gap / 4.0,
        },
        others={"SUNRISE's reward at UARD's highest": gap + below, "ratio at UARD's highest": (gap + below) / below},
        findings=(
            Part("at the spike that is named UARD's reward is negative", lambda n: n[left] < 0),
            Part("at UARD's highest the ratio is larger", lambda n: n["ratio at UARD's highest"] > n["ratio above"]),
        ),
    )
