"""Section g: who preserves the sign of an advantage longer, UARD or PPO?"""

from __future__ import annotations

from uard.method.stability import sign_preservation_radius
from uard.method.weights import reciprocal_weight
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.verdicts import Part


def checks() -> list[Check]:
    """Return the checks of this section."""
    w = reciprocal_weight(paper.BETA * paper.SIGMA_H_AT_TRAP, paper.LAMBDA)
    radius = {
        "raw rewards perturbed, common w": float(sign_preservation_radius(1.0, w, "before")),
        "filtered advantage perturbed": float(sign_preservation_radius(1.0, w, "after")),
        "the uncertain rival inflated": float(sign_preservation_radius(1.0, w, "towards-uncertain")),
    }
    larger = {name: "equal" if abs(r - 1) < 1e-9 else "UARD" if r > 1 else "PPO" for name, r in radius.items()}
    return [
        Check(
            "g.radius",
            recomputed={**radius, **{f"larger when {name}": who for name, who in larger.items()}},
            others={"smallest": min(radius.values()), "largest": max(radius.values())},
            claims=(
                Part("UARD's is larger by every definition (L2078)", lambda n: n["smallest"] > 1 + 1e-9),
                Part("PPO's is larger by every definition (L2084)", lambda n: n["largest"] < 1 - 1e-9),
            ),
            findings=(
                Part("UARD's is larger by one of them", lambda n: n["largest"] > 1 + 1e-9),
                Part("PPO's is larger by another one", lambda n: n["smallest"] < 1 - 1e-9),
            ),
        )
    ]
