"""Judges: several reward functions or reward models, asked together, brought to one scale, and combined.

Needs NumPy alone: neither torch nor JAX nor a trainer.
"""

from uard.judges.asking import Answer, JudgeError, RewardFunction, Scores, as_scores, ask, by_name, check_name
from uard.judges.fitted import Fitted
from uard.judges.fitting import fit
from uard.judges.judge import Judge
from uard.judges.panel import Combined, FittedJudge, JudgePanel
from uard.judges.reward import Counts, Judged, PanelReward
from uard.judges.rules import RULES, rule
from uard.judges.scales import Moments, Scale
from uard.judges.score_log import ScoreLog, read_scores

__all__ = [
    "RULES",
    "Answer",
    "Combined",
    "Counts",
    "Fitted",
    "FittedJudge",
    "Judge",
    "JudgeError",
    "JudgePanel",
    "Judged",
    "Moments",
    "PanelReward",
    "RewardFunction",
    "Scale",
    "ScoreLog",
    "Scores",
    "as_scores",
    "ask",
    "by_name",
    "check_name",
    "fit",
    "read_scores",
    "rule",
]
