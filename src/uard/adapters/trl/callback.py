"""The callback of the TRL adapter; a file of its own, because it alone needs transformers."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

try:
    from transformers import TrainerCallback
    from transformers.trainer_utils import PREFIX_CHECKPOINT_DIR
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"ReliabilityCallback needs transformers: pip install 'uard[trl]' ({error})", name=error.name
    ) from error

from uard import _checks
from uard.adapters.trl.advantages import keeps_factor
from uard.adapters.trl.reward import UncertaintyDiscountedReward, UselessJudgeWarning

log = logging.getLogger(__name__)

ENOUGH_GROUPS = 16  # discounted groups before a verdict about normalisation
AGREED = 1e-6  # largest sigma_h, in standard deviations of a judge, at which judges count as one


class DiscountCancelledWarning(UserWarning):
    """Normalisation takes the discount out of the advantages again."""


class ForgottenWarning(UserWarning):
    """Training goes on from a checkpoint that does not hold what the reward knew."""


class ReliabilityCallback(TrainerCallback):
    """Watches an ``UncertaintyDiscountedReward`` during training: warns (each warning once), and reports at the end.

    It warns of normalisation that cancels the discount (more than half of the groups that are discounted have nearly
    the same advantages without it, under this trainer's configuration), of a judge that never varies or never scores,
    of judges that never disagree, and of a reward that the trainer does not call. What the reward knows is kept in
    every checkpoint, as numbers, and read again when training is resumed. From completions of an evaluation it learns
    nothing: the trainer's model is not in training mode then.

    Examples:
        >>> def length(completions, **question):
        ...     return [len(text) for text in completions]
        >>> def clarity(completions, **question):
        ...     return [-text.count("um") for text in completions]
        >>> reward = UncertaintyDiscountedReward([length, clarity])
        >>> callback = ReliabilityCallback(reward)  # GRPOTrainer(..., reward_funcs=reward, callbacks=[callback])
        >>> learned = reward(["why?"] * 2, ["so", "um, so"])
        >>> print(callback.report().splitlines()[0])
        2 completions, 0 without any score, 0 that could not be checked; mean weight ...

    Attributes:
        reward: What is watched.
        patience: Completions before a judge is called useless.
    """

    def __init__(self, reward: UncertaintyDiscountedReward, patience: int = 256):
        """Watch a reward.

        Args:
            reward: The one that the trainer has among its ``reward_funcs``.
            patience: See the attribute; >= 1.

        Raises:
            InvalidValueError: for another kind of reward.
        """
        allowed = "an UncertaintyDiscountedReward"
        self.reward = _checks.instance("reward", reward, UncertaintyDiscountedReward, allowed)
        _checks.whole("patience", patience, low=1)
        self.patience = patience
        self._warned: set[str] = set()

    def on_init_end(self, args: Any, state: Any, control: Any, model: Any = None, **kwargs: Any) -> None:
        """Let the reward learn only while the trainer's model is in training mode."""
        self.reward.follow(model)

    def on_train_begin(self, args: Any, state: Any, control: Any, model: Any = None, **kwargs: Any) -> None:
        """Log what this configuration leaves of the discount; if training is resumed, restore what the reward knew.

        Raises:
            InvalidValueError: what the checkpoint keeps is damaged or of other judges, or a pickle of version 0.1.
        """
        self.reward.follow(model)  # now it may be wrapped
        factor = "survives" if keeps_factor(args) else "is lost: advantages are divided by the deviation of their group"
        log.info("a weight that all completions of a prompt share %s", factor)
        if state.global_step == 0:
            return
        file = _file(args, state)
        if file.exists():
            self.reward.load(file)
        elif (old := file.with_suffix(".pkl")).exists():
            allowed = f"{file.name}; a pickle executes what it holds and is not read: delete it to go on without"
            raise _checks.InvalidValueError("what the reward knew", str(old), allowed)
        else:
            warnings.warn(
                f"training is resumed at step {state.global_step}, but {file} does not exist: the judges' scales and "
                "their mean disagreement start again from nothing",
                ForgottenWarning,
                stacklevel=2,
            )

    def on_save(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        """Keep what the reward knows beside the checkpoint's other files."""
        file = _file(args, state)
        file.parent.mkdir(parents=True, exist_ok=True)
        self.reward.save(file)

    def on_step_end(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        """Warn, if there is reason to."""
        tally = self.reward.tally
        if tally.completions == 0:
            self._warn(
                "the reward that ReliabilityCallback watches has not been called: is it this very object that the "
                "trainer has in reward_funcs, and in this process?",
                UselessJudgeWarning,
            )
        if tally.discounted >= ENOUGH_GROUPS and 2 * tally.shifted > tally.discounted:
            self._warn(
                "the discount has no effect: in most groups that are doubted (mean weight below 0.9) it lowers the "
                "rewards of all completions alike, and the mean of a group is subtracted from them. The judges "
                "disagree about prompts, not about completions",
                DiscountCancelledWarning,
            )
        elif not keeps_factor(args) and tally.discounted >= ENOUGH_GROUPS and 2 * tally.cancelled > tally.discounted:
            self._warn(
                "group normalisation cancels the discount: most groups that are doubted (mean weight below 0.9) have "
                "the same advantages without it, because the rewards of all completions shrink alike. Use "
                "scale_rewards='batch' or 'none' with multi_objective_aggregation='sum_then_normalize'",
                DiscountCancelledWarning,
            )
        if tally.completions >= self.patience:
            self._warn_of_judges()

    def on_train_end(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        """Report to the log."""
        log.info("%s", self.report())

    def report(self) -> str:
        """Return a summary of all completions so far, as text."""
        tally = self.reward.tally
        scored = tally.completions - tally.unscored
        lines = [
            f"{tally.completions} completions, {tally.unscored} without any score, {tally.unchecked} that could not be "
            f"checked; mean weight {tally.weight / max(scored, 1):.2f}",
            f"{tally.discounted} groups discounted; of these {tally.cancelled} have the same advantages without the "
            f"discount if they are divided by the group's deviation, {tally.shifted} also if not",
        ]
        for name, deviation in self.reward.deviations.items():
            line = f"judge {name}: deviation {deviation:.3g}, {tally.missing[name]} scores missing"
            line += f", late for {tally.late[name]} batches" if tally.late[name] else ""
            line += f", raised on {tally.failed[name]} batches" if tally.failed[name] else ""
            line += f", {tally.absurd[name]} absurd scores" if tally.absurd[name] else ""
            line += ", never tells the completions of a prompt apart" if tally.never_tells_apart(name) else ""
            lines.append(line)
        return "\n".join(lines)

    def _warn_of_judges(self) -> None:
        tally = self.reward.tally
        for name, deviation in self.reward.deviations.items():
            if tally.missing[name] == tally.completions:
                self._warn(f"judge {name!r} has not scored any completion", UselessJudgeWarning)
            elif deviation == 0:
                self._warn(f"judge {name!r} gives every completion the same score", UselessJudgeWarning)
        if tally.widest < AGREED:
            self._warn(
                "the judges have never disagreed: sigma_h is 0 and the reward is trusted blindly. Are they copies of "
                "one another?",
                UselessJudgeWarning,
            )

    def _warn(self, message: str, category: type[UserWarning]) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, category, stacklevel=2)


def _file(args: Any, state: Any) -> Path:
    folder = f"{PREFIX_CHECKPOINT_DIR}-{state.global_step}"
    return Path(args.output_dir) / folder / f"uard_reward_{args.process_index}.json"
