"""uard: reinforcement learning that survives rewards that cannot be fully trusted.

The names below are the method. They load on first use, and none of them needs JAX or torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from uard._support import moved
from uard._version import __version__

if TYPE_CHECKING:
    from uard._checks import InvalidValueError, UnknownNameError
    from uard.diagnosis import Diagnosis, Finding, doctor
    from uard.method.abstention import Abstention
    from uard.method.mitigations import Evidence, Feedback, LearningSignal, Mitigation, RewardDiscounting
    from uard.method.uncertainty import sigma_human, sigma_model
    from uard.method.weights import ReliabilityFilter, discount, total_uncertainty
    from uard.ratings.log import RatingLog

_HOME = {
    "InvalidValueError": "_checks",
    "UnknownNameError": "_checks",
    "Abstention": "method.abstention",
    "Diagnosis": "diagnosis",
    "Finding": "diagnosis",
    "doctor": "diagnosis",
    "RatingLog": "ratings.log",
    "Evidence": "method.mitigations",
    "Feedback": "method.mitigations",
    "LearningSignal": "method.mitigations",
    "Mitigation": "method.mitigations",
    "RewardDiscounting": "method.mitigations",
    "ReliabilityFilter": "method.weights",
    "discount": "method.weights",
    "total_uncertainty": "method.weights",
    "sigma_human": "method.uncertainty",
    "sigma_model": "method.uncertainty",
}

__all__ = [
    "Abstention",
    "Diagnosis",
    "Evidence",
    "Feedback",
    "Finding",
    "InvalidValueError",
    "LearningSignal",
    "Mitigation",
    "RatingLog",
    "ReliabilityFilter",
    "RewardDiscounting",
    "UnknownNameError",
    "__version__",
    "discount",
    "doctor",
    "sigma_human",
    "sigma_model",
    "total_uncertainty",
]

moved.install()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'uard' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"uard.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
