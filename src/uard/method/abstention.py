"""When to defer instead of acting (A42, A43). The paper claims a demonstration and shows none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from uard import _checks
from uard.method.arrays import Array, namespace

Rule = Literal["threshold", "ratio"]
Response = Literal["safe", "ask", "skip"]


def uncertainty_ratio(u: Array, mu: Array, eps: float = 1e-6) -> Array:
    """rho = sigma_total / (|mu| + eps) (A43)."""
    _checks.number("eps", eps, low=0, open_low=True)
    return u / (abs(mu) + eps)


@dataclass(frozen=True)
class Abstention:
    """A rule for abstaining and what is done instead.

    Attributes:
        rule: ``threshold`` compares U with ``limit`` (A42), ``ratio`` compares rho with it (A43).
        limit: The level above which the agent abstains, > 0; in reward units for ``threshold``.
        response: ``safe`` takes the least uncertain action, ``ask`` has the panel rate this step whatever the
            rating budget says, ``skip`` leaves the step out of learning.
        eps: The epsilon of rho.
    """

    rule: Rule = "ratio"
    limit: float = 1.0
    response: Response = "safe"
    eps: float = 1e-6

    def __post_init__(self) -> None:
        """Check the parameters."""
        _checks.choose("rule", self.rule, ("threshold", "ratio"))
        _checks.choose("response", self.response, ("safe", "ask", "skip"))
        _checks.number("limit", self.limit, low=0, open_low=True)
        _checks.number("eps", self.eps, low=0, open_low=True)

    def abstains(self, u: Array, mu: Array) -> Array:
        """Return True where the agent should not act on ``mu`` with total uncertainty ``u``."""
        _checks.nonnegative("u", u)
        _checks.finite("mu", mu)
        level = u if self.rule == "threshold" else uncertainty_ratio(u, mu, self.eps)
        return namespace(level).asarray(level > self.limit) if not hasattr(level, "shape") else level > self.limit
