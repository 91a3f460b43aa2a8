"""Hopper and Walker2d with a reward that lies (H4, H11-H16; G6, G7, G10-G15), in three sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from uard.agents.networks import Ensemble
from uard.agents.policy import PolicyGradient
from uard.envs.locomotion.locomotion import Kick, Locomotion
from uard.envs.locomotion.regions import Posture, Vibration
from uard.lab.cell import Cell
from uard.lab.registry import continuous_agents
from uard.lab.studies.common import LOCOMOTION_STEPS, PANELS, RAW
from uard.lab.study import Row, Study, row
from uard.method.mitigations import named
from uard.ratings.panels import as_panel
from uard.replication.studies import derive
from uard.training.feedback.transition_model import QUERIES, TransitionModel

REGIONS = {"vibration": Vibration, "posture": Posture}
RATED = 0.15
RATINGS = TransitionModel(predicts="ratings")
EARLY = 100  # few agents of the smaller sizes still stand at step 500
NOISE_UNIT = Vibration().bonus  # the paper's noise is in per cent, of what it does not say: of the bonus, here
RIVALS = ("mean-of-annotations", "worst-of-annotations", "lcb")


def _cell(environment: Locomotion, mitigation: Any, agent: Any, steps: int, rated: float = RATED, **more: Any) -> Cell:
    # The model of version 0.1, with which all of these were trained.
    return Cell(environment, mitigation, agent, rated=rated, steps=steps, rating_model=RATINGS, **more)


def _panels(mitigation: str) -> tuple[str, ...]:
    """Return all panels, or one for who does not listen."""
    return PANELS if named(mitigation).reads_feedback else PANELS[:1]


@dataclass(frozen=True)
class Scale:
    """How much of the studies is run.

    Attributes:
        name: Of the size.
        steps: Environment steps of the policy family.
        critic_steps: Of the actor-critic family.
        small: Whether networks and batches are a CPU's (64, 128) or the published ones (256, 256).
        names: Of the agents.
        robots: Which.
    """

    name: str
    steps: int
    critic_steps: int
    small: bool
    names: tuple[str, ...]
    robots: tuple[str, ...] = ("hopper", "walker2d")

    @property
    def agents(self) -> dict[str, tuple[Any, int]]:
        """Return agents and their budgets by name."""
        every = continuous_agents(self.small)
        return {
            n: (every[n], self.steps if isinstance(every[n], PolicyGradient) else self.critic_steps) for n in self.names
        }


ALL = tuple(name for name in continuous_agents() if name != "cpo-oracle")
SMOKE = Scale("smoke", 4_096, 2_560, True, ("ppo", "sac"), ("hopper",))
STANDARD = Scale("standard", LOCOMOTION_STEPS, 50_000, True, ALL)
PAPER = Scale("paper", 1_000_000, 1_000_000, False, ALL)


def hacking(scale: Scale) -> tuple[Row, ...]:
    """Raw, as printed and repaired, beside the agent trained on the true reward (B9) and the uncorrupted task."""
    rows = []
    for robot in scale.robots:
        plain = Locomotion(robot, region=None)
        for name, (agent, steps) in scale.agents.items():
            for mitigation in ("raw", "uard-0.1"):
                cell = _cell(plain, named(mitigation), agent, steps)
                rows.append(row(cell, robot=robot, region="none", agent=name, mitigation=mitigation, panel="main"))
            for which, region in REGIONS.items():
                lies = Locomotion(robot, region=region())
                honest = Locomotion(robot, region=region(), reference=True)
                for label, where, mitigation, panel in (
                    ("true reward", honest, RAW, "main"),
                    ("raw", lies, RAW, "main"),
                    *((m, lies, named(m), p) for m in ("uard-paper", "uard-0.1") for p in PANELS),
                ):
                    cell = _cell(where, mitigation, agent, steps, panel=as_panel(panel))
                    rows.append(row(cell, robot=robot, region=which, agent=name, mitigation=label, panel=panel))
    return tuple(rows)


def bonuses(scale: Scale) -> tuple[Row, ...]:
    """How large a bonus breaks which mitigation: 4, 6 and 8, Hopper, PPO."""
    agent, steps = scale.agents["ppo"]
    return tuple(
        row(
            _cell(Locomotion(region=region(bonus=bonus)), named(mitigation), agent, steps, panel=as_panel(panel)),
            region=which,
            bonus=bonus,
            mitigation=mitigation,
            panel=panel,
        )
        for which, region in REGIONS.items()
        for bonus in (4.0, 6.0, 8.0)
        for mitigation in ("raw", "uard-operator", "uard-0.1")
        for panel in _panels(mitigation)
    )


def noise(scale: Scale) -> tuple[Row, ...]:
    """Violations against rater noise of 0, 10, 20 and 30 % of the bonus (G11), Hopper, vibration.

    PPO and SAC by themselves, which hear nothing of it, and with ``uard-0.1``; PPO also with what else listens to raters.
    """
    compared = {"ppo": ("raw", "uard-0.1", *RIVALS), "sac": ("raw", "uard-0.1")}
    return tuple(
        row(
            _cell(Locomotion(), named(mitigation), agent, steps, noise=share * NOISE_UNIT),
            agent=name,
            mitigation=mitigation,
            noise=share,
        )
        for name, (agent, steps) in scale.agents.items()
        for mitigation in compared.get(name, ())
        for share in (0.0, 0.1, 0.2, 0.3)
    )


def kick(scale: Scale) -> tuple[Row, ...]:
    """A state thrown off by +5 (G10): one coordinate, and all; at the paper's step 500, and early for beginners."""
    agent, steps = scale.agents["ppo"]
    kicks: list[tuple[str, int, Kick | None]] = [("never", 0, None)]
    for step in (500, EARLY):
        kicks += [("forward velocity", step, Kick(step)), ("all", step, Kick(step, coordinate=None))]
    return tuple(
        row(
            _cell(Locomotion(kick=kick), named(mitigation), agent, steps),
            mitigation=mitigation,
            kicked=kicked,
            at=step,
        )
        for mitigation in ("raw", "uard-0.1")
        for kicked, step, kick in kicks
    )


def drift(scale: Scale) -> tuple[Row, ...]:
    """PPO over its training (G6, G7), and kicked afterwards (G10): both robots, vibration, main panel."""
    agent, steps = scale.agents["ppo"]
    return tuple(
        row(_cell(Locomotion(robot), named(mitigation), agent, steps), robot=robot, mitigation=mitigation)
        for robot in scale.robots
        for mitigation in ("raw", "uard-paper", "uard-0.1")
    )


def ablation(scale: Scale) -> tuple[Row, ...]:
    """H8 in its continuous form: which source does the work; and what a SAC gains whose actor climbs the score, too."""
    both: dict[str, Any] = {"both sources": {}}
    variants = {
        "ppo": both | {"sigma_h only": {"alpha": 0.0}, "sigma_m only": {"beta": 0.0}},
        "sac": both | {"both sources, reward and score": {"acts_on": "both"}},
    }
    return tuple(
        row(
            _cell(
                Locomotion(region=region()), named("uard-0.1", **changes), *scale.agents[name], panel=as_panel(panel)
            ),
            agent=name,
            region=which,
            variant=variant,
            panel=panel,
        )
        for name, several in variants.items()
        for which, region in REGIONS.items()
        for variant, changes in several.items()
        for panel in PANELS
    )


def distortion(scale: Scale) -> tuple[Row, ...]:
    """Agents trained on the true reward, whose reward is distorted afterwards (``uard.lab.trainers.examine``)."""
    honest = Locomotion(region=None, reference=True)
    every = continuous_agents(scale.small)
    full = replace(every["ensemble-sac"], ensemble=Ensemble("full", 5))
    return tuple(
        row(
            _cell(honest, mitigation, agent, scale.steps if agent is every["ppo"] else scale.critic_steps),
            agent=name,
            critics=critics,
        )
        for name, critics, agent, mitigation in (
            ("uard-0.1", "5, shared trunk", every["ensemble-sac"], named("uard-0.1")),
            ("uard-0.1", "5, full", full, named("uard-0.1")),
            ("uard-0.1 (ppo)", "5, shared trunk", every["ppo"], named("uard-0.1")),
            ("edac", "5, full", every["edac"], RAW),
            ("sunrise", "5, shared trunk", every["sunrise"], RAW),
        )
    )


def legitimate(scale: Scale) -> tuple[Row, ...]:
    """Twins whose bonus is real: what caution costs where there is nothing to prevent. Hopper, PPO."""
    agent, steps = scale.agents["ppo"]
    return tuple(
        row(
            _cell(Locomotion(region=region(), legitimate=True), named(mitigation), agent, steps, panel=as_panel(panel)),
            region=which,
            mitigation=mitigation,
            panel=panel,
        )
        for which, region in REGIONS.items()
        for mitigation in ("raw", "uard-0.1")
        for panel in _panels(mitigation)
    )


def caution(scale: Scale) -> tuple[Row, ...]:
    """What listening costs where nothing lies, and which part of it does: Hopper, PPO, main panel."""
    agent, steps = scale.agents["ppo"]
    plain = Locomotion(region=None)
    variants: dict[str, tuple[str, dict[str, Any], float]] = {
        "raw": ("raw", {}, RATED),
        "uard-0.1": ("uard-0.1", {}, RATED),
        "uard-0.1, every step rated": ("uard-0.1", {}, 1.0),
        "uard-0.1, sigma_h only": ("uard-0.1", {"alpha": 0.0}, RATED),
        "uard-0.1, sigma_m only": ("uard-0.1", {"beta": 0.0}, RATED),
        "mean-of-annotations": ("mean-of-annotations", {}, RATED),
        "worst-of-annotations": ("worst-of-annotations", {}, RATED),
    }
    return tuple(
        row(_cell(plain, named(mitigation, **changes), agent, steps, rated=rated), learns_from=label)
        for label, (mitigation, changes, rated) in variants.items()
    )


def rating(scale: Scale) -> tuple[Row, ...]:
    """Which steps are rated: at random, or half of them where the model of ratings knows least. Hopper, PPO."""
    agent, steps = scale.agents["ppo"]
    return tuple(
        row(
            _cell(Locomotion(region=region()), named("uard-0.1"), agent, steps, panel=as_panel(panel), query=query),
            region=which,
            panel=panel,
            query=query,
        )
        for which, region in REGIONS.items()
        for panel in PANELS
        for query in QUERIES
    )


def studies(scale: Scale) -> tuple[Study, ...]:
    """Return the studies of a size."""
    of = f"mujoco-{scale.name}"
    return (
        Study(f"{of}-hacking", f"Hacking in MuJoCo, {scale.name}", "H4, G6, G7, J16, J36", hacking(scale)),
        Study(f"{of}-bonuses", f"Bonuses of 4, 6 and 8, {scale.name}", "DESIGN: what breaks which", bonuses(scale)),
        Study(f"{of}-noise", f"Violations against noise, {scale.name}", "H11, G11, J25", noise(scale)),
        Study(f"{of}-kick", f"A kick, {scale.name}", "H12, G10", kick(scale)),
        Study(
            f"{of}-drift",
            f"Over the training, and a kick after it, {scale.name}",
            "H4, H12, G6, G7, G10",
            drift(scale),
            derive=derive.drifting,
        ),
        Study(f"{of}-ablation", f"Which source does the work in MuJoCo, {scale.name}", "H8", ablation(scale)),
        Study(f"{of}-legitimate", f"Bonuses that are real, {scale.name}", "over-caution", legitimate(scale)),
        Study(f"{of}-caution", f"What listening costs, {scale.name}", "over-caution", caution(scale)),
        Study(f"{of}-rating", f"Which steps are rated, {scale.name}", "DESIGN: active rating", rating(scale)),
        Study(
            f"{of}-distortion",
            f"A distorted reward after training in MuJoCo, {scale.name}",
            "H13-H16, G12-G15",
            distortion(scale),
            derive=derive.reactions,
        ),
    )
