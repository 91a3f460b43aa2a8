"""Reward-gaming gridworlds in the report, from the published results."""

from __future__ import annotations

from uard.lab.statistics import Family
from uard.lab.study import Row
from uard.lab.views.published import Published
from uard.lab.views.tables import Table, brief, number

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
    named = f": {'; '.join(beaten[:LISTED])}" if beaten else ""
    more = f"; and {len(beaten) - LISTED} more (table below)" if len(beaten) > LISTED else ""
    return [
        f"Reward-gaming gridworlds: in {len(beaten)} comparisons over {len(games)} settings another mitigation, raw "
        f"included, has the higher true return{named}{more}. Rival against uard: {family.caption()}"
    ]


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
                f"Main panel, 100 episodes, {p.seeds('gaming')} seeds, means; – was not run. True return of each "
                f"mitigation against uard, all games together: {caption}",
            )
        )
    return made
