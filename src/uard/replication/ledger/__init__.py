"""The ledger: every claim of the paper that a grid, a published result or its text can answer, and a verdict.

Words are in ``claims.toml``; each claim's numbers and conditions are Python, in the files of their subjects. The verdict
follows from the conditions by one rule (``uard.replication.verdicts``). Grid studies are read from the store; what is said
of deep agents and of MuJoCo, from the published results.
"""

from uard.replication.ledger.entries import CLAIMS, Entry, as_data, entries
from uard.replication.verdicts import VERDICTS

__all__ = ["CLAIMS", "VERDICTS", "Entry", "as_data", "entries"]
