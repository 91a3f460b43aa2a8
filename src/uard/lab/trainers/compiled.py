"""Deep agents in compiled worlds: some runs in one compiled program."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from uard.envs.tables import HiddenTruth, Task
from uard.lab.result import DivergedError, Result
from uard.lab.trainers.base import Finish, Trainer
from uard.lab.trainers.tabular import calibration_of, place_of_tables
from uard.method import calibration
from uard.ratings.aggregate import aggregate
from uard.ratings.panels import draw
from uard.training.feedback.rating_model import RatingModel

if TYPE_CHECKING:
    from uard.lab.cell import Cell


class Compiled(Trainer):
    """What both kinds have in common."""

    kinds = ("tables", "world")
    at_once = 5  # some ten seconds of work
    rating_models = {"model": RatingModel(), "table": None}  # noqa: RUF012 (read only)

    @abstractmethod
    def loop(self) -> Callable[[Any, Any], Any]:
        """Return the training loop of one run."""

    def place(self, environment: Any) -> Hashable:
        """Return the shape of tables; of another world everything but its numbers with a fraction."""
        return place_of_tables(environment) if environment.kind == "tables" else super().place(environment)

    def cost(self, cell: Cell) -> float:
        """Return the most environment steps, each a thousand times as long as a tabular agent's."""
        return (cell.environment.horizon or 0) * cell.episodes * 1000

    def train(self, batch: Sequence[tuple[Cell, int]], folder: Path | None = None) -> list[Finish]:
        """Train a batch."""
        from uard.training.compiled import common, runs
        from uard.training.xla import keep_programs, make_room

        keep_programs()
        first = batch[0][0]
        make_room(self.program(first))
        worlds = {cell: cell.environment.world(cell.panel, cell.noise) for cell, _ in batch}
        several = [common.make_run(worlds[c], c.agent, c.mitigation, seed, c.rated, _model_of(c)) for c, seed in batch]
        program = common.Program(first.episodes, ddof=first.ddof)
        trained = runs.train(several, self.loop(), program, common.TrainedAgent._fields, common.ROOM)
        return [partial(_finish, cell, seed, out) for (cell, seed), out in zip(batch, trained, strict=True)]


@final
class CompiledReplay(Compiled):
    """Deep agents that learn from a replay buffer."""

    name = "compiled-replay"
    version = 1
    families = ("replay",)

    def loop(self) -> Callable[[Any, Any], Any]:
        """Return the replay loop."""
        from uard.training.compiled import off_policy

        return off_policy.train_one


@final
class CompiledRollout(Compiled):
    """Deep agents that learn from what they just did."""

    name = "compiled-rollout"
    version = 1
    families = ("rollout",)

    def loop(self) -> Callable[[Any, Any], Any]:
        """Return the rollout loop."""
        from uard.training.compiled import on_policy

        return on_policy.train_one


def _model_of(cell: Cell) -> RatingModel | None:
    return cell.rating_model if isinstance(cell.rating_model, RatingModel) else None


def _finish(cell: Cell, seed: int, out: dict[str, Any]) -> Result:
    """Turn a trained run into a result; calibration of what was learned of the raters where there are tables.

    Raises:
        DivergedError: the run diverged.
    """
    _check_sound(cell, seed, out)
    extra: dict[str, np.ndarray] = {}
    slots, rewards = out["walk"]
    path = np.zeros(0, np.int32)
    if cell.environment.kind == "tables":
        task, truth = cell.environment.task(), cell.environment.truth()
        path = _walked(task, slots)
        extra["tables"] = _tables(task, out)
        if cell.mitigation.reads_feedback:
            extra |= _knowledge(cell, task, truth, out)
    else:
        extra["walk_return"] = np.asarray(rewards.sum(), np.float32)
    return Result(out["log"][: int(out["episodes"])], int(out["steps"]), path, extra)


def _check_sound(cell: Cell, seed: int, out: dict[str, Any]) -> None:
    from uard.training.compiled.common import QUANTITIES

    if out["fault"]:
        quantity, step, good = QUANTITIES[int(out["fault"])], int(out["fault_step"]), int(out["good_step"])
        raise DivergedError(
            f"training diverged: {quantity} at step {step} of seed {seed} was not finite or beyond all measure; all "
            f"was well at step {good}: {cell}",
            f"{cell.key}-{seed}-{good}",
            _arrays_by_place(out["good"]),
        )
    if not np.isfinite(out["log"][: int(out["episodes"])]).all():
        raise DivergedError(
            f"training diverged: the reward of seed {seed} was not finite: {cell}", f"{cell.key}-{seed}"
        )


def _arrays_by_place(tree: Any) -> dict[str, np.ndarray]:
    """Return a pytree's arrays by their place in it."""
    import jax

    return {jax.tree_util.keystr(path).lstrip("."): np.asarray(x) for path, x in jax.tree.leaves_with_path(tree)}


def _walked(task: Task, slots: np.ndarray) -> np.ndarray:
    """Return the states of a walk given as state-actions, -1 after its end; the last state included."""
    states, actions = np.divmod(slots[slots >= 0], task.next_state.shape[1])
    if not len(states):
        return np.zeros(0, np.int32)
    return np.append(states, task.next_state[states[-1], actions[-1]]).astype(np.int32)


def _tables(task: Task, out: dict[str, Any]) -> np.ndarray:
    """What the trained agent holds of every state-action, (S, A, len(TABLES)): its raters, its ensemble."""
    states, actions = task.next_state.shape
    rated = np.asarray(out["rated"])
    rated = rated.reshape(-1, actions) if rated.size > 1 else np.zeros((states, actions))
    f = out["feedback"]
    columns = [f.count, f.mean, f.lowest, f.sd, f.proxy, *out["values"], rated]
    return np.stack([np.asarray(c)[:states] for c in columns], axis=-1).astype(np.float32)


def _knowledge(cell: Cell, task: Task, truth: HiddenTruth, out: dict[str, Any]) -> dict[str, np.ndarray]:
    """Calibration of what was learned of the raters: of sigma_h, and of the predicted ratings, rated and not."""
    states, actions = task.next_state.shape
    known = out["feedback"].map(lambda x: np.asarray(x)[:states].astype(float))
    rated = np.asarray(out["rated"]).reshape(-1, actions)[:states] > 0
    calibrated = calibration_of(known._replace(count=rated.astype(float)), truth)
    law = cell.environment.rating_law(cell.panel, cell.noise)
    repeated = law._replace(centre=np.broadcast_to(law.centre, (500, *law.centre.shape)))
    visits = aggregate(draw(repeated, np.random.default_rng(0)), np.zeros((500, *rated.shape)))
    errors = []
    for got, meant in ((known.mean, law.centre.mean(-1)), (known.sd, visits.sd.mean(0))):
        for where in (rated, ~rated):
            errors.append(np.sqrt(np.mean((got - meant)[where] ** 2)) if where.any() else 0.0)
    both = bool(rated.any() and not rated.all())
    errors.append(calibration.auroc(known.count.ravel(), rated.ravel()) if both else 0.5)
    return {"calibration": calibrated, "rating_error": np.array(errors, np.float32)}
