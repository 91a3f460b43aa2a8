"""Mitigations: what reward is learned from, how actions are scored, which score the backup follows."""

from uard.method.feedback import ByRater, Feedback
from uard.method.mitigations.baselines import RatedReward, Raw, Screening, TrueReward
from uard.method.mitigations.discounting import RewardDiscounting, uard_0_1, uard_paper
from uard.method.mitigations.panel_statistics import PanelStatistics
from uard.method.mitigations.pooled import PooledDiscounting, uard
from uard.method.mitigations.protocol import Backup, Evidence, Explanation, LearningSignal, Mitigation
from uard.method.mitigations.registry import NAMED, fault, named
from uard.method.mitigations.robust import ExcessDisagreement, LogMeanExp, MeanLessVariance, RaterCap
from uard.method.mitigations.witness import Witness

__all__ = [
    "NAMED",
    "Backup",
    "ByRater",
    "Evidence",
    "ExcessDisagreement",
    "Explanation",
    "Feedback",
    "LearningSignal",
    "LogMeanExp",
    "MeanLessVariance",
    "Mitigation",
    "PanelStatistics",
    "PooledDiscounting",
    "RatedReward",
    "RaterCap",
    "Raw",
    "RewardDiscounting",
    "Screening",
    "TrueReward",
    "Witness",
    "fault",
    "named",
    "uard",
    "uard_0_1",
    "uard_paper",
]
