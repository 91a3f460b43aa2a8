"""Rules by which the scores of judges become one reward, by the names that they have where judges are combined."""

from __future__ import annotations

from typing import Any

from uard import _checks
from uard.method.mitigations import Mitigation, named

RULES = {
    "uard": "uard",
    "mean": "mean-of-annotations",
    "median": "median",
    "lowest": "worst-of-annotations",
    "uwo": "uwo",
    "log-mean-exp": "log-mean-exp",
    "lcb": "lcb",
}
"""Name of a rule -> name of the mitigation that it is. ``lowest`` is WCO, ``uwo`` mean less variance (Coste et al.
2024, arXiv 2310.02743). The geometric median of K numbers is their median, so no rule has that name."""


def rule(name: str, **parameters: Any) -> Mitigation:
    """Return the rule of that name, with some parameters changed.

    Examples:
        >>> rule("uwo", k=1.0)
        MeanLessVariance(k=1.0)

    Args:
        name: One of ``RULES``.
        parameters: Fields of the mitigation.

    Raises:
        UnknownNameError: with the nearest name.
        InvalidValueError: it has no such parameter, or a value is not allowed.
    """
    return named(RULES[_checks.choose("rule", name, RULES)], **parameters)


def name_of_rule(value: Mitigation) -> str:
    """Return what a rule is called here; one with parameters of its own as it prints.

    Examples:
        >>> name_of_rule(rule("lowest")), name_of_rule(rule("uwo", k=1.0))
        ('lowest', 'MeanLessVariance(k=1.0)')
    """
    return next((name for name in RULES if rule(name) == value), repr(value))


def check_rule(value: object) -> Mitigation:
    """Return a rule, given by its name or as the mitigation that it is.

    Examples:
        >>> check_rule("median") == check_rule(rule("median"))
        True

    Raises:
        UnknownNameError: with the nearest name.
        InvalidValueError: a mitigation that is none of ``RULES``.
    """
    if isinstance(value, str):
        return rule(value)
    kinds = {type(named(name)) for name in RULES.values()}
    if type(value) not in kinds:
        raise _checks.InvalidValueError("rule", value, f"one of {', '.join(RULES)}, or rule(name, ...)")
    assert isinstance(value, Mitigation)
    return value
