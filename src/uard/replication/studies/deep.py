"""The paper's baselines as deep agents on the grids (H3, H8, H13, H15-H17), and our questions to them."""

from __future__ import annotations

from uard.agents.networks import Ensemble
from uard.agents.tabular import QLearning
from uard.agents.value import DeepQ
from uard.envs.grids.trapgrid import TrapGrid, paper_grid
from uard.lab.cell import Cell
from uard.lab.registry import deep_agents
from uard.lab.studies.common import PANELS, RAW, SIMPLE
from uard.lab.study import Row, Study, row
from uard.method.mitigations import Mitigation, named
from uard.ratings.panels import as_panel
from uard.replication.studies import derive
from uard.training.feedback.rating_model import RatingModel

AGENTS = deep_agents()
ENSEMBLE = AGENTS["ensemble-dqn"]
EARLIER, OURS = "uard-0.1", "uard"
# The rule of 0.1 was published with a model of what all raters say together; now each rater has a model of her own.
LEARNED = {EARLIER: RatingModel(predicts="ratings"), OURS: RatingModel()}
CURVES = ("observed_return", "hacks", "success")


def cell(environment: object, mitigation: Mitigation, agent: object, model: str = EARLIER, **more: object) -> Cell:
    """Build a cell whose agent learns what raters would say, by the model of ``uard`` or of its earlier version."""
    rating_model = None if isinstance(agent, QLearning) else LEARNED[model]
    return Cell(environment, mitigation, agent, **({"rating_model": rating_model} | more))  # type: ignore[arg-type]


def ours(environment: object, name: str, agent: object, **more: object) -> Cell:
    """Build a cell of ``uard`` or ``uard-0.1``, each with its own model."""
    return cell(environment, named(name), agent, OURS if name == OURS else EARLIER, **more)


def baselines() -> tuple[Row, ...]:
    """All agents on the raw reward, T = 100 (what Table 3 was run with) and T = 80 (what it says), beside UARD."""
    rows = []
    for t in (100, 80):
        grid = paper_grid(10, horizon=t)
        for name, agent in AGENTS.items():
            if t == 100 or name != "cpo-oracle":
                rows.append(row(cell(grid, RAW, agent), agent=name, mitigation="raw", horizon=t))
        for mitigation in ("uard-paper", EARLIER, OURS) if t == 100 else (EARLIER, OURS):
            rows.append(row(ours(grid, mitigation, ENSEMBLE), agent="ensemble-dqn", mitigation=mitigation, horizon=t))
        for mitigation in (EARLIER, OURS):
            rows.append(row(ours(grid, mitigation, AGENTS["ppo"]), agent="ppo", mitigation=mitigation, horizon=t))
    return tuple(rows)


def competence() -> tuple[Row, ...]:
    """Every agent on the true reward: one that cannot learn the grid proves nothing when it does not hack."""
    honest = TrapGrid(size=10, trap_reward=-1.0, horizon=100)
    return tuple(row(cell(honest, RAW, agent), agent=name) for name, agent in AGENTS.items() if name != "cpo-oracle")


EVERYWHERE = ("dqn", "ensemble-dqn", "ppo")


def mitigated() -> tuple[Row, ...]:
    """``uard`` and ``uard-0.1``, one setting each, T = 100: three agents with +4 and +8 and both panels, others once."""
    return tuple(
        row(
            ours(TrapGrid(size=10, trap_reward=trap, horizon=100), mitigation, agent, panel=as_panel(panel)),
            agent=name,
            trap=trap,
            panel=panel,
            mitigation=mitigation,
        )
        for name, agent in AGENTS.items()
        if name != "cpo-oracle"
        for trap in (4.0, 8.0)
        for panel in PANELS
        if name in EVERYWHERE or (trap, panel) == (8.0, "appendix")
        for mitigation in (EARLIER, OURS)
    )


RIVALS = (*SIMPLE, "screening", EARLIER, OURS)


def rivals() -> tuple[Row, ...]:
    """The other mitigations in the hands of two deep agents, very noisy raters, T = 80; one model of raters for all."""
    return tuple(
        row(
            cell(paper_grid(10), named(mitigation), AGENTS[agent], OURS, panel=as_panel(panel), noise=1.2),
            agent=agent,
            mitigation=mitigation,
            panel=panel,
        )
        for agent in ("ensemble-dqn", "ppo")
        for panel in PANELS
        for mitigation in RIVALS
    )


def ablation() -> tuple[Row, ...]:
    """The component ablation (F5) with deep agents on 6x6, as printed and as repaired."""
    grid = paper_grid(6)
    rows = [
        row(cell(grid, RAW, AGENTS["dqn"]), variant="Baseline", reading="-"),
        row(cell(grid, RAW, ENSEMBLE), variant="Ablation I", reading="-"),
        row(cell(grid, named("no-discount"), ENSEMBLE), variant="Ablation II", reading="-"),
    ]
    for reading in ("uard-paper", "uard-0.1"):
        for variant, parameters in (("UARD-lite", {"beta": 0.0}), ("Human-only", {"alpha": 0.0}), ("UARD", {})):
            rows.append(row(cell(grid, named(reading, **parameters), ENSEMBLE), variant=variant, reading=reading))
    return tuple(rows)


def ensembles() -> tuple[Row, ...]:
    """Kinds of ensembles (K4, K9): does sigma_m know what the agent has not seen, and where it is wrong?"""
    kinds = {
        "full": Ensemble("full", 5),
        "shared": Ensemble("shared", 5),
        "shared, no priors": Ensemble("shared", 5, 0.0),
        "dropout": Ensemble("dropout", 5),
    }
    return tuple(
        row(cell(paper_grid(6), named("no-discount"), DeepQ(ensemble=ensemble)), ensemble=name)
        for name, ensemble in kinds.items()
    )


def feedback() -> tuple[Row, ...]:
    """Running means or a model of the ratings, when 1 %, 10 % or all steps are rated."""
    return tuple(
        row(
            cell(
                paper_grid(10),
                named(mitigation),
                ENSEMBLE,
                rated=rated,
                rating_model=LEARNED[mitigation] if source == "model" else None,
            ),
            source=source,
            rated=rated,
            mitigation=mitigation,
        )
        for mitigation in (EARLIER, OURS)
        for source in ("table", "model")
        for rated in (0.01, 0.1, 1.0)
    )


def distortion() -> tuple[Row, ...]:
    """Agents trained on the true reward, whose reward is distorted afterwards (``uard.replication.distortion``)."""
    honest = TrapGrid(size=6, trap_reward=-1.0)
    return (
        row(cell(honest, named("uard-0.1"), ENSEMBLE), agent="uard-0.1"),
        row(cell(honest, RAW, AGENTS["edac"]), agent="edac"),
        row(cell(honest, RAW, AGENTS["sunrise"]), agent="sunrise"),
    )


def studies() -> tuple[Study, ...]:
    """Return what ``uard reproduce grid-deep`` runs."""
    return (
        Study("deep-baselines", "All agents on the raw reward of 10x10", "H3, H17, F3, G16", baselines(), CURVES),
        Study("deep-competence", "All agents on the true reward of 10x10", "J35, control", competence()),
        Study("deep-uard", "All agents with uard on 10x10", "H3, J15", mitigated()),
        Study("deep-rivals", "Other mitigations in deep agents", "honest competition", rivals()),
        Study("deep-ablation", "Which component does the work, deep", "H8, F5", ablation()),
        Study("deep-ensembles", "Kinds of ensembles", "K4, K9", ensembles(), derive=derive.sigma_m),
        Study("deep-feedback", "A table or a model of the ratings", "A18", feedback()),
        Study(
            "deep-distortion",
            "A distorted reward after training",
            "H13, H15, H16, G12, G14, G15",
            distortion(),
            derive=derive.distorted,
        ),
    )
