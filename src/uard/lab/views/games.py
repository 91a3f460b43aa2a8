"""Reward-gaming gridworlds in the report, from the published results."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from uard.envs.base import TableEnvironment
from uard.lab import margins
from uard.lab.statistics import Family
from uard.lab.studies.games import EPISODES, GAMES, TABULAR_EPISODES
from uard.lab.study import Row
from uard.lab.views.published import Published
from uard.lab.views.tables import Table, brief, number
from uard.method.feedback import Feedback
from uard.method.mitigations import named
from uard.ratings.panels import MAIN

OURS, ORACLE = "uard", "true-reward"
SIMPLE = ("mean-of-annotations", "median", "worst-of-annotations")
LISTED = 12  # comparisons that are named one by one


def losses(p: Published) -> list[str]:
    """Say where another mitigation, raw included, has the higher true return than ``uard`` (after Holm correction)."""
    games = _ours(p)
    if not games:
        return []
    pairs, family = _compared(p)
    beaten = [
        f"{r['game']}, {r['agent']}: {rival['mitigation']} {brief(p.of(rival, 'true_return'))} against "
        f"{brief(p.of(r, 'true_return'))}"
        for i, (rival, r) in enumerate(pairs)
        if family.above(i)
    ]
    listed = f": {'; '.join(beaten[:LISTED])}" if beaten else ""
    more = f"; and {len(beaten) - LISTED} more (table below)" if len(beaten) > LISTED else ""
    return [
        f"Reward-gaming gridworlds: in {len(beaten)} comparisons over {len(games)} settings another mitigation, raw "
        f"included, has the higher true return{listed}{more}. Rival against uard: {family.caption()}",
        *_reasons({rival["game"] for i, (rival, _) in enumerate(pairs) if family.above(i)}),
    ]


def _reasons(games: Collection[str]) -> list[str]:
    """Say what caution costs in games in which a rival is better, if they have tables."""
    found: list[str] = []
    for game, environment in _with_tables():
        feedback = margins.rated(environment, MAIN)
        true, ours = (margins.margin(environment, x) for x in (_truth(environment), _learned(feedback, OURS)))
        left = {name: margins.margin(environment, _learned(feedback, name)) for name in SIMPLE}
        best = max(left, key=lambda name: left[name])
        if game in games and ours < left[best]:
            found.append(
                f"Why {game}: raters differ about nearly every step there, honest ones too. Of the {true:.2f} per step "
                f"that honesty is worth, what uard learns keeps {ours:.2f} and {best} {left[best]:.2f} (exact tables, "
                f"{margins.RATINGS} ratings a step): caution takes from honest steps what it takes from lies."
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
        rows.append((game, *(f"{x:.2f}" for x in (margins.margin(environment, _truth(environment)), *left))))
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
    """Return one table per game: true return and hacks of every agent with every mitigation."""
    made = []
    caption = _compared(p)[1].caption()
    names = list(dict.fromkeys(r["mitigation"] for r in p.rows("gaming")))
    for game in dict.fromkeys(r["game"] for r in p.rows("gaming")):
        rows = []
        for agent in dict.fromkeys(r["agent"] for r in p.rows("gaming", game=game)):
            cells = []
            for name in names:
                found = p.rows("gaming", game=game, agent=agent, mitigation=name)
                cells.append(
                    f"{number(p.of(found[0], 'true_return').mean)} ({number(p.of(found[0], 'hacks').mean)})"
                    if found
                    else "–"
                )
            rows.append((agent, *cells))
        made.append(
            Table(
                f"{game}: true return (hacks) per episode",
                ("agent", *names),
                tuple(rows),
                1,
                f"Main panel, {TABULAR_EPISODES} episodes of tabular agents, {EPISODES} of deep ones, whose moves are "
                f"still mostly random then; {p.seeds('gaming')} seeds, means; – was not run. True return of each "
                f"mitigation against uard, all games together: {caption}",
            )
        )
    return [*made, _margins([name for name in names if name != ORACLE])] if made else made
