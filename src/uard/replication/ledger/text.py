"""Claims that only the paper's text can answer: every part is an opinion (J35, J42, J43)."""

from __future__ import annotations

from uard.replication.ledger.claim import Conditions
from uard.replication.verdicts import Opinion

CONDITIONS = {
    "J35": Conditions((Opinion("all methods were run alike: their code is not public", None),)),
    "J42": Conditions((Opinion("nobody did it before: a claim of priority, not of fact about agents", None),)),
    "J43": Conditions(
        (
            Opinion("Section 5.5 varies lambda", False),
            Opinion("alpha and beta are varied anywhere", False),
        )
    ),
}
