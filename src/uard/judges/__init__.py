"""Judges: several reward functions or reward models, asked together and brought to one scale."""

from uard.judges.asking import Judge, JudgeError, as_scores, ask, by_name
from uard.judges.scales import Scale

__all__ = ["Judge", "JudgeError", "Scale", "as_scores", "ask", "by_name"]
