"""The whole loop with ten panels of five: a page, simulated raters, an agent that trains meanwhile.

Each run starts a server, lets the panel's raters answer at it, and trains Q-learning on TrapGrid 8x8 (``examples/
people_rate.py``). The panels are the first ten of ``random_panel(1200)``, ``random_panel(1201)`` ... that have five
raters: nothing was tuned on them. Ten minutes::

    python benchmarks/people_loop.py --json people.json
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from itertools import count, islice
from pathlib import Path

from uard import __version__
from uard.lab import statistics
from uard.ratings.panels import composition, random_panel

EXAMPLE = Path(__file__).parents[1] / "examples" / "people_rate.py"
RATERS = 5
FIRST = 1200  # earlier ones were looked at, when a fault was sought and the number of episodes was chosen


def panels(number: int) -> list[int]:
    return list(islice((s for s in count(FIRST) if len(random_panel(s).raters) == RATERS), number))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--panels", type=int, default=10)
    parser.add_argument("--size", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--json", help="write the numbers to this file")
    chosen = parser.parse_args()
    rows = []
    for number, panel in enumerate(panels(chosen.panels)):
        more = ["--panel", f"random:{panel}", "--size", str(chosen.size), "--episodes", str(chosen.episodes)]
        command = [sys.executable, str(EXAMPLE), *more, "--seed", str(number), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows.append({"panel": panel, "seed": number} | json.loads(done.stdout))
        print(json.dumps(rows[-1]), composition(random_panel(panel)), flush=True)
    for name in ("goal_rate", "hacks", "true_return"):
        found = statistics.summarise([row[name] for row in rows], share=name == "goal_rate")
        low, high = found.ci95 or (float("nan"), float("nan"))
        print(f"{name}: {found.mean:.3f} [{low:.3f}, {high:.3f}]")
    if chosen.json:
        Path(chosen.json).write_text(json.dumps({"version": __version__, "command": sys.argv, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
