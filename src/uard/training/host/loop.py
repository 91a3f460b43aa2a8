"""Training on a simulator: physics on the host, networks in compiled functions, everything resumable to the bit.

A run's whole state is one pytree of arrays (``TrainState``). It is advanced by pieces (a rollout, or some steps with
their updates); between pieces it can be written down and taken up again, and no random number depends on when that
happened.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from uard import _checks
from uard._support import fields
from uard.agents.base import Agent
from uard.envs.base import SimulatedEnvironment
from uard.envs.simulator import Simulator, StepResult, rate
from uard.method.mitigations import Mitigation
from uard.ratings.panels import MAIN, Panel
from uard.training import checkpoint
from uard.training.episode_log import LOG
from uard.training.feedback import transition_model as transitions
from uard.training.feedback.transition_model import QUERIES, TransitionModel

PANEL, ACT, LEARN, MODEL, INIT, EVALUATION = range(6)  # streams of random numbers


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        environment: Where.
        agent: Who learns.
        mitigation: What it does about a reward that may lie.
        seed: Of everything.
        steps: Environment steps, of all copies together, >= 1; the last piece is finished, which may be some more.
        panel: Who rates.
        noise: Extra noise of every rater, in reward units, >= 0.
        rated: Fraction of steps that are rated, in [0, 1].
        rating_model: The model of the ratings.
        ddof: Of the raters' deviation.
        evaluations: Episodes without exploration after training, in [1, 1000].
        query: Which steps are rated; see ``transition_model.chosen``.
    """

    environment: SimulatedEnvironment
    agent: Any
    mitigation: Mitigation
    seed: int = 0
    steps: int = 1_000_000
    panel: Panel = MAIN
    noise: float = 0.0
    rated: float = 0.15
    rating_model: TransitionModel = field(default_factory=TransitionModel)
    ddof: int = 0
    evaluations: int = 8
    query: str = "random"

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            InvalidValueError: naming the field, the value and what is allowed.
        """
        if not isinstance(self.panel, Panel):
            raise _checks.InvalidValueError("panel", self.panel, "a Panel (see uard.ratings.panels.PANELS)")
        for name, kind in (("environment", SimulatedEnvironment), ("agent", Agent), ("mitigation", Mitigation)):
            _checks.instance(name, getattr(self, name), kind, f"a {kind.__name__}")
        fields.check(self)
        _checks.whole("seed", self.seed)
        _checks.whole("ddof", self.ddof, low=0, high=1)
        _checks.number("noise", self.noise, low=0)
        _checks.whole("steps", self.steps, low=1, high=10**12)
        _checks.number("rated", self.rated, low=0, high=1)
        _checks.whole("evaluations", self.evaluations, low=1, high=1000)
        _checks.choose("query", self.query, QUERIES)

    @property
    def asks_raters(self) -> bool:
        """Whether ratings are used at all."""
        return self.mitigation.reads_feedback

    @property
    def fixed(self) -> Fixed:
        """Return what compiled functions need of it."""
        raters = len(self.panel.raters)
        horizon = self.environment.horizon
        return Fixed(self.agent, self.mitigation, self.rating_model, self.asks_raters, raters, horizon)


class Fixed(NamedTuple):
    """What is fixed when a function is compiled; hashable."""

    agent: Any
    mitigation: Mitigation
    rating_model: TransitionModel
    asks_raters: bool
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


class TrainState(NamedTuple):
    """All that a run's future depends on; a pytree of arrays.

    Attributes:
        agent: The learner's state.
        norm: See ``Norm``.
        model: The model of the ratings, or ().
        reservoir: The rated steps, or ().
        extra: What the loop keeps besides: a replay buffer.
        simulator: See ``Simulator.save``.
        sums: (E, len(LOG)), of the running episodes.
        log: (episodes, len(LOG) + 1): sums of the finished ones, and the step at which each ended.
        steps: Environment steps so far.
    """

    agent: Any
    norm: Norm
    model: Any
    reservoir: Any
    extra: Any
    simulator: dict[str, np.ndarray]
    sums: np.ndarray
    log: np.ndarray
    steps: Any


class TrainedRun(NamedTuple):
    """What a run leaves behind.

    Attributes:
        log: (episodes, len(LOG)), in the order in which they ended.
        ends: (episodes,), the environment step at which each ended.
        evaluation: (evaluations, len(LOG) + 1) of the trained agent without exploration; the last column is the task's
            own return.
        state: The last state.
    """

    log: np.ndarray
    ends: np.ndarray
    evaluation: np.ndarray
    state: TrainState


def key_of(seed: int, stream: int, number: int = 0) -> Any:
    """Return a key that depends on nothing but its arguments."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), stream), number)


def generator(seed: int, stream: int, number: int) -> np.random.Generator:
    """Return NumPy's, the same way."""
    return np.random.default_rng([seed, stream, number])


def counted(result: StepResult) -> np.ndarray:
    """Return what steps add to their episodes' rows of the log, (E, len(LOG))."""
    zeros = np.zeros(len(result.reward))
    columns = [result.hack, result.true_reward, result.reward, result.success, zeros + 1.0, zeros]
    return np.stack([np.asarray(c, float) for c in columns], 1)


class EpisodeLog:
    """The log while it is being written. Changed in place."""

    def __init__(self, sums: np.ndarray, steps: int):
        """Go on from the running episodes' sums (E, len(LOG)) at an environment step."""
        self.sums, self.steps, self.rows = sums.copy(), steps, []

    def add(self, result: StepResult) -> None:
        """Add one step of all copies."""
        self.sums += counted(result)
        self.steps += len(self.sums)
        done = result.terminated | result.truncated
        for i in np.nonzero(done)[0]:
            self.rows.append(np.append(self.sums[i], self.steps))
        self.sums[done] = 0.0

    def all(self, log: np.ndarray) -> np.ndarray:
        """Return the log so far, (episodes, len(LOG) + 1)."""
        return np.concatenate([log, np.array(self.rows).reshape(-1, len(LOG) + 1)]) if self.rows else log


def fresh_feedback(job: Job) -> tuple[Any, Any]:
    """Return a fresh model of the ratings and an empty reservoir; () and () for a mitigation that asks nobody."""
    if not job.asks_raters:
        return (), ()
    width, raters = transitions.width(job.environment.features, job.environment.actions), job.fixed.raters
    model = transitions.init(job.rating_model, key_of(job.seed, MODEL), width, raters)
    return model, transitions.empty(job.rating_model, width, raters)


def collect_ratings(job: Job, state: TrainState, steps: list[StepResult], inputs: np.ndarray, number: int) -> None:
    """Put the rated fraction of (T, E) steps to the panel, and keep its ratings in the state's reservoir.

    Args:
        job: The run.
        state: Its state; the reservoir is changed in place.
        steps: T results of E copies.
        inputs: (T, E, width), what the model of ratings sees of them.
        number: Of the piece.
    """
    random = generator(job.seed, PANEL, number)
    flat = inputs.reshape(-1, inputs.shape[-1])

    def knows() -> np.ndarray:
        return np.asarray(transitions.worth(job.rating_model, state.model, flat))

    rated = transitions.chosen(job.query, job.rated, knows, len(flat), random).reshape(inputs.shape[:2])
    ratings = np.stack([rate(job.panel, result, job.noise, random) for result in steps])
    rated &= ~np.isnan(ratings).all(-1)  # a panel in which everybody skipped the step has not rated it
    transitions.keep(state.reservoir, inputs[rated], ratings[rated], random, job.ddof)


class Loop(ABC):
    """How a run starts, how it advances by a piece, and what its agent does and believes.

    Attributes:
        job: The run.
        copies: Of the environment.
    """

    job: Job
    copies: int

    @abstractmethod
    def start(self, simulator: Simulator) -> TrainState:
        """Return the first state."""

    @abstractmethod
    def advance(self, state: TrainState, simulator: Simulator) -> TrainState:
        """Train one piece.

        Raises:
            FloatingPointError: something left the finite numbers.
        """

    @abstractmethod
    def act(self, state: TrainState, observations: np.ndarray) -> np.ndarray:
        """Return the most likely actions at observations (B, features): (B, actions), not clipped."""

    @abstractmethod
    def values(self, state: TrainState, observations: np.ndarray) -> np.ndarray:
        """Return all critics' values of observations under those actions, (N, B)."""


def run(
    loop: Loop,
    path: Path | None = None,
    config: str = "",
    every: int = 50_000,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> TrainedRun:
    """Train, going on from the checkpoint at ``path`` if there is one.

    Examples:
        >>> from uard.agents.networks import SINGLE, Network
        >>> from uard.agents.policy import PPO
        >>> from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
        >>> from uard.method.mitigations import named
        >>> from uard.training.host.loops import loop_of
        >>> agent = PPO(network=Network(hidden=8), ensemble=SINGLE, envs=2, rollout=16)
        >>> job = Job(InvertedPendulum(horizon=20), agent, named("raw"), steps=64, evaluations=3)
        >>> trained = run(loop_of(job))
        >>> int(trained.state.steps), trained.evaluation.shape
        (64, (3, 7))

    Args:
        loop: Of the run; ``uard.training.host.loops.loop_of`` finds it.
        path: Where to keep the checkpoint; nowhere if None.
        config: What the run is, as one line of text, so that no other run's checkpoint is gone on from.
        every: Environment steps between checkpoints.
        progress: Called with (steps done, steps to do).
        stop: Asked after each piece; True writes a checkpoint and raises KeyboardInterrupt.

    Raises:
        KeyboardInterrupt: ``stop`` said so.
        FloatingPointError: a parameter or the physics left the finite numbers; names the quantity and the step. The
            last good checkpoint is kept.
        CheckpointError: the checkpoint is truncated, or of another configuration.
    """
    job = loop.job
    simulator = job.environment.simulator(loop.copies, job.seed)
    try:
        state = loop.start(simulator)
        if path is not None and path.exists():
            state = checkpoint.load(path, config, state)
            simulator.load(state.simulator)
        saved = int(state.steps)
        while state.steps < job.steps:
            try:
                state = loop.advance(state, simulator)
            except FloatingPointError as error:
                where = f"environment step {int(state.steps)} of seed {job.seed}"
                raise FloatingPointError(f"{error} ({where})") from error
            if progress:
                progress(min(int(state.steps), job.steps), job.steps)
            stopped = stop is not None and stop()
            if path is not None and (stopped or state.steps - saved >= every):
                checkpoint.save(path, config, state)
                saved = int(state.steps)
            if stopped:
                raise KeyboardInterrupt
    finally:
        simulator.close()
    return TrainedRun(state.log[:, :-1], state.log[:, -1], evaluate(loop, state), state)


def evaluate(loop: Loop, state: TrainState) -> np.ndarray:
    """Let the trained agent run without exploration, one episode per copy; see ``TrainedRun.evaluation``."""
    job = loop.job
    seed = int(generator(job.seed, EVALUATION, 0).integers(2**63))
    simulator = job.environment.simulator(job.evaluations, seed)
    rows = np.zeros((job.evaluations, len(LOG) + 1))
    going = np.ones(job.evaluations, bool)
    while going.any():
        result = simulator.step(np.clip(loop.act(state, simulator.observe()), -1.0, 1.0))
        # A copy whose episode has ended begins another, which is not counted: each gives one, however long.
        rows[going] += np.column_stack([counted(result), result.task_reward])[going]
        going &= ~(result.terminated | result.truncated)
    simulator.close()
    return rows
