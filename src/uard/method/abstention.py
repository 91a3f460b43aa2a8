"""When to defer instead of acting (A42, A43). The paper claims a demonstration and shows none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from uard import _checks
from uard.method.arrays import Array, Numbers, namespace

Rule = Literal["threshold", "ratio"]
Response = Literal["safe", "ask", "skip"]


def uncertainty_ratio(u: Numbers, mu: Numbers, eps: float = 1e-6) -> Array:
    """rho = sigma_total / (|mu| + eps) (A43); dimensionless.

    Examples:
        >>> round(uncertainty_ratio(u=1.0, mu=-4.0), 3)
        0.25

    Args:
        u: Total uncertainty U >= 0, in the unit of ``mu``.
        mu: A value or a reward.
        eps: Keeps the ratio finite where ``mu`` is 0; > 0, in the unit of ``mu``.

    Raises:
        InvalidValueError: for an ``eps`` that is not > 0.
    """
    _checks.number("eps", eps, low=0, open_low=True)
    return u / (abs(mu) + eps)


@dataclass(frozen=True)
class Abstention:
    """A rule for abstaining and what is done instead.

    Examples:
        >>> rule = Abstention("threshold", limit=0.5)
        >>> rule.abstains(u=0.7, mu=4.0).item()
        True

    Attributes:
        rule: ``threshold`` compares U with ``limit`` (A42), ``ratio`` compares rho with it (A43).
        limit: The level above which the agent abstains, > 0; in reward units for ``threshold``.
        response: ``safe`` takes the least uncertain action, ``ask`` has the panel rate this step whatever the
            rating budget says, ``skip`` leaves the step out of learning.
        eps: The epsilon of rho, > 0.
    """

    rule: Rule = "ratio"
    limit: float = 1.0
    response: Response = "safe"
    eps: float = 1e-6

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.choose("rule", self.rule, ("threshold", "ratio"))
        _checks.choose("response", self.response, ("safe", "ask", "skip"))
        _checks.number("limit", self.limit, low=0, open_low=True)
        _checks.number("eps", self.eps, low=0, open_low=True)

    def abstains(self, u: Numbers, mu: Numbers) -> Array:
        """Return True where the agent should not act on ``mu`` with total uncertainty ``u``.

        Args:
            u: U >= 0, in the unit of ``mu``.
            mu: A value or a reward, finite.

        Returns:
            Booleans, of the shape that both broadcast to.

        Raises:
            InvalidValueError: for a negative or non-finite U, or a ``mu`` that is not finite.
        """
        _checks.nonnegative("u", u)
        _checks.finite("mu", mu)
        level = u if self.rule == "threshold" else uncertainty_ratio(u, mu, self.eps)
        return level > self.limit if hasattr(level, "shape") else namespace(level).asarray(level > self.limit)
