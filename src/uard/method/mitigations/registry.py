"""Mitigations by name: ours, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from uard import _checks, plugins
from uard.method.mitigations.baselines import RatedReward, Raw, Screening, TrueReward
from uard.method.mitigations.discounting import uard_0_1, uard_paper
from uard.method.mitigations.pooled import uard
from uard.method.mitigations.protocol import Mitigation
from uard.method.mitigations.robust import ExcessDisagreement, LogMeanExp, MeanLessVariance, RaterCap
from uard.method.mitigations.witness import Witness

NAMED: dict[str, Callable[..., Mitigation]] = {
    "raw": Raw,
    "true-reward": TrueReward,
    "mean-of-annotations": RatedReward,
    "worst-of-annotations": partial(RatedReward, statistic="lowest"),
    "median": partial(RaterCap, cap=False),
    "min-proxy-mean": partial(RaterCap, statistic="mean"),
    "min-proxy-median": RaterCap,
    "excess": ExcessDisagreement,
    "uwo": MeanLessVariance,
    "log-mean-exp": LogMeanExp,
    "witness": Witness,
    "lcb": partial(RatedReward, statistic="bound"),
    "screening": Screening,
    "uard": uard,
    "uard-0.1": uard_0_1,
    "uard-paper": uard_paper,
    "uard-consistent": partial(uard_paper, backup="consistent"),
    "uard-operator": partial(uard_paper, acts_on="reward"),
    "uard-lite": partial(uard_paper, beta=0.0),
    "human-only": partial(uard_paper, alpha=0.0),
    "no-discount": partial(uard_paper, lam=0.0),
    "uard-exponential": partial(uard_paper, form="exponential"),
    "uard-linear": partial(uard_paper, form="linear"),
    "uard-certainty-equivalent": partial(uard_paper, form="certainty-equivalent"),
    "uard-wiener": partial(uard_paper, form="wiener"),
}


def named(name: str, **parameters: Any) -> Mitigation:
    """Return the mitigation of that name, ours or a plugin's (``uard.plugins``), with some parameters changed.

    Examples:
        >>> named("worst-of-annotations")
        RatedReward(statistic='lowest', k=1.0, unrated_weight=1.0)
        >>> named("uard", vetoes=1).vetoes
        1

    Args:
        name: One of ``NAMED``, or what an installed package calls its own.
        parameters: Fields of the mitigation.

    Raises:
        UnknownNameError: with the nearest name.
        InvalidValueError: it has no such parameter, or a value is not allowed.
        PluginError: a plugin that cannot be used.
    """
    _checks.instance("mitigation", name, str, "a name")
    if name in NAMED:
        try:
            return NAMED[name](**parameters)
        except TypeError as error:  # ours raise no other
            raise _checks.InvalidValueError(f"parameters of {name!r}", parameters, f"its fields ({error})") from None
    return plugins.pick("mitigation", name, NAMED, [*NAMED]).make(fault, **parameters)


def fault(value: object) -> str | None:
    """Say what an object must be if it cannot be used as a mitigation; None if it can.

    Examples:
        >>> fault(named("raw")), fault(Raw)
        (None, 'a frozen dataclass that is a Mitigation, and this is a class: Raw(...) makes one')
    """
    return _checks.not_frozen(value, Mitigation)
