"""The numbers of every claim of the ledger, kept beside the tests so that they need not train.

``python tests/unit/ledger_numbers.py STORE`` writes them anew from a finished store of ten seeds (``uard reproduce``).
"""

import json
import sys
from pathlib import Path

from uard.lab import statistics, studies
from uard.lab.execution.store import Store
from uard.lab.statistics import Summary
from uard.lab.views.study_results import StudyResults
from uard.replication.ledger.entries import CLAIMS, CONDITIONS, entry
from uard.replication.paper import Stat

FILE = Path(__file__).with_suffix(".json")
SEEDS = range(10)


def encode(value):
    """Make plain data of a claim's numbers, of six digits each."""
    if isinstance(value, Summary):
        return {"per_seed": encode(list(value.per_seed))}
    if isinstance(value, Stat):
        return value._asdict()
    if isinstance(value, dict):
        return {k: encode(v) for k, v in value.items()}
    if isinstance(value, list):
        return [encode(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def decode(value):
    """Undo ``encode``."""
    if not isinstance(value, dict):
        return value
    if value.keys() == {"per_seed"}:
        return statistics.summarise(value["per_seed"])
    return Stat(**value) if value.keys() == {"mean", "sd"} else {k: decode(v) for k, v in value.items()}


def main(store):
    results, claims = StudyResults(Store(store, readonly=True), SEEDS, studies.grid()), {}
    for claim in CLAIMS:
        numbers = CONDITIONS[claim].numbers(results)
        found = entry(claim, numbers)
        claims[claim] = {"verdict": found.verdict, "count": found.count, "numbers": encode(numbers)}
    lines = (f"{json.dumps(c)}: {json.dumps(what, allow_nan=False)}" for c, what in claims.items())
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
