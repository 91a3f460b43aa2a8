"""The paper's grid experiments (H1-H3, H5-H11, H18-H20) as data.

Where the paper is silent, every reading is a row (audit, ambiguities).
"""

from __future__ import annotations

from uard.agents.tabular import QLearning
from uard.envs.grids.trapgrid import paper_grid
from uard.lab.cell import Cell
from uard.lab.studies.common import PANELS, RAW, SIZES, WALKER
from uard.lab.study import Row, Study, row
from uard.method.abstention import Abstention
from uard.method.mitigations import Mitigation, named
from uard.ratings.panels import as_panel

SINGLE = QLearning(heads=1)
BOOTSTRAPPED = QLearning(bootstrap=0.5)

# The agents that most tables compare: (label, agent, mitigation).
HEADLINE: tuple[tuple[str, QLearning, Mitigation], ...] = (
    ("baseline", SINGLE, RAW),
    ("uard-paper", QLearning(), named("uard-paper")),
    ("uard-consistent", QLearning(), named("uard-consistent")),
    ("uard-0.1", QLearning(), named("uard-0.1")),
    ("uard", QLearning(), named("uard")),
    ("random walk", WALKER, RAW),
)


def scale(trap_reward: float = 4.0) -> tuple[Row, ...]:
    """Every headline agent on every grid of the paper, both panels."""
    return tuple(
        row(
            Cell(paper_grid(size, trap_reward), mitigation, agent, as_panel(panel)),
            agent=label,
            size=size,
            panel=panel,
        )
        for size in SIZES
        for panel in PANELS
        for label, agent, mitigation in HEADLINE
    )


def table3() -> tuple[Row, ...]:
    """10x10 at T = 100 (what Table 3 was run with) and T = 80 (what it says)."""
    return tuple(
        row(
            Cell(paper_grid(10, horizon=t), mitigation, agent, as_panel(panel)),
            agent=label,
            horizon=t,
            panel=panel,
        )
        for t in (100, 80)
        for panel in PANELS
        for label, agent, mitigation in HEADLINE
    )


def table4() -> tuple[Row, ...]:
    """6x6: the three agents of Table 4 and the repaired ones; the curves of G3, G4, G5, G8 and G16 are these."""
    agents = (
        ("baseline", SINGLE, RAW),
        ("multi-head", BOOTSTRAPPED, RAW),
        *HEADLINE[1:5],
        ("random walk", WALKER, RAW),
    )
    return tuple(
        row(Cell(paper_grid(6), mitigation, agent, as_panel(panel)), agent=label, panel=panel)
        for panel in PANELS
        for label, agent, mitigation in agents
    )


# How the ablation's discounting acts: the paper's algorithm, its repair, its theorem, and what we made of them first.
# The present ``uard`` has no such parts: it asks who said what.
READINGS = ("uard-paper", "uard-consistent", "uard-operator", "uard-0.1")


def table5() -> tuple[Row, ...]:
    """The component ablation (F5) under every reading of where the filter acts."""
    rows = [
        row(Cell(paper_grid(6), RAW, SINGLE), variant="Baseline Q-Learning", reading="-"),
        row(Cell(paper_grid(6), RAW, BOOTSTRAPPED), variant="Ablation I", reading="-"),
        row(Cell(paper_grid(6), named("no-discount"), BOOTSTRAPPED), variant="Ablation II", reading="-"),
    ]
    for reading in READINGS:
        for variant, parameters in (
            ("No sigma_h (UARD-lite)", {"beta": 0.0}),
            ("No sigma_m (Human-only)", {"alpha": 0.0}),
            ("UARD (Full)", {}),
        ):
            cell = Cell(paper_grid(6), named(reading, **parameters), BOOTSTRAPPED)
            rows.append(row(cell, variant=variant, reading=reading))
    return tuple(rows)


LAMBDAS = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


def sensitivity() -> tuple[Row, ...]:
    """Lambda (J34) for the paper's forms on the smallest and the largest grid, main panel."""
    return tuple(
        row(Cell(paper_grid(size), named(reading, lam=lam)), reading=reading, size=size, lam=lam)
        for reading in ("uard-paper", "uard-consistent", "uard-operator")
        for size in (6, 10)
        for lam in LAMBDAS
    )


def filters() -> tuple[Row, ...]:
    """Shapes of the filter (G2, J13, J14): acting on scores as printed, and inside our anchored reward."""
    from uard.method.mitigations import RewardDiscounting
    from uard.method.weights import FORMS, ReliabilityFilter

    rows = []
    for form in FORMS:
        rows.append(row(Cell(paper_grid(6), named("uard-paper", form=form)), form=form, reading="uard-paper"))
        rows.append(row(Cell(paper_grid(6), named("uard-consistent", form=form)), form=form, reading="uard-consistent"))
        anchored = RewardDiscounting(filter=ReliabilityFilter(lam=0.2, form=form))
        rows.append(row(Cell(paper_grid(6), anchored), form=form, reading="uard-0.1"))
    return tuple(rows)


def noise() -> tuple[Row, ...]:
    """Noise of 0-30 % in both units: reward units (sd 0.3 = 30 %) and the trap's reward (sd 1.2 = 30 %)."""
    agents = (*HEADLINE[:5], ("mean of ratings", QLearning(), named("mean-of-annotations")))
    rows = []
    for percent in (0, 10, 20, 30):
        for unit, sd in (("reward units", percent / 100), ("of the trap's reward", percent / 100 * 4.0)):
            for panel in PANELS:
                for label, agent, mitigation in agents:
                    cell = Cell(paper_grid(6), mitigation, agent, as_panel(panel), noise=sd)
                    rows.append(row(cell, agent=label, panel=panel, percent=percent, unit=unit))
    return tuple(rows)


def uncertainty() -> tuple[Row, ...]:
    """Both uncertainties over training (G9): at the trap and elsewhere."""
    return tuple(
        row(
            Cell(paper_grid(6), named(name), agent, as_panel(panel), snapshots=50),
            agent=name,
            panel=panel,
            heads=heads,
        )
        for panel in PANELS
        for name in ("uard-paper", "uard-0.1", "uard")
        for heads, agent in (("initial values", QLearning()), ("bootstrapped", BOOTSTRAPPED))
    )


def abstention() -> tuple[Row, ...]:
    """Abstention (A42, A43, J38), claimed and not shown: rules, limits and responses, on the paper's agent."""
    rows = [row(Cell(paper_grid(6), named("uard-paper")), rule="none", limit=0.0, response="-")]
    for rule, limits in (("threshold", (0.25, 0.5, 1.0)), ("ratio", (0.1, 0.3, 1.0))):
        for limit in limits:
            for response in ("safe", "ask", "skip"):
                agent = QLearning(abstention=Abstention(rule, limit, response))  # type: ignore[arg-type]
                rated = 0.1 if response == "ask" else 1.0
                cell = Cell(paper_grid(6), named("uard-paper"), agent, rated=rated)
                rows.append(row(cell, rule=rule, limit=limit, response=response))
    return tuple(rows)


def studies() -> tuple[Study, ...]:
    """Return all of them."""
    return (
        Study("scale", "UARD across grid sizes", "H1, F2", scale()),
        Study("stress", "The announced test with traps that pay +8", "H2", scale(8.0)),
        Study("table3", "Baselines on 10x10", "H3, F3, I3", table3()),
        Study("table4", "Agents on 6x6, and their curves", "H5-H7, H17, H18, F4, I1, I2, G3-G5, G8, G16", table4()),
        Study("table5", "Which component does the work", "H8, F5", table5()),
        Study("sensitivity", "The skepticism parameter lambda", "H9", sensitivity()),
        Study("filters", "Shapes of the filter", "H10, G2", filters()),
        Study("noise", "Noisy annotators", "H11, G11", noise()),
        Study("uncertainty", "How the two uncertainties evolve", "H19, G9", uncertainty()),
        Study("abstention", "Deferring instead of acting", "H20", abstention()),
    )
