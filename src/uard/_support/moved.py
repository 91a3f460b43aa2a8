"""Modules that have moved: importing one under its old name is an error that says what it is called now."""

from __future__ import annotations

import sys
from typing import Any

MODULES = {
    "abstention": "method.abstention",
    "adaptation": "method.adaptation",
    "adapters._judges": "judges.asking",
    "adapters._trl_callback": "adapters.trl.callback",
    "bellman": "method.bellman",
    "calibration": "method.calibration",
    "ensemble": "adapters.reward_ensemble",
    "envs.classic_world": "envs.classic.world",
    "envs.gaming": "envs.grids.gaming",
    "envs.gaming_world": "envs.grids.tomato_world",
    "envs.gym_gaming": "envs.gym.grids",
    "envs.gym_mujoco": "envs.gym.simulated",
    "envs.learned_reward": "envs.grids.learned_reward",
    "envs.mujoco": "envs.locomotion",
    "envs.panels": "ratings.panels",
    "envs.spec": "envs.base",
    "envs.tabular": "envs.tables",
    "envs.trapgrid": "envs.grids.trapgrid",
    "feedback": "training.feedback",
    "feedback.learned": "training.feedback.rating_model",
    "feedback.running": "ratings.aggregate",
    "feedback.transitions": "training.feedback.transition_model",
    "lab.claims": "lab.execution.claims",
    "lab.cluster": "lab.execution.cluster",
    "lab.examine": "lab.trainers.examine",
    "lab.finish": "lab.trainers",
    "lab.forecast": "lab.execution.forecast",
    "lab.names": "lab.registry",
    "lab.runner": "lab.execution.runner",
    "lab.store": "lab.execution.store",
    "logs": "ratings.readers",
    "mitigation": "method.mitigations",
    "networks": "agents.networks",
    "reliability": "method.weights",
    "reporting": "lab.views",
    "reporting.audit": "replication.audit",
    "reporting.compare": "lab.views.compare",
    "reporting.deep": "replication.deep",
    "reporting.distortion": "replication.distortion",
    "reporting.evidence": "lab.views.study_results",
    "reporting.figures": "replication.figures",
    "reporting.leaderboard": "lab.views.leaderboard",
    "reporting.ledger": "replication.ledger",
    "reporting.locomotion": "replication.locomotion",
    "reporting.overoptimisation": "lab.views.best_of_n",
    "reporting.page": "lab.views.page",
    "reporting.paper": "replication.paper",
    "reporting.published": "lab.views.published",
    "reporting.status": "lab.views.status",
    "reporting.tables": "lab.views.tables",
    "reporting.tensorboard": "lab.views.tensorboard",
    "reporting.theory": "replication.theory",
    "stability": "method.stability",
    "statistics": "lab.statistics",
    "stream": "ratings.stream",
    "studies": "lab.studies",
    "studies.best_of_n": "lab.studies.best_of_n",
    "studies.deep": "replication.studies.deep",
    "studies.locomotion": "replication.studies.locomotion",
    "studies.ours": "lab.studies.grids",
    "studies.own": "lab.studies.plugins",
    "studies.paper": "replication.studies.grids",
    "training.deep": "training.compiled.common",
    "training.fused": "training.compiled.tabular",
    "training.host_off_policy": "training.host.off_policy",
    "training.host_on_policy": "training.host.on_policy",
    "training.lanes": "training.compiled.runs",
    "training.off_policy": "training.compiled.off_policy",
    "training.on_policy": "training.compiled.on_policy",
    "uncertainty": "method.uncertainty",
}
NAMES = {
    "adaptation.standing": "method.adaptation.z_score",
    "envs.gym_gaming.GamingEnv": "envs.gym.GridEnv",
    "envs.gym_mujoco.LocomotionEnv": "envs.gym.SimulatedEnv",
    "envs.mujoco.Posture": "envs.locomotion.regions.Posture",
    "envs.mujoco.Vibration": "envs.locomotion.regions.Vibration",
    "envs.panels.ratings": "ratings.panels.Panel.law",
    "envs.panels.say": "ratings.panels.answers",
    "envs.spec.Spec": "envs.base.Environment",
    "lab.cell.RESULTS": "lab.config.FORMAT",
    "lab.claims.BEAT": "lab.execution.claims.HEARTBEAT",
    "lab.runner.batches": "lab.execution.batching.batches",
    "lab.runner.train_batch": "lab.execution.training.train_batch",
    "lab.store.Run": "lab.execution.store.WorkerRun",
    "lab.store.give_sign": "lab.execution.store.record_heartbeat",
    "logs.RatingLog": "ratings.log.RatingLog",
    "logs.rollout": "ratings.rollout.rollout",
    "mitigation.Usual": "method.mitigations.PanelStatistics",
    "mitigation.measure_usual": "method.mitigations.panel_statistics.fit",
    "reliability.namespace": "method.arrays.namespace",
    "statistics.krippendorff_alpha": "ratings.agreement.krippendorff_alpha",
    "training.lanes.LOG": "training.episode_log",
    "uncertainty.Spread": "method.uncertainty.Location",
    "uncertainty.spread": "method.uncertainty.location_and_mad",
}
"""Names of those modules that went elsewhere, or are called something else."""


class MovedModuleError(ModuleNotFoundError):
    """A module of uard that has another name now; the message says which."""


class _Finder:
    """The last of the finders: asked only for what is not there."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        old = name.removeprefix("uard.")
        if old == name or old not in MODULES:
            return
        message = f"{name} is called uard.{MODULES[old]} now"
        parts = {a: b for a, b in (MODULES | NAMES).items() if a.startswith(f"{old}.")}
        if parts:
            message += "; of what was in it, " + ", ".join(f"uard.{a} is uard.{b}" for a, b in parts.items())
        raise MovedModuleError(message, name=f"uard.{MODULES[old]}")  # not the old name, or from-imports would hide it


def install() -> None:
    """Have imports of modules that have moved say so."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())
