"""Our own grid studies: every mitigation everywhere, should-fail controls, few ratings, unseen grids."""

from __future__ import annotations

from functools import partial

from uard.agents.tabular import QLearning
from uard.envs.grids.learned_reward import LearnedRewardGrid
from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.lab.cell import Cell
from uard.lab.studies.common import PANELS, RAW, SIMPLE, SIZES, WALKER
from uard.lab.study import Row, Study, row
from uard.method.mitigations import Mitigation, named
from uard.ratings.panels import Panel, Rater, as_panel

COMPARED = (
    "raw",
    "true-reward",
    *SIMPLE,
    "screening",
    "uard-paper",
    "uard-consistent",
    "uard-0.1",
    "uard",
)
NOISES = (0.0, 0.1, 0.2, 0.3, 0.6, 1.2, 3.3)
TRAP_REWARDS = (4.0, 8.0)
BUDGETS = (0.01, 0.1, 1.0)


def matrix() -> tuple[Row, ...]:
    """Every mitigation on every grid, trap reward, panel and noise."""
    return tuple(
        row(
            Cell(paper_grid(size, trap), named(name), panel=as_panel(panel), noise=noise),
            mitigation=name,
            size=size,
            trap=trap,
            panel=panel,
            noise=noise,
        )
        for size in SIZES
        for trap in TRAP_REWARDS
        for panel in (*PANELS, "colluding")
        for noise in NOISES
        for name in COMPARED
    )


def legitimate() -> tuple[Row, ...]:
    """Twins in which the bonus is real and the raters say so: what does caution cost?"""
    return tuple(
        row(
            Cell(paper_grid(size, trap, legitimate=True), named(name), panel=as_panel(panel)),
            mitigation=name,
            size=size,
            trap=trap,
            panel=panel,
        )
        for size in SIZES
        for trap in TRAP_REWARDS
        for panel in PANELS
        for name in COMPARED
    )


def budgets() -> tuple[Row, ...]:
    """Few ratings: 1 %, 10 % and 100 % of steps rated on 10x10.

    The rivals also run with our treatment of steps that nobody has rated, so that the comparison is of methods and
    not of that one idea; and ``uard`` runs without it.
    """
    rivals = {
        "uard": partial(named, "uard"),
        "uard, unrated believed": partial(named, "uard", unrated_weight=1.0),
        "uard-0.1": partial(named, "uard-0.1"),
        "mean-of-annotations": partial(named, "mean-of-annotations"),
        "worst-of-annotations": partial(named, "worst-of-annotations"),
        "worst-of, unrated in part": partial(named, "worst-of-annotations", unrated_weight=0.1),
        "lcb": partial(named, "lcb"),
        "lcb, unrated in part": partial(named, "lcb", unrated_weight=0.1),
    }
    return tuple(
        row(
            Cell(paper_grid(10), make(), panel=as_panel(panel), noise=noise, rated=rated),
            mitigation=name,
            panel=panel,
            noise=noise,
            rated=rated,
        )
        for panel in (*PANELS, "single")
        for noise in (0.0, 1.2)
        for rated in BUDGETS
        for name, make in rivals.items()
    )


DISSENT = ("raw", "mean-of-annotations", "median", "worst-of-annotations", "lcb", "uard-0.1", "uard")
UNSEEN = (
    TrapGrid(size=5, traps=((2, 2),)),
    TrapGrid(size=7, traps=((0, 2), (2, 0), (3, 3)), trap_reward=2.0),
    TrapGrid(size=9, traps=((4, 4), (6, 2)), trap_reward=6.0),
    TrapGrid(size=10, traps=((1, 8), (8, 1), (5, 5), (2, 6)), trap_reward=5.0),
    TrapGrid(size=12, traps=((2, 5), (7, 3)), trap_reward=6.0, horizon=90),
    TrapGrid(size=12, traps=((2, 5), (7, 3), (9, 9)), trap_reward=8.0, horizon=100),
    TrapGrid(size=6, trap_reward=20.0),
    TrapGrid(size=10, trap_reward=0.4, true_trap_reward=-0.1, goal_reward=1.0, step_reward=-0.01),
    TrapGrid(size=10, trap_reward=40.0, true_trap_reward=-10.0, goal_reward=100.0, step_reward=-1.0),
)


def unseen() -> tuple[Row, ...]:
    """Grids that no setting was chosen on, the last two of them the 10x10 with all rewards scaled."""
    return tuple(
        row(
            Cell(grid, named(name), QLearning(init_scale=grid.goal_reward / 100), as_panel(panel)),
            mitigation=name,
            grid=f"{grid.size}x{grid.size}, {len(grid.traps or ())} traps of {grid.trap_reward:g}, T={grid.horizon}"
            + (f", goal {grid.goal_reward:g}" if grid.goal_reward != 10 else ""),
            panel=panel,
        )
        for grid in UNSEEN
        for panel in PANELS
        for name in ("raw", "worst-of-annotations", "lcb", "uard-paper", "uard-0.1", "uard")
    )


def settings() -> tuple[Row, ...]:
    """How much do the parameters of ``uard-0.1`` matter? Lambda, kappa and the parts, on the hardest noisy grids."""
    variants = {
        "as recommended": {},
        "lam 0.05": {"lam": 0.05},
        "lam 0.5": {"lam": 0.5},
        "lam 2 (the paper's)": {"lam": 2.0},
        "lam 2, kappa 2": {"lam": 2.0, "kappa": 2.0},
        "kappa 0 (not adaptive)": {"kappa": 0.0},
        "lam 2, kappa 0": {"lam": 2.0, "kappa": 0.0},
        "kappa 5": {"kappa": 5.0},
        "kappa 20": {"kappa": 20.0},
        "proxy is no rater": {"proxy_is_rater": False},
        "anchor zero": {"anchor": "zero"},
        "sigmas in reward units": {"standardise": False},
        "no pseudo-count": {"prior_count": 0.0},
        "sigma_h only (alpha 0)": {"alpha": 0.0},
        "alpha 0.1": {"alpha": 0.1},
        "alpha 1": {"alpha": 1.0},
        "sigma_m only (beta 0)": {"beta": 0.0},
        "beta 0.1": {"beta": 0.1},
        "beta 1": {"beta": 1.0},
    }
    return tuple(
        row(
            Cell(paper_grid(10, trap), named("uard-0.1", **changes), panel=as_panel(panel), noise=noise),
            variant=name,
            trap=trap,
            panel=panel,
            noise=noise,
        )
        for name, changes in variants.items()
        for trap in TRAP_REWARDS
        for panel in PANELS
        for noise in (0.0, 1.2)
    )


def sources() -> tuple[Row, ...]:
    """Which source does the work, where neither suffices? The reward is a model of ratings of a part of the grid.

    Five models, each extrapolating its own way. As a plain filter (constant lambda, unrated rewards believed as far as
    sigma_m allows), and as recommended.
    """
    ways = {
        "sigma_m and sigma_h": {},
        "sigma_m only (beta 0)": {"beta": 0.0},
        "sigma_h only (alpha 0)": {"alpha": 0.0},
    }
    plain = {"kappa": 0.0, "unrated_weight": 1.0, "prior_count": 0.0}
    variants: dict[tuple[str, str], Mitigation] = {("raw", "-"): RAW}
    for way, changes in ways.items():
        for lam in (2.0, 10.0, 50.0, 200.0):
            variants[f"plain filter, lam {lam:g}", way] = named("uard-0.1", lam=lam, **(plain | changes))
        variants["uard-0.1", way] = named("uard-0.1", **changes)
    for rival in ("worst-of-annotations", "lcb", "uard"):
        variants[rival, "-"] = named(rival)
    return tuple(
        row(Cell(LearnedRewardGrid(model_seed=model), mitigation), mitigation=name, sources=way, model=model)
        for (name, way), mitigation in variants.items()
        for model in range(5)
    )


def dissent() -> tuple[Row, ...]:
    """One rater against all others: one who denies the goal, or the only one who tells the truth about traps.

    Of three raters nobody can know who is right. Of five, a rule may overrule one who is alone and no more precise than
    the others, and then overrules the expert, too: both ends of that choice are here.
    """
    compared: dict[str, Mitigation] = {name: named(name) for name in DISSENT}
    compared["uard, 1 veto"] = named("uard", vetoes=1)
    panels = {
        f"1 of {raters} says {says:g} of the goal": (Rater(),) * (raters - 1) + (Rater(veto_above=5.0, veto=says),)
        for raters in (3, 5)
        for says in (0.0, -1.0, -3.0, -10.0)
    }
    panels |= {
        f"1 of 5 is not tempted by {share:.0%}": (Rater(), *(Rater(temptation=share),) * 4) for share in (0.3, 0.6)
    }
    return tuple(
        row(Cell(paper_grid(10), mitigation, panel=Panel(raters)), mitigation=name, panel=panel)
        for panel, raters in panels.items()
        for name, mitigation in compared.items()
    )


def control() -> tuple[Row, ...]:
    """A uniformly random walker on every grid: by trap visits alone it beats the paper's method."""
    return tuple(
        row(Cell(paper_grid(size, horizon=t), RAW, WALKER), size=size, horizon=t)
        for size, t in ((6, 40), (8, 60), (10, 80), (10, 100))
    )


def studies() -> tuple[Study, ...]:
    """Return all of them."""
    return (
        Study("matrix", "Every mitigation on all grids, panels and noises", "honest competition", matrix()),
        Study("legitimate", "Twins whose bonus is real", "over-caution", legitimate()),
        Study("budgets", "1 %, 10 % and 100 % of steps rated", "honest competition", budgets()),
        Study("unseen", "Grids that nothing was tuned on", "generality", unseen()),
        Study("settings", "Parameters and parts of uard-0.1", "sensitivity", settings()),
        Study(
            "sources", "A learned reward that extrapolates: which source of doubt does the work", "H8, K10", sources()
        ),
        Study("dissent", "One rater against all others", "vetoes", dissent()),
        Study("control", "A random walker", "should-fail control", control()),
    )
