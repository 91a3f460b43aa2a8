"""Judges: several reward functions or reward models, asked together and brought to one scale."""

from uard.judges.asking import Answer, Judge, JudgeError, as_scores, ask, by_name, check_name
from uard.judges.scales import Moments, Scale

__all__ = ["Answer", "Judge", "JudgeError", "Moments", "Scale", "as_scores", "ask", "by_name", "check_name"]
