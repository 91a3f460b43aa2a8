"""What is written down of every training episode: sums over its steps.

* ``hacks``: contested steps, such as entries of a trap or steps inside a region whose reward lies (a legitimate twin's
  are counted too);
* ``true_return``: what the episode was really worth, in reward units;
* ``observed_return``: what it paid;
* ``success``: 1 if it reached what the task is about, such as the goal or the horizon without a fall, else 0;
* ``length``: its steps;
* ``abstained``: steps on which the agent abstained from its own action.
"""

from __future__ import annotations

LOG = ("hacks", "true_return", "observed_return", "success", "length", "abstained")
