"""A reward model as a judge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from uard import _checks


class RewardModel:
    """A reward model as a judge: a model for sequence classification, and its tokenizer.

    It reads prompt and completion together, as TRL lets its reward models read them. With one label the score is its
    logit; a model with N labels is an ensemble of N heads and belongs into ``sigma_m``. A text without tokens, or with
    more than model and tokenizer take, has no score (None), and neither has one to which the model gives NaN; a model
    with several labels must score all.

    Examples:
        >>> from types import SimpleNamespace
        >>> import torch
        >>> class Tokenizer:  # stands for one of transformers'
        ...     pad_token_id = 0
        ...     def __call__(self, texts, **options):
        ...         class Inputs(dict):
        ...             to = lambda self, device: self
        ...         mask = torch.ones(len(texts), max(map(len, texts)), dtype=int)
        ...         return Inputs(attention_mask=mask)
        >>> class Model:
        ...     config, device = SimpleNamespace(get_text_config=SimpleNamespace), "cpu"
        ...     eval = lambda self: self
        ...     def __call__(self, attention_mask):
        ...         return SimpleNamespace(logits=attention_mask.sum(1, keepdim=True))
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
        config = model.config.get_text_config()
        config.pad_token_id = tokenizer.pad_token_id
        limits = [getattr(tokenizer, "model_max_length", None), getattr(config, "max_position_embeddings", None)]
        self._longest = min((limit for limit in limits if limit and limit > 0), default=math.inf)
        self.model, self.tokenizer, self.__name__ = model.eval(), tokenizer, name
        self._batch_size = batch_size

    def __call__(self, prompts: Sequence[Any], completions: Sequence[Any], **columns: Any) -> list[Any]:
        """Return one score per completion, or a row of scores if the model has several labels.

        Raises:
            InvalidValueError: if there is not one prompt per completion.
        """
        if len(prompts) != len(completions):
            raise _checks.InvalidValueError("number of prompts", len(prompts), f"{len(completions)}, as of completions")
        texts = [self._text(prompt, completion) for prompt, completion in zip(prompts, completions, strict=True)]
        scores: list[Any] = []
        for start in range(0, len(texts), self._batch_size):
            scores += self._scored(texts[start : start + self._batch_size])
        return scores

    def _scored(self, texts: list[str]) -> list[Any]:
        import torch

        inputs = self._tokens(texts)
        lengths = inputs["attention_mask"].sum(1).tolist()
        fits = [0 < length <= self._longest for length in lengths]
        if not any(fits):
            return [None] * len(texts)
        if not all(fits):
            inputs = self._tokens([text for text, fit in zip(texts, fits, strict=True) if fit])
        with torch.inference_mode():
            rows = iter(self.model(**inputs.to(self.model.device)).logits.float().tolist())
        scores = [next(rows) if fit else None for fit in fits]
        return [row[0] if row is not None and len(row) == 1 else row for row in scores]

    def _tokens(self, texts: list[str]) -> Any:
        options = {"return_tensors": "pt", "padding": True, "padding_side": "right", "add_special_tokens": False}
        return self.tokenizer(texts, **options)

    def _text(self, prompt: Any, completion: Any) -> str:
        if isinstance(prompt, str):
            return prompt + completion
        return self.tokenizer.apply_chat_template([*prompt, *completion], tokenize=False)
