"""The Reliability Filter: how far a reward may be believed (inventory A19, A24-A37).

Everything here is a pure function of arrays. NumPy, JAX and torch arrays are treated alike, shapes broadcast,
and neither JAX nor torch is imported. Rewards, values, ``mu`` and the sigmas share one unit (the reward's);
weights are dimensionless and lie in (0, 1] unless a docstring says otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uard import _checks
from uard.method.arrays import Array, Numbers, namespace

Form = Literal["reciprocal", "exponential", "linear", "certainty-equivalent", "wiener"]
FORMS: tuple[Form, ...] = ("reciprocal", "exponential", "linear", "certainty-equivalent", "wiener")


def total_uncertainty(sigma_m: Numbers, sigma_h: Numbers, alpha: Numbers = 0.5, beta: Numbers = 0.5) -> Array:
    """U = alpha sigma_m + beta sigma_h (A24; section 3.6.1).

    Examples:
        >>> total_uncertainty(sigma_m=1.0, sigma_h=2.0)
        1.5

    Args:
        sigma_m: Ensemble disagreement, >= 0, any shape.
        sigma_h: Annotator disagreement, >= 0, broadcastable to ``sigma_m``.
        alpha: Weight of ``sigma_m``, a number in [0, 1].
        beta: Weight of ``sigma_h``, a number in [0, 1].

    Returns:
        U >= 0, of the shape that both broadcast to.

    Raises:
        InvalidValueError: for a negative or non-finite sigma, or alpha or beta outside [0, 1].
    """
    _checks.nonnegative("sigma_m", sigma_m)
    _checks.nonnegative("sigma_h", sigma_h)
    _checks.number("alpha", alpha, low=0, high=1)
    _checks.number("beta", beta, low=0, high=1)
    return alpha * sigma_m + beta * sigma_h


def reciprocal_weight(u: Numbers, lam: Numbers = 2.0) -> Array:
    """w = 1 / (1 + lambda U) in (0, 1], the paper's filter (A29, A37).

    Examples:
        >>> reciprocal_weight(u=0.5, lam=2.0)
        0.5

    Args:
        u: Total uncertainty U >= 0.
        lam: lambda >= 0.
    """
    return 1.0 / (1.0 + lam * u)


def exponential_weight(u: Numbers, lam: Numbers = 2.0) -> Array:
    """w = exp(-lambda U) in (0, 1] (A35). Underflows to 0 where lambda U > 87 in float32.

    Examples:
        >>> exponential_weight(u=0.0, lam=2.0)
        1.0

    Args:
        u: Total uncertainty U >= 0.
        lam: lambda >= 0.
    """
    product = lam * u
    return namespace(product).exp(-product) if hasattr(product, "shape") else math.exp(-product)


def linear_weight(u: Numbers, mu: Numbers, lam: Numbers = 2.0) -> Array:
    """w such that w mu = max(0, mu - lambda U) (A34), for mu > 0; in [0, 1].

    The paper prints the product and calls it a weight. For mu <= 0 the product is 0, so w = 0.

    Examples:
        >>> float(linear_weight(u=0.5, mu=4.0, lam=2.0))
        0.75

    Args:
        u: Total uncertainty U >= 0, in the unit of ``mu``.
        mu: What is to be discounted, measured from its anchor.
        lam: lambda >= 0.
    """
    mu = _as_array_like(u, mu)
    xp = namespace(mu)
    left = xp.maximum(mu - lam * u, xp.zeros_like(mu))
    return left / xp.where(mu > 0, mu, xp.ones_like(mu))


def certainty_equivalent_weight(u: Numbers, mu: Numbers, kappa: Numbers = 2.0) -> Array:
    """w = 1 / (1 + kappa U^2 / (2 mu)) (A28), for mu > 0; 0 for mu <= 0.

    As printed the weight leaves (0, 1] for mu <= 0 (mu = -0.5, U = 1.0001 gives -5000). Its limit for
    mu -> 0+ is 0, and that is what mu <= 0 gets here.

    Examples:
        >>> float(certainty_equivalent_weight(u=2.0, mu=4.0, kappa=2.0))
        0.5

    Args:
        u: Total uncertainty U >= 0, in the unit of ``mu``.
        mu: What is to be discounted, measured from its anchor.
        kappa: Risk coefficient >= 0, one over the unit of ``mu``.
    """
    mu = _as_array_like(u, mu)
    xp = namespace(mu)
    safe = xp.where(mu > 0, mu, xp.ones_like(mu))
    return 2.0 * xp.maximum(mu, xp.zeros_like(mu)) / (2.0 * safe + kappa * u * u)


def wiener_weight(signal: Numbers, noise: Numbers) -> Array:
    """w = S / (S + N) in [0, 1] (A32); 1 where both are 0.

    Examples:
        >>> float(wiener_weight(signal=3.0, noise=1.0))
        0.75

    Args:
        signal: Signal power S >= 0.
        noise: Noise power N >= 0, in the same unit.
    """
    total = _as_array_like(noise, signal + noise)
    xp = namespace(total)
    empty = total <= 0
    return xp.where(empty, xp.ones_like(total), signal / xp.where(empty, xp.ones_like(total), total))


def _as_array_like(other: Numbers, value: Numbers) -> Array:
    """Broadcast ``value`` against ``other`` so that it is an array."""
    total = value + 0.0 * other
    return total if hasattr(total, "shape") else np.asarray(total)


def discount(value: Numbers, weight: Numbers, anchor: Numbers = 0.0) -> Array:
    """b + w (r - b): the value, drawn towards the anchor b where it is not believed.

    With b = 0 and a value estimate this is the paper's score J (A19); with b = 0 and a reward it is the reward of
    its operator T_lambda (A21). With b a pessimistic reward it keeps order and sign where the paper's form does
    not: b = 0 makes a penalty smaller.

    Examples:
        >>> discount(4.0, weight=0.25, anchor=-1.0)
        0.25

    Args:
        value: r, a reward or a value.
        weight: w, from 0 (the anchor is taken) to 1 (the value is).
        anchor: b, in the unit of the value.
    """
    return anchor + weight * (value - anchor)


@dataclass(frozen=True)
class ReliabilityFilter:
    """The filter with its parameters; the defaults are the paper's (E3, E4).

    Examples:
        >>> reliability = ReliabilityFilter(lam=2.0, alpha=0.5, beta=0.5)
        >>> reliability.weight(sigma_m=0.0, sigma_h=1.0)
        0.5
        >>> reliability.score(4.0, sigma_m=0.0, sigma_h=1.0)
        2.0

    Attributes:
        lam: The skepticism parameter lambda >= 0 (for ``certainty-equivalent`` it is the risk coefficient kappa).
        alpha: Weight of the ensemble's disagreement, in [0, 1].
        beta: Weight of the annotators' disagreement, in [0, 1].
        form: One of ``FORMS``. All but the first two also need the size of what is discounted.
    """

    lam: float = 2.0
    alpha: float = 0.5
    beta: float = 0.5
    form: Form = "reciprocal"

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        _checks.number("lam", self.lam, low=0)
        _checks.number("alpha", self.alpha, low=0, high=1)
        _checks.number("beta", self.beta, low=0, high=1)
        _checks.choose("form", self.form, FORMS)

    @property
    def needs_mu(self) -> bool:
        """Whether the weight depends on the size of what is discounted."""
        return self.form not in ("reciprocal", "exponential")

    def weight(
        self, sigma_m: Numbers, sigma_h: Numbers, mu: Numbers | None = None, lam: Numbers | None = None
    ) -> Array:
        """Return w for the two disagreements.

        Args:
            sigma_m: Ensemble disagreement, >= 0.
            sigma_h: Annotator disagreement, >= 0, broadcastable.
            mu: What is to be discounted, measured from its anchor; needed by the three forms that compare the
                uncertainty with it (``needs_mu``).
            lam: Use this lambda instead of the filter's own (an adaptive lambda_t, broadcastable).

        Returns:
            Weights in [0, 1], of the shape that all broadcast to.

        Raises:
            InvalidValueError: for bad sigmas, or a form that needs ``mu`` without it.
        """
        if lam is not None:
            _checks.nonnegative("lam", lam)
        return self.weight_of(total_uncertainty(sigma_m, sigma_h, self.alpha, self.beta), mu, lam)

    def weight_of(self, u: Numbers, mu: Numbers | None = None, lam: Numbers | None = None) -> Array:
        """Return w for a total uncertainty, of which nothing is checked; see ``weight``.

        Args:
            u: Total uncertainty U >= 0, see ``total_uncertainty``.
            mu: See ``weight``.
            lam: See ``weight``.

        Raises:
            InvalidValueError: for a form that needs ``mu`` without it.
        """
        strength = self.lam if lam is None else lam
        if self.form == "reciprocal":
            return reciprocal_weight(u, strength)
        if self.form == "exponential":
            return exponential_weight(u, strength)
        if mu is None:
            raise _checks.InvalidValueError("mu", mu, f"given for the form {self.form!r}")
        if self.form == "linear":
            return linear_weight(u, mu, strength)
        if self.form == "certainty-equivalent":
            return certainty_equivalent_weight(u, mu, strength)
        return wiener_weight(mu * mu, (strength * u) * (strength * u))

    def score(
        self, mu: Numbers, sigma_m: Numbers, sigma_h: Numbers, anchor: Numbers = 0.0, lam: Numbers | None = None
    ) -> Array:
        """J = b + w (mu - b), the confidence-adjusted action score (A19 for b = 0).

        The same call discounts a reward: pass the reward as ``mu``.

        Args:
            mu: Values or rewards, finite.
            sigma_m: Ensemble disagreement, >= 0.
            sigma_h: Annotator disagreement, >= 0.
            anchor: b, what is drawn towards.
            lam: See ``weight``.

        Raises:
            InvalidValueError: for a ``mu`` that is not finite; see also ``weight``.
        """
        _checks.finite("mu", mu)
        return discount(mu, self.weight(sigma_m, sigma_h, mu=mu - anchor, lam=lam), anchor)
