"""Sign-preservation radius (A45): how much reward error an action's advantage survives.

The text contradicts itself about who is more robust, because it uses one word for three quantities. All three are
here; each sentence of the paper is true of one of them (audit g). Nothing is checked but the definition's name:
numbers and arrays broadcast. Advantages, perturbations and radii share the unit of the value.
"""

from __future__ import annotations

from typing import Literal

from uard import _checks
from uard.method.arrays import Array, Numbers

Definition = Literal["before", "after", "towards-uncertain"]
DEFINITIONS: tuple[Definition, ...] = ("before", "after", "towards-uncertain")


def sign_preservation_radius(
    advantage: Numbers, weight: Numbers = 1.0, definition: Definition = "before", other_weight: Numbers = 1.0
) -> Array:
    """The smallest reward perturbation that flips the sign of an advantage.

    Examples:
        >>> [sign_preservation_radius(2.0, 0.5, definition) for definition in DEFINITIONS]
        [2.0, 1.0, 4.0]

    Args:
        advantage: A(s, a), the value of an action over its rival's, measured on raw rewards.
        weight: The filter's weight w in (0, 1] on the action's reward; 1 for an unfiltered agent.
        definition: ``before``: the raw rewards of both actions are perturbed and share the weight, so the weight
            cancels and the radius is |A|. ``after``: the filtered advantage w A is perturbed, radius w |A|
            (the unfiltered agent has the larger one). ``towards-uncertain``: only the rival's reward is inflated, and
            the rival carries ``weight`` while the action carries ``other_weight``: radius
            other_weight |A| / w (the filtered agent has the larger one).
        other_weight: Weight on the trusted action in ``towards-uncertain``, in (0, 1].

    Returns:
        Radii >= 0.

    Raises:
        UnknownNameError: for an unknown definition.
    """
    _checks.choose("definition", definition, DEFINITIONS)
    size = abs(advantage)
    if definition == "before":
        return size + 0.0 * weight
    if definition == "after":
        return weight * size
    return other_weight * size / weight


def perturbed_advantage(
    advantage: Numbers,
    epsilon: Numbers,
    weight: Numbers = 1.0,
    definition: Definition = "before",
    other_weight: Numbers = 1.0,
) -> Array:
    """The advantage after a reward perturbation ``epsilon`` >= 0 against it: the y-axis of the paper's figure (G13).

    Its zero in ``epsilon`` is ``sign_preservation_radius`` for a positive advantage.

    Examples:
        >>> perturbed_advantage(2.0, epsilon=0.5, weight=0.5, definition="after")
        0.5

    Args:
        advantage: A(s, a) on raw rewards.
        epsilon: The perturbation.
        weight: As in ``sign_preservation_radius``.
        definition: As there.
        other_weight: As there.

    Raises:
        UnknownNameError: for an unknown definition.
    """
    _checks.choose("definition", definition, DEFINITIONS)
    if definition == "before":
        return weight * (advantage - epsilon)
    if definition == "after":
        return weight * advantage - epsilon
    return other_weight * advantage - weight * epsilon
