"""Reward-gaming gridworlds in the report, from the published results."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from uard.envs.base import TableEnvironment
from uard.lab import margins
from uard.lab.statistics import Family
from uard.lab.studies.games import EPISODES, GAMES, TABULAR_EPISODES
from uard.lab.study import Row
from uard.lab.views.losses import Loss, of_family
from uard.lab.views.published import Published
from uard.lab.views.tables import Number, Table, words
from uard.method.feedback import Feedback
from uard.method.mitigations import named
from uard.ratings.panels import MAIN

OURS, ORACLE = "uard", "true-reward"
SIMPLE = ("mean-of-annotations", "median", "worst-of-annotations")
LISTED = 12  # comparisons that are named one by one


def losses(p: Published) -> list[Loss]:
    """Say where another mitigation, raw included, has the higher true return than ``uard`` (after Holm correction)."""
    pairs, family = _compared(p)
    beaten = [i for i in range(len(pairs)) if family.above(i)]
    reasons = _reasons({pairs[i][0]["game"] for i in beaten})
    return [
        Loss(
            "beaten",
            "games",
            f"{rival['mitigation']} earns more",
            f"{r['game']}, {r['agent']}",
            rival["mitigation"],
            p.of(r, "true_return"),
            p.of(rival, "true_return"),
            "true return",
            *of_family(family, i),
            why=reasons.get(r["game"], ""),
        )
        for i, (rival, r) in ((i, pairs[i]) for i in beaten)
    ]


def _reasons(games: Collection[str]) -> dict[str, str]:
    """Say what caution costs in games in which a rival is better, if they have tables."""
    found: dict[str, str] = {}
    for game, environment in _with_tables():
        feedback = margins.rated(environment, MAIN)
        true, ours = (margins.margin(environment, x) for x in (_truth(environment), _learned(feedback, OURS)))
        left = {name: margins.margin(environment, _learned(feedback, name)) for name in SIMPLE}
        best = max(left, key=lambda name: left[name])
        if game in games and ours < left[best]:
            found[game] = (
                f"of {true:.2f} a step that honesty is worth uard leaves {ours:.2f}, {best} {left[best]:.2f}: "
                "nearly all is contested"
            )
    return found


def _with_tables() -> list[tuple[str, TableEnvironment]]:
    return [(name, game) for name, game in GAMES.items() if isinstance(game, TableEnvironment) and not game.legitimate]


def _truth(environment: TableEnvironment) -> np.ndarray:
    return np.asarray(environment.truth().reward, float)


def _learned(feedback: Feedback, name: str) -> np.ndarray:
    return margins.learned(feedback, named(name))


def _margins(names: Sequence[str]) -> Table:
    """Return what each rule leaves of the reason to be honest."""
    rows = []
    for game, environment in _with_tables():
        feedback = margins.rated(environment, MAIN)
        left = [margins.margin(environment, _learned(feedback, name)) for name in names]
        rows.append((game, *(Number(x) for x in (margins.margin(environment, _truth(environment)), *left))))
    return Table(
        "What honesty is worth beyond gaming, per step, in what each rule learns",
        ("game", "in truth", *names),
        tuple(rows),
        1,
        f"No agent: the best policies for the true and for the observed reward, in exact tables, after "
        f"{margins.RATINGS} ratings of each step by each rater of the main panel. A small margin needs more "
        "episodes.",
    )


def _ours(p: Published) -> list[Row]:
    """Return the rows of ``uard`` by game and agent; where it was not run, those of ``uard-0.1`` stand for them."""
    rows = {(r["game"], r["agent"]): r for name in ("uard-0.1", "uard") for r in p.rows("gaming", mitigation=name)}
    return list(rows.values())


def _compared(p: Published) -> tuple[list[tuple[Row, Row]], Family]:
    """Return every rival with ``uard`` where both learned, and the paired tests of their true returns."""
    pairs = [
        (rival, r) for r in _ours(p) for rival in p.rows("gaming", game=r["game"], agent=r["agent"]) if rival is not r
    ]
    return pairs, p.compare(pairs, "true_return")


def tables(p: Published) -> list[Table]:
    """Return two tables per game, of true return and of hacks: every agent with every mitigation."""
    made = []
    caption = _compared(p)[1].caption()
    names = list(dict.fromkeys(r["mitigation"] for r in p.rows("gaming")))
    for game in dict.fromkeys(r["game"] for r in p.rows("gaming")):
        agents = list(dict.fromkeys(r["agent"] for r in p.rows("gaming", game=game)))
        for metric in ("true_return", "hacks"):
            rows = []
            for agent in agents:
                found = (p.rows("gaming", game=game, agent=agent, mitigation=name) for name in names)
                rows.append((agent, *(p.of(rows_of[0], metric) if rows_of else None for rows_of in found)))
            note = (
                f"Main panel, {TABULAR_EPISODES} episodes of tabular agents, {EPISODES} of deep ones, whose moves are "
                f"still mostly random then; {p.seeds('gaming')} seeds; – was not run."
            )
            against = f" True return of each mitigation against uard, all games together: {caption}"
            title = f"{game}: {words(metric)}"
            said = note + against * (metric == "true_return")
            made.append(Table(title, ("agent", *names), tuple(rows), 1, said))
    return [*made, _margins([name for name in names if name != ORACLE])] if made else made
