"""Training in MuJoCo: physics on the host, networks in compiled functions, everything resumable to the bit.

A run's whole state is one pytree of arrays (``Live``). It is advanced by pieces (a rollout, or some steps with their
updates); between pieces it can be written down and taken up again, and no random number depends on when that happened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from uard import _checks
from uard.agents.continuous import ContinuousActorCritic
from uard.agents.policy import PolicyGradient
from uard.envs.locomotion import physics as mujoco
from uard.envs.locomotion.physics import Locomotion, Moved, Physics
from uard.method.mitigations import Mitigation
from uard.ratings import panels
from uard.training import checkpoint
from uard.training.episode_log import LOG
from uard.training.feedback import transition_model as transitions
from uard.training.feedback.transition_model import QUERIES, TransitionModel

PANEL, ACT, LEARN, MODEL, INIT, EVALUATION = range(6)  # streams of random numbers


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        spec: Where.
        agent: Who learns.
        mitigation: What it does about a reward that may lie.
        seed: Of everything.
        steps: Environment steps, of all copies together.
        panel: Who rates.
        noise: Extra noise of every rater, in reward units.
        rated: Fraction of steps that are rated.
        feedback: The model of the ratings.
        ddof: Of the annotators' deviation.
        evaluations: Episodes without exploration after training.
        query: Which steps are rated; see ``transitions.chosen``.
    """

    spec: Locomotion
    agent: Any
    mitigation: Mitigation
    seed: int = 0
    steps: int = 1_000_000
    panel: str = "main"
    noise: float = 0.0
    rated: float = 0.15
    feedback: TransitionModel = field(default_factory=TransitionModel)
    ddof: int = 0
    evaluations: int = 8
    query: str = "random"

    def __post_init__(self) -> None:
        """Check the parameters."""
        panels.check(self.panel, self.noise)
        _checks.whole("steps", self.steps, low=1, high=10**12)
        _checks.number("rated", self.rated, low=0, high=1)
        _checks.whole("evaluations", self.evaluations, low=1, high=1000)
        _checks.choose("query", self.query, QUERIES)

    @property
    def listens(self) -> bool:
        """Whether ratings are used at all."""
        return self.mitigation.reads_feedback

    @property
    def fixed(self) -> Fixed:
        """Return what compiled functions need of it."""
        raters = panels.raters(self.panel)
        return Fixed(self.agent, self.mitigation, self.feedback, self.listens, raters, self.spec.horizon)


class Fixed(NamedTuple):
    """What is fixed when a function is compiled; hashable."""

    agent: Any
    mitigation: Mitigation
    feedback: TransitionModel
    listens: bool
    raters: int
    horizon: int


class Norm(NamedTuple):
    """Running mean and variance of the observations, float64 on the host."""

    total: np.ndarray
    mean: np.ndarray
    variance: np.ndarray

    @staticmethod
    def start(features: int) -> Norm:
        """Return that of nothing."""
        return Norm(np.array(1e-4), np.zeros(features), np.ones(features))

    def after(self, observations: np.ndarray) -> Norm:
        """Return it with (B, features) more observations [Chan et al. 1983]."""
        total = self.total + len(observations)
        apart = observations.mean(0) - self.mean
        mixed = self.variance * self.total + observations.var(0) * len(observations)
        variance = (mixed + apart**2 * self.total * len(observations) / total) / total
        return Norm(np.asarray(total), self.mean + apart * len(observations) / total, variance)

    def of(self, observations: np.ndarray) -> np.ndarray:
        """Return observations of mean 0 and deviation 1, within 10, as float32."""
        return np.clip((observations - self.mean) / np.sqrt(self.variance + 1e-8), -10.0, 10.0).astype(np.float32)


class Live(NamedTuple):
    """All that a run's future depends on; a pytree of arrays.

    Attributes:
        agent: The learner's state.
        norm: See ``Norm``.
        model: The model of the ratings, or ().
        reservoir: The rated steps, or ().
        extra: What the loop keeps besides: a replay buffer.
        physics: See ``Physics.save``.
        sums: (E, len(LOG)), of the running episodes.
        log: (episodes, len(LOG) + 1): sums of the finished ones, and the step at which each ended.
        steps: Environment steps so far.
    """

    agent: Any
    norm: Norm
    model: Any
    reservoir: Any
    extra: Any
    physics: dict[str, np.ndarray]
    sums: np.ndarray
    log: np.ndarray
    steps: Any


class Done(NamedTuple):
    """What a run leaves behind.

    Attributes:
        log: (episodes, len(LOG)), in the order in which they ended; ``goal`` is whether the horizon was reached.
        ends: (episodes,), the environment step at which each ended.
        evaluation: (evaluations, len(LOG) + 1) of the trained agent without exploration; the last column is the task's
            own return.
        live: The last state.
    """

    log: np.ndarray
    ends: np.ndarray
    evaluation: np.ndarray
    live: Live


def key_of(seed: int, stream: int, number: int = 0) -> Any:
    """Return a key that depends on nothing but its arguments."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), stream), number)


def generator(seed: int, stream: int, number: int) -> np.random.Generator:
    """Return NumPy's, the same way."""
    return np.random.default_rng([seed, stream, number])


def counted(moved: Moved) -> np.ndarray:
    """Return what steps add to their episodes' rows of the log, (E, len(LOG))."""
    nothing = np.zeros(len(moved.reward))
    columns = [moved.hack, moved.true, moved.reward, moved.truncated, nothing + 1.0, nothing]
    return np.stack([np.asarray(c, float) for c in columns], 1)


class Book:
    """The log while it is being written."""

    def __init__(self, sums: np.ndarray, steps: int):
        """Go on from the running episodes' sums."""
        self.sums, self.steps, self.rows = sums.copy(), steps, []

    def write(self, moved: Moved) -> None:
        """Write one step of all copies down."""
        self.sums += counted(moved)
        self.steps += len(self.sums)
        over = moved.terminated | moved.truncated
        for i in np.nonzero(over)[0]:
            self.rows.append(np.append(self.sums[i], self.steps))
        self.sums[over] = 0.0

    def all(self, log: np.ndarray) -> np.ndarray:
        """Return the log so far."""
        return np.concatenate([log, np.array(self.rows).reshape(-1, len(LOG) + 1)])


def unheard(job: Job) -> tuple[Any, Any]:
    """Return a fresh model of the ratings and a reservoir without any; () and () for who asks nobody."""
    if not job.listens:
        return (), ()
    width, raters = transitions.width(job.spec.features, job.spec.actions), job.fixed.raters
    model = transitions.init(job.feedback, key_of(job.seed, MODEL), width, raters)
    return model, transitions.empty(job.feedback, width, raters)


def record(job: Job, live: Live, steps: list[Moved], inputs: np.ndarray, number: int) -> None:
    """Put the rated fraction of (T, E) steps to the panel, and keep what it says."""
    random = generator(job.seed, PANEL, number)
    flat = inputs.reshape(-1, inputs.shape[-1])

    def knows() -> np.ndarray:
        return np.asarray(transitions.worth(job.feedback, live.model, flat))

    rated = transitions.chosen(job.query, job.rated, knows, len(flat), random).reshape(inputs.shape[:2])
    said = np.stack([mujoco.rate(job.panel, moved, job.noise, random) for moved in steps])
    transitions.keep(live.reservoir, inputs[rated], said[rated], random, job.ddof)


class Loop(NamedTuple):
    """How a run starts, how it advances by a piece, and what its agent does and believes.

    Attributes:
        copies: Of the robot.
        start: Gives the first state.
        advance: Trains one piece.
        act: The most likely actions at observations (B, features): (B, motors), not clipped.
        values: All critics' opinions of observations' values under those actions, (N, B).
    """

    copies: int
    start: Callable[[Physics], Live]
    advance: Callable[[Live, Physics], Live]
    act: Callable[[Live, np.ndarray], np.ndarray]
    values: Callable[[Live, np.ndarray], np.ndarray]


def bind(job: Job) -> Loop:
    """Return a run's loop.

    Raises:
        InvalidValueError: the agent cannot move motors.
    """
    from uard.training.host import off_policy as host_off_policy
    from uard.training.host import on_policy as host_on_policy

    if isinstance(job.agent, PolicyGradient):
        return host_on_policy.bind(job)
    if isinstance(job.agent, ContinuousActorCritic):
        return host_off_policy.bind(job)
    able = "one for continuous actions: PPO, TRPO, CPO, SAC, CQL, EDAC, SUNRISE"
    raise _checks.InvalidValueError("agent", job.agent, able)


def run(
    job: Job,
    path: Path | None = None,
    config: str = "",
    every: int = 50_000,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Done:
    """Train, going on from the checkpoint at ``path`` if there is one.

    Args:
        job: The run.
        path: Where to keep the checkpoint; nowhere if None.
        config: What the run is, as text, so that no other run's checkpoint is gone on from.
        every: Environment steps between checkpoints.
        progress: Called with (steps done, steps to do).
        stop: Asked after each piece; True writes a checkpoint and raises KeyboardInterrupt.

    Raises:
        FloatingPointError: a parameter or the physics left the finite numbers; names the quantity and the step. The
            last good checkpoint is kept.
        CheckpointError: the checkpoint is truncated, or of another configuration.
    """
    loop = bind(job)
    physics = Physics(job.spec, loop.copies, job.seed)
    try:
        live = loop.start(physics)
        if path is not None and path.exists():
            live = checkpoint.load(path, config, live)
            physics.load(live.physics)
        saved = int(live.steps)
        while live.steps < job.steps:
            try:
                live = loop.advance(live, physics)
            except FloatingPointError as error:
                raise FloatingPointError(f"{error} (environment step {int(live.steps)} of seed {job.seed})") from error
            if progress:
                progress(min(int(live.steps), job.steps), job.steps)
            stopped = stop is not None and stop()
            if path is not None and (stopped or live.steps - saved >= every):
                checkpoint.save(path, config, live)
                saved = int(live.steps)
            if stopped:
                raise KeyboardInterrupt
    finally:
        physics.close()
    return Done(live.log[:, :-1], live.log[:, -1], evaluate(job, live, loop.act), live)


def evaluate(job: Job, live: Live, act: Callable[[Live, np.ndarray], np.ndarray]) -> np.ndarray:
    """Let the trained agent run without exploration, one episode per copy."""
    physics = Physics(job.spec, job.evaluations, int(generator(job.seed, EVALUATION, 0).integers(2**63)))
    rows = np.zeros((job.evaluations, len(LOG) + 1))
    going = np.ones(job.evaluations, bool)
    while going.any():
        moved = physics.step(np.clip(act(live, physics.observe()), -1.0, 1.0))
        rows[going] += np.column_stack([counted(moved), moved.task])[going]
        going &= ~(moved.terminated | moved.truncated)
    return rows
