"""Reward-gaming gridworlds in the report, from the published results."""

from __future__ import annotations

from uard.lab.views.published import Published
from uard.lab.views.tables import Table, brief, number

LISTED = 12  # comparisons that are named one by one


def losses(p: Published) -> list[str]:
    """Say where another mitigation, raw included, has the higher true return than ``uard`` (intervals apart).

    Where ``uard`` was not run, ``uard-0.1`` stands for it.
    """
    ours = {(r["game"], r["agent"]): r for name in ("uard-0.1", "uard") for r in p.rows("gaming", mitigation=name)}
    games = list(ours.values())
    if not games:
        return []
    beaten = []
    for r in games:
        own = p.of(r, "true_return")
        for rival in p.rows("gaming", game=r["game"], agent=r["agent"]):
            theirs = p.of(rival, "true_return")
            if rival is not r and theirs.ci95[0] > own.ci95[1]:
                beaten.append(f"{r['game']}, {r['agent']}: {rival['mitigation']} {brief(theirs)} against {brief(own)}")
    named = f": {'; '.join(beaten[:LISTED])}" if beaten else ""
    more = f"; and {len(beaten) - LISTED} more (table below)" if len(beaten) > LISTED else ""
    return [
        f"Reward-gaming gridworlds: in {len(beaten)} comparisons over {len(games)} settings another mitigation, raw "
        f"included, has the higher true return{named}{more}."
    ]


def tables(p: Published) -> list[Table]:
    """Return one table per game: true return and hacks of every agent with every mitigation."""
    made = []
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
                f"Main panel, 100 episodes, {p.seeds('gaming')} seeds, means; – was not run.",
            )
        )
    return made
