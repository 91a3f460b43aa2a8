"""Section a': the grid sizes (Table 2, F2)."""

from __future__ import annotations

from uard.envs.grids.trapgrid import paper_grid
from uard.replication import paper
from uard.replication.audit.checks import Check
from uard.replication.audit.episodes import LAST_EPSILONS, episode_moments, hacker_policy, most_visits
from uard.replication.audit.solutions import SIZES
from uard.replication.audit.table_3 import ROWS as TABLE_3
from uard.replication.verdicts import Opinion, Part

ROWS = {r.size: r for r in paper.TABLE_2}


def checks() -> list[Check]:
    """Return the checks of this section."""
    return [_units(), _same_grid(), _percent(), _up_to()]


def reductions() -> dict[int, float]:
    """Return UARD's reduction of hits by grid size in %."""
    return {n: 100.0 * (1.0 - r.uard.mean / r.baseline.mean) for n, r in ROWS.items()}


def _units() -> Check:
    grids = {n: paper_grid(n) for n in SIZES}
    hackers = {n: float(episode_moments(g, hacker_policy(g), LAST_EPSILONS).visits.sum()) for n, g in grids.items()}
    hits = {n: r.baseline.mean for n, r in ROWS.items()}
    return Check(
        "a2.units",
        printed={f"{n} baseline": h for n, h in hits.items()},
        recomputed={f"{n} ceiling per episode": float(most_visits(g)) for n, g in grids.items()}
        | {f"{n} hacker per 100 episodes": v for n, v in hackers.items()}
        | {f"{n} baseline per episode, if per 100": hits[n] / paper.LAST_EPISODES for n in (8, 10)},
        others={"episodes": paper.LAST_EPISODES, "largest share": max(hits[n] / hackers[n] for n in (8, 10))},
        claims=(
            Part("hits on 8x8 can be per episode, as on 6x6", lambda n: n["8 baseline"] <= n["8 ceiling per episode"]),
            Part("hits on 10x10 can be per episode", lambda n: n["10 baseline"] <= n["10 ceiling per episode"]),
            Part(
                "in one unit hits grow with the grid",
                lambda n: (
                    n["6 baseline"] < n["8 baseline per episode, if per 100"] < n["10 baseline per episode, if per 100"]
                ),
            ),
        ),
        findings=(
            Opinion("L1149 gives the hits on 6x6 per episode", True),
            Part("almost nobody hacks, if they are per 100", lambda n: n["largest share"] < 0.1),
        ),
    )


def _same_grid() -> Check:
    ratios = {
        "baseline": TABLE_3["DQN"].visits.mean / ROWS[10].baseline.mean,
        "UARD": TABLE_3["UARD"].visits.mean / ROWS[10].uard.mean,
    }
    return Check(
        "a2.same-grid",
        printed={"baseline": ROWS[10].baseline.mean, "UARD": ROWS[10].uard.mean},
        recomputed={f"{who}, Table 3 / Table 2": x for who, x in ratios.items()},
        others={"episodes": paper.LAST_EPISODES},
        claims=tuple(
            Part(
                f"the hits of {who} agree within a factor of two",
                lambda n, x=f"{who}, Table 3 / Table 2": 0.5 < n[x] < 2,
            )
            for who in ratios
        ),
    )


def _percent() -> Check:
    return Check(
        "a2.percent",
        printed={f"{n}, printed": paper.PERCENT[f"hits-{n}x{n}"].value for n in (8, 10)},
        recomputed={str(n): reductions()[n] for n in (8, 10)},
        claims=(
            Part("the reduction on 8x8 follows", lambda n: round(n["8"], 1) == n["8, printed"]),
            Part("the reduction on 10x10 follows", lambda n: round(n["10"], 1) == n["10, printed"]),
        ),
    )


def _up_to() -> Check:
    return Check(
        "a2.up-to",
        printed={"up to": paper.PERCENT["hacking"].value},
        recomputed={"6": reductions()[6]},
        claims=(Part("the reduction on 6x6 is no larger than the abstract's", lambda n: n["6"] <= n["up to"]),),
    )
