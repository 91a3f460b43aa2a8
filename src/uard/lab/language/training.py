"""One run: a language model is taught, answers are compared, reward models learn, and GRPO follows their panel."""

from __future__ import annotations

import hashlib
import json
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from uard import _checks
from uard._support import files
from uard.judges import JudgePanel, ScoreLog, fit
from uard.lab.language import models
from uard.lab.language.setting import Grpo, Language
from uard.lab.language.task import LONGEST, Annotator, Question, gold, loose, questions
from uard.lab.result import Result
from uard.method.mitigations import Mitigation

if TYPE_CHECKING:
    from jaxtyping import Float

REFERENCE = 128  # prompts, with four answers each, to which a panel is fitted
BODIES = 10**7  # seeds of the language models with which reward models begin, as if somebody had published them
_VERSION = 1  # of the models that are kept in files


@dataclass(frozen=True, eq=False)
class Panel:
    """A language model before training, and the judges of its answers.

    Attributes:
        start: The language model.
        judges: Reward models by name.
        fitted: Their panel, by the rule ``mean``.
    """

    start: Any
    judges: dict[str, Any]
    fitted: JudgePanel

    def scores(self, prompts: Sequence[str], answers: Sequence[str]) -> Float[np.ndarray, "n K"]:
        """Return every judge's scores of answers, in its own unit."""
        return _scores(self.judges, prompts, answers)


def _scores(judges: dict[str, Any], prompts: Sequence[str], answers: Sequence[str]) -> Float[np.ndarray, "n K"]:
    asked = tuple(prompts), tuple(answers)
    return np.stack([_scored(model, *asked) for model in judges.values()], axis=1)


@lru_cache(maxsize=16)  # who watches asks again what the rule has asked
def _scored(model: Any, prompts: tuple[str, ...], answers: tuple[str, ...]) -> Float[np.ndarray, " n"]:
    import torch

    with torch.inference_mode():
        return models.read(model, prompts, answers).double().numpy()


@lru_cache(maxsize=4)
def prepared(language: Language, seed: int, folder: Path | None = None) -> Panel:
    """Return what a run starts from: the same for every rule.

    Args:
        language: Whose annotators the judges learn from.
        seed: Everything comes from it.
        folder: Where models are kept, so that another process need not train them again; nowhere if None.
    """
    start = _taught(seed, language.taught, folder)
    asked = [question.prompt for question in questions(language.pairs, seed + 10**6)]

    @lru_cache(maxsize=1)
    def pairs() -> tuple[list[str], list[str]]:
        return models.sampled(start, asked, 2 * seed), models.sampled(start, asked, 2 * seed + 1)

    def learned(k: int, annotator: Annotator) -> Any:
        own = 5 * seed + k
        of = _taught(BODIES + k, language.taught, folder)
        return _kept(
            folder,
            ("judge", own, repr(annotator), language.taught, language.pairs, language.compared),
            lambda: models.preferred(of, annotator, asked, pairs(), own, language.compared),
            lambda: models.reward_model(of, own),
        )

    judges = {f"judge {k + 1}": learned(k, annotator) for k, annotator in enumerate(language.annotators)}
    prompts = [question.prompt for question in questions(REFERENCE, seed + 2 * 10**6) for _ in range(4)]
    answers = models.sampled(start, prompts, seed)
    log = ScoreLog(tuple(judges), _scores(judges, prompts, answers), prompts=prompts)
    return Panel(start, judges, fit(log, rule="mean").panel)


def _taught(seed: int, steps: int, folder: Path | None) -> Any:
    def model() -> Any:
        return models.language_model(seed)

    return _kept(folder, ("taught", seed, steps), lambda: models.taught(model(), seed, steps), model)


def _kept(folder: Path | None, name: tuple[Any, ...], make: Callable[[], Any], empty: Callable[[], Any]) -> Any:
    """Return a model from its file, or make it and keep it.

    Raises:
        InvalidValueError: naming the file, if it holds another model, is damaged, or holds more than arrays.
    """
    import torch

    if folder is None:
        return make()
    key = hashlib.sha256(json.dumps([_VERSION, torch.__version__, *name]).encode()).hexdigest()[:24]
    path = folder / f"language-{key}.pt"
    if path.is_file():
        model = empty()
        try:
            model.load_state_dict(torch.load(path, weights_only=True))  # which executes nothing that the file holds
        except Exception as error:
            allowed = f"one that uard has kept, undamaged ({type(error).__name__}): delete it, and it is made again"
            raise _checks.InvalidValueError("kept language model", str(path), allowed) from error
        return model.eval()
    model = make()
    with files.replacing(path) as file:
        torch.save(model.state_dict(), file)
    return model


class _Watch:
    """A reward function of weight 0, which writes down what answers are worth, and how far the model has gone."""

    def __init__(self, panel: Panel):
        self.model: Any = None
        self._panel = panel
        self.log: list[Float[np.ndarray, "n 6"]] = []
        self.divergence: list[Float[np.ndarray, " n"]] = []
        self.judged: list[Float[np.ndarray, "n K"]] = []

    def __call__(self, prompts: list[str], completions: list[str], **_: Any) -> list[float]:
        worth = np.array([gold(p, a) for p, a in zip(prompts, completions, strict=True)])
        words = np.array([len(a.split()) for a in completions], float)
        all_right = worth == [len(Question.of(p).facts) for p in prompts]
        combined = self._panel.fitted.combine(self._panel.scores(prompts, completions))
        columns = ([loose(a) for a in completions], worth, combined.proxy, all_right, words, 0.0 * words)
        rows = np.stack(columns, axis=1)
        self.log.append(rows)
        self.judged.append(combined.ratings)
        training = self.model.training
        self.model.eval()
        now, before = (models.log_probabilities(m, prompts, completions) for m in (self.model, self._panel.start))
        self.model.train(training)
        self.divergence.append(now - before)
        return [0.0] * len(prompts)


def train(
    language: Language, agent: Grpo, mitigation: Mitigation, seed: int, steps: int, folder: Path | None = None
) -> Result:
    """Train a language model by GRPO on what a rule makes of its judges.

    Args:
        language: With its annotators.
        agent: How it learns.
        mitigation: A rule of ``uard.judges``; ``true-reward`` for gold; ``raw`` for the first judge alone.
        seed: Everything comes from it.
        steps: Of GRPO.
        folder: Where language and reward models are kept for other runs.

    Returns:
        An episode per answer, in the order in which they were sampled. ``extra``: ``divergence``, the logarithm of how
        much more probable each answer was than at the start (its mean is the KL divergence), and ``judges``, (n, K),
        each judge's standardised score.
    """
    import torch
    from datasets import Dataset
    from transformers import PrinterCallback, set_seed
    from trl.trainer.grpo_config import GRPOConfig
    from trl.trainer.grpo_trainer import GRPOTrainer

    torch.set_num_threads(1)
    panel = prepared(language, seed, folder)
    watch = _Watch(panel)
    set_seed(seed)
    watch.model = models.language_model(seed)
    watch.model.load_state_dict(panel.start.state_dict())
    asked = [question.prompt for question in questions(agent.prompts * steps, seed + 3 * 10**6)]
    with tempfile.TemporaryDirectory() as output, warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # TRL calls what transformers calls deprecated
        trainer = GRPOTrainer(
            model=watch.model,
            reward_funcs=[_reward(panel, mitigation), cast("Any", watch)],
            args=GRPOConfig(
                output_dir=output,
                per_device_train_batch_size=agent.batch,
                num_generations=agent.completions,
                max_completion_length=LONGEST,
                max_steps=steps,
                learning_rate=agent.learning_rate,
                lr_scheduler_type="constant_with_warmup",
                warmup_steps=5,
                reward_weights=[1.0, 0.0],
                seed=seed,
                report_to="none",
                save_strategy="no",
                logging_strategy="no",
                disable_tqdm=True,
                use_cpu=True,
                bf16=False,
                activation_checkpointing=False,
            ),
            train_dataset=Dataset.from_dict({"prompt": asked}),
            processing_class=models.tokenizer(),
        )
        trainer.remove_callback(PrinterCallback)
        trainer.train()
    extra = {"divergence": np.concatenate(watch.divergence), "judges": np.concatenate(watch.judged)}
    log = np.concatenate(watch.log)
    short = {name: values.astype(np.float32) for name, values in extra.items()}
    return Result(log.astype(np.float32), int(log[:, 4].sum()), np.zeros(0, np.int32), short)


def _reward(panel: Panel, mitigation: Mitigation) -> Any:
    """Return what is trained on, as TRL takes it."""
    from uard.adapters.trl import UncertaintyDiscountedReward

    if mitigation.reads_truth:
        return _gold
    judges = {name: _asked(model) for name, model in panel.judges.items()}
    if not mitigation.reads_feedback:
        return next(iter(judges.values()))
    return UncertaintyDiscountedReward(judges, panel=replace(panel.fitted, rule=mitigation))


def _gold(prompts: list[str], completions: list[str], **_: Any) -> list[float]:
    return [gold(p, a) for p, a in zip(prompts, completions, strict=True)]


def _asked(model: Any) -> Any:
    def judge(prompts: list[str], completions: list[str], **_: Any) -> list[float]:
        return _scored(model, tuple(prompts), tuple(completions)).tolist()

    return judge
