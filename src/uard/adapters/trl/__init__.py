"""The filter as a reward function of TRL's GRPO and RLOO trainers.

The callback and its warnings are loaded on first use: they alone need transformers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uard.adapters.trl.advantages import advantage_change, keeps_factor
from uard.adapters.trl.memory import Tally
from uard.adapters.trl.reward import (
    AbsurdScoreWarning,
    Judged,
    UncertaintyDiscountedReward,
    UselessJudgeWarning,
)
from uard.adapters.trl.reward_model import RewardModel
from uard.judges import JudgeError
from uard.judges.doubts import FailedJudgeWarning, LateJudgeWarning, UnscoredWarning
from uard.judges.groups import groups_of

if TYPE_CHECKING:
    from uard.adapters.trl.callback import (
        DiscountCancelledWarning,
        ForgottenWarning,
        ReliabilityCallback,
    )

_OF_CALLBACK = ("DiscountCancelledWarning", "ForgottenWarning", "ReliabilityCallback")

__all__ = [
    "AbsurdScoreWarning",
    "DiscountCancelledWarning",
    "FailedJudgeWarning",
    "ForgottenWarning",
    "JudgeError",
    "Judged",
    "LateJudgeWarning",
    "ReliabilityCallback",
    "RewardModel",
    "Tally",
    "UncertaintyDiscountedReward",
    "UnscoredWarning",
    "UselessJudgeWarning",
    "advantage_change",
    "groups_of",
    "keeps_factor",
]


def __getattr__(name: str) -> Any:
    if name in _OF_CALLBACK:
        from uard.adapters.trl import callback

        return getattr(callback, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
