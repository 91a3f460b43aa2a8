"""A reward model as a judge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from uard import _checks


class RewardModel:
    """A reward model as a judge: a model for sequence classification, and its tokenizer.

    It reads prompt and completion together, as TRL lets its reward models read them. With one label the score is its
    logit; a model with N labels is an ensemble of N heads and belongs into ``sigma_m``.

    Examples:
        >>> from types import SimpleNamespace
        >>> import torch
        >>> class Tokenizer:  # stands for one of transformers'
        ...     pad_token_id = 0
        ...     def __call__(self, texts, **options):
        ...         class Inputs(dict):
        ...             to = lambda self, device: self
        ...         return Inputs(ids=torch.tensor([[float(len(text))] for text in texts]))
        >>> class Model:
        ...     config, device = SimpleNamespace(get_text_config=SimpleNamespace), "cpu"
        ...     eval = lambda self: self
        ...     def __call__(self, ids):
        ...         return SimpleNamespace(logits=ids)
        >>> RewardModel(Model(), Tokenizer())(["2 + 2 = "], ["4"])
        [9.0]

    Attributes:
        model: The model; it stays on the device where it is.
        tokenizer: Its tokenizer, with a chat template if prompts are conversations.
    """

    def __init__(self, model: Any, tokenizer: Any, *, name: str = "reward_model", batch_size: int = 64):
        """Take a model and its tokenizer, and set both up for padding as TRL does.

        Args:
            model: For example transformers' ``AutoModelForSequenceClassification``.
            tokenizer: Without a padding token, it gets its end token for one.
            name: The judge's name.
            batch_size: Completions read at once, >= 1.

        Raises:
            InvalidValueError: for a bad batch size.
        """
        _checks.whole("batch_size", batch_size, low=1)
        if tokenizer.pad_token_id is None:
            tokenizer.pad_token = tokenizer.eos_token
        model.config.get_text_config().pad_token_id = tokenizer.pad_token_id
        self.model, self.tokenizer, self.__name__ = model.eval(), tokenizer, name
        self._batch_size = batch_size

    def __call__(self, prompts: Sequence[Any], completions: Sequence[Any], **columns: Any) -> list[Any]:
        """Return one score per completion, or a row of scores if the model has several labels."""
        import torch

        texts = [self._text(prompt, completion) for prompt, completion in zip(prompts, completions, strict=True)]
        scores: list[list[float]] = []
        for start in range(0, len(texts), self._batch_size):
            inputs = self.tokenizer(
                texts[start : start + self._batch_size],
                return_tensors="pt",
                padding=True,
                padding_side="right",
                add_special_tokens=False,
            )
            with torch.inference_mode():
                scores += self.model(**inputs.to(self.model.device)).logits.float().tolist()
        return [row[0] if len(row) == 1 else row for row in scores]

    def _text(self, prompt: Any, completion: Any) -> str:
        if isinstance(prompt, str):
            return prompt + completion
        return self.tokenizer.apply_chat_template([*prompt, *completion], tokenize=False)
