"""Which rule is enough for which kind of panel: the simplest one that nothing known does better than.

A rule is *sufficient* for a kind of panel if two things hold over the scenarios of that kind: its regret is not more
than ours beyond noise (a paired sign-flip test over scenarios, corrected by Holm for all rules), and its mean regret is
at most ``NEAR`` above that of the best rule. The first condition alone would call every rule sufficient where there are
few scenarios; the second alone would call a rule sufficient that is a little worse in every one of them.

Twenty grids by hand, in which the lowest rating is as good as the true reward and learning from the reward hacks:

    >>> from uard.lab.studies.panels import FLOOR, GRIDS, ORACLE
    >>> returns = {ORACLE: [8.0] * 20, FLOOR: [-2.0] * 20, "raw": [-12.0] * 20}
    >>> returns |= {"worst-of-annotations": [8.0] * 20, OURS: [7.9] * 20}
    >>> found = Regrets.of(GRIDS, range(1, 41, 2), returns)
    >>> (one,) = choices(found, {"by hand": np.ones(20, bool)})
    >>> one.simplest, one.sufficient, round(one.ours.mean, 2), one.told_apart
    ('worst-of-annotations', ('worst-of-annotations', 'uard'), 0.01, True)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from uard.lab import statistics
from uard.lab.statistics import Summary
from uard.lab.studies.panels import OURS, scenario
from uard.lab.views.panels import Regrets, kind_of_panel

SIMPLICITY = (  # from what needs no thought to what needs a model of every rater
    "raw",
    "mean-of-annotations",
    "median",
    "worst-of-annotations",
    "min-proxy-mean",
    "min-proxy-median",
    "lcb",
    "excess",
    "uard",
    "uard, 1 veto",
    "witness",
)
NEAR = 0.05  # regret: a twentieth of what knowing the true reward is worth
TOO_MUCH = 0.25  # regret of the best rule from which on no rule is called enough


@dataclass(frozen=True)
class Choice:
    """What to use for one kind of panel.

    Examples:
        >>> one.best_regret.mean, one.simplest_regret.ci95
        (0.0, (0.0, 0.0))

    Attributes:
        kind: Of panel.
        scenarios: How many there are.
        simplest: The simplest sufficient rule; None where even the best has more regret than ``TOO_MUCH``.
        simplest_regret: Its regret over scenarios; None where there is none.
        ours: The regret of ``uard``.
        best: The rule of the lowest mean regret.
        best_regret: Its regret.
        told_apart: Whether the regret of the simplest differs from ours beyond noise; it is less then.
        sufficient: All sufficient rules, the simplest first.
    """

    kind: str
    scenarios: int
    simplest: str | None
    simplest_regret: Summary | None
    ours: Summary
    best: str
    best_regret: Summary
    told_apart: bool
    sufficient: tuple[str, ...]


def choices(found: Regrets, groups: Mapping[str, np.ndarray] | None = None) -> list[Choice]:
    """Return what is enough, for each kind of panel.

    Examples:
        >>> every = {"all panels": np.ones(20, bool)}
        >>> [(c.kind, c.scenarios, c.simplest, c.best) for c in choices(found, every)]
        [('all panels', 20, 'worst-of-annotations', 'worst-of-annotations')]

    Args:
        found: Regrets on one kind of tasks, see ``panels.regrets``.
        groups: Which scenarios are of which kind, by name; by default by kind of panel.
    """
    return [_choice(found, kind, here) for kind, here in (groups or by_kind(found)).items()]


def by_kind(found: Regrets) -> dict[str, np.ndarray]:
    """Return which scenarios have which kind of panel (``panels.kind_of_panel``), by kind.

    Examples:
        >>> {kind: int(here.sum()) for kind, here in by_kind(found).items() if kind != "some tempted"}
        {'all truthful': 2, 'one rater': 2, 'some answering at random': 6, 'some repeating the proxy': 9}
    """
    kinds = np.array([kind_of_panel(scenario(found.tasks, seed).panel) for seed in found.scenarios])
    return {str(kind): kinds == kind for kind in np.unique(kinds)}


def by_share_rated(found: Regrets) -> dict[str, np.ndarray]:
    """Return which scenarios have which share of their steps rated, the fullest first; another grouping of ``choices``.

    Examples:
        >>> [int(here.sum()) for here in by_share_rated(found).values()], list(by_share_rated(found))[0]
        ([10, 1, 4, 5], '100 % of the steps rated')

    Args:
        found: Regrets on random tasks, whose scenarios are drawn again to look.
    """
    shares = np.array([scenario(found.tasks, seed).rated for seed in found.scenarios])
    return {f"{100 * share:g} % of the steps rated": shares == share for share in sorted(set(shares), reverse=True)}


def _choice(found: Regrets, kind: str, here: np.ndarray) -> Choice:
    regret = {name: values[here] for name, values in found.regret.items()}
    mean = {name: float(values.mean()) for name, values in regret.items()}
    best = min(mean, key=lambda name: mean[name])
    differ = _told_apart(regret)
    order = [name for name in SIMPLICITY if name in regret] + sorted(set(regret) - set(SIMPLICITY))
    sufficient = tuple(
        name
        for name in order
        if mean[best] <= TOO_MUCH and mean[name] <= mean[best] + NEAR and not (differ[name] and mean[name] > mean[OURS])
    )
    simplest = sufficient[0] if sufficient else None
    return Choice(
        kind,
        int(here.sum()),
        simplest,
        statistics.summarise(regret[simplest]) if simplest else None,
        statistics.summarise(regret[OURS]),
        best,
        statistics.summarise(regret[best]),
        bool(simplest and differ[simplest]),
        sufficient,
    )


def _told_apart(regret: Mapping[str, np.ndarray]) -> dict[str, bool]:
    """Say of every rule whether its regret differs from ours beyond noise, corrected for all of them."""
    rivals = [name for name in regret if name != OURS]
    p = statistics.holm([statistics.paired_sign_flip_p(regret[name] - regret[OURS]) for name in rivals])
    return {OURS: False} | {name: corrected < statistics.LEVEL for name, corrected in zip(rivals, p, strict=True)}
