"""What is written down of every training episode."""

from __future__ import annotations

LOG = ("trap_visits", "true_return", "observed_return", "goal", "length", "abstained")  # per-episode sums
