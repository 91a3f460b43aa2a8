"""The models: a language model that learned from what people write, and reward models of what annotators prefer.

PyTorch and transformers are loaded when a model is made. Everything comes from seeds; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from uard.lab.language.task import LONGEST, WORDS, Annotator, questions, written

if TYPE_CHECKING:
    from jaxtyping import Float

PROMPT_WORDS = 6  # the longest prompt: tell cat colour size home ?
_PAD, _EOS = 0, 1


def tokenizer() -> Any:
    """Return a tokenizer of words; prompts are padded on the left, as they are to be continued."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<pad>"))
    words.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    return PreTrainedTokenizerFast(
        tokenizer_object=words, pad_token="<pad>", eos_token="<eos>", unk_token="<pad>", padding_side="left"
    )


def language_model(seed: int, hidden: int = 192, layers: int = 2) -> Any:
    """Return an untrained language model of a million parameters (with the default sizes).

    Args:
        seed: Of its weights.
        hidden: Width.
        layers: Depth.
    """
    from transformers import Qwen2Config, Qwen2ForCausalLM, set_seed

    set_seed(seed)
    return Qwen2ForCausalLM(_config(Qwen2Config, hidden, layers))


def reward_model(of: Any, seed: int) -> Any:
    """Return an untrained reward model: one number for prompt and answer, read at its last word.

    Args:
        of: The language model whose body it begins with, as is usual.
        seed: Of what it reads off.
    """
    from transformers import Qwen2Config, Qwen2ForSequenceClassification, set_seed

    set_seed(seed)
    config = of.config
    model = Qwen2ForSequenceClassification(
        _config(Qwen2Config, config.hidden_size, config.num_hidden_layers, num_labels=1)
    )
    model.model.load_state_dict(of.model.state_dict())
    return model


def _config(kind: Any, hidden: int, layers: int, **more: Any) -> Any:
    return kind(
        vocab_size=len(WORDS), hidden_size=hidden, intermediate_size=3 * hidden, num_hidden_layers=layers,
        num_attention_heads=4, num_key_value_heads=4, max_position_embeddings=64, tie_word_embeddings=True,
        pad_token_id=_PAD, eos_token_id=_EOS, bos_token_id=None, **more,
    )  # fmt: skip


def taught(model: Any, seed: int, steps: int = 300, batch: int = 64) -> Any:
    """Return a language model when it has read what people write.

    Args:
        model: It learns.
        seed: Of what it reads.
        steps: Batches that it reads.
        batch: Answers in each.
    """
    import torch

    words = {word: i for i, word in enumerate(WORDS)}
    random, optimizer = np.random.default_rng([seed, 3]), torch.optim.AdamW(model.parameters(), 1e-3, weight_decay=0.01)
    asked = questions(steps * batch, seed)
    model.train()
    for step in range(steps):
        rows = torch.full((batch, PROMPT_WORDS + LONGEST + 1), _PAD)
        labels = torch.full_like(rows, -100)
        for row, question in enumerate(asked[step * batch : (step + 1) * batch]):
            prompt = [words[word] for word in question.prompt.split()]
            answer = [*(words[word] for word in written(question, random).split()), _EOS]
            rows[row, : len(prompt) + len(answer)] = torch.tensor(prompt + answer)
            labels[row, len(prompt) : len(prompt) + len(answer)] = torch.tensor(answer)
        longest = int((rows != _PAD).sum(1).max())
        optimizer.param_groups[0]["lr"] = 1e-3 * min(1.0, (step + 1) / 20) * (1.0 - step / steps)
        mask = (rows != _PAD).long()[:, :longest]
        loss = model(input_ids=rows[:, :longest], attention_mask=mask, labels=labels[:, :longest]).loss
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return model.eval()


def sampled(model: Any, prompts: Sequence[str], seed: int) -> list[str]:
    """Return an answer to each prompt, drawn from a language model.

    Args:
        model: Of the language.
        prompts: Of questions.
        seed: Of what is drawn.
    """
    import torch

    words = tokenizer()
    torch.manual_seed(seed)
    answers: list[str] = []
    for first in range(0, len(prompts), 256):
        inputs = words(list(prompts[first : first + 256]), return_tensors="pt", padding=True)
        with torch.inference_mode():
            out = model.generate(
                input_ids=inputs["input_ids"], attention_mask=inputs["attention_mask"], do_sample=True, top_k=0,
                max_new_tokens=LONGEST, pad_token_id=_PAD,
            )  # fmt: skip
        answers += words.batch_decode(out[:, inputs["input_ids"].shape[1] :], skip_special_tokens=True)
    return answers


def read(model: Any, prompts: Sequence[str], answers: Sequence[str]) -> Any:
    """Return a reward model's scores of answers, a tensor (n,)."""
    import torch

    words = {word: i for i, word in enumerate(WORDS)}
    texts = [f"{prompt} {answer}".split() for prompt, answer in zip(prompts, answers, strict=True)]
    rows = torch.full((len(texts), max(map(len, texts))), _PAD)
    for row, text in enumerate(texts):
        rows[row, : len(text)] = torch.tensor([words[word] for word in text])
    return model(input_ids=rows, attention_mask=(rows != _PAD).long()).logits[:, 0]


def preferred(
    of: Any, annotator: Annotator, prompts: Sequence[str], pairs: tuple[Sequence[str], Sequence[str]], seed: int,
    steps: int = 120,
) -> Any:  # fmt: skip
    """Return a reward model of what an annotator prefers: Bradley and Terry's, rewards of a pair drawn to 0.

    The latter by 0.01 times the square of their sum (Eisenstein et al. 2023, arXiv 2312.09244; as TRL recommends).

    Args:
        of: The language model that it begins with.
        annotator: Who prefers.
        prompts: Of each pair.
        pairs: First and second answers.
        seed: Of weights, batches and preferences.
        steps: Batches of 32 pairs.
    """
    import torch

    first, second = pairs
    chosen = annotator.prefers_first(prompts, first, second, seed)
    better = [a if yes else b for a, b, yes in zip(first, second, chosen, strict=True)]
    worse = [b if yes else a for a, b, yes in zip(first, second, chosen, strict=True)]
    model, random = reward_model(of, seed), np.random.default_rng([seed, 4])
    optimizer = torch.optim.AdamW(model.parameters(), 3e-4, weight_decay=0.01)
    model.train()
    for step in range(steps):
        rows = random.integers(0, len(prompts), 32)
        asked = [str(prompts[i]) for i in rows]
        scores = read(model, asked + asked, [better[i] for i in rows] + [worse[i] for i in rows])
        loss = -torch.nn.functional.logsigmoid(scores[:32] - scores[32:]).mean()
        loss = loss + 0.01 * ((scores[:32] + scores[32:]) ** 2).mean()
        optimizer.param_groups[0]["lr"] = 3e-4 * min(1.0, (step + 1) / 10) * (1.0 - step / steps)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return model.eval()


def log_probabilities(model: Any, prompts: Sequence[str], answers: Sequence[str]) -> Float[np.ndarray, " n"]:
    """Return how probable answers are to a language model, the logarithm, with the end where they are not too long."""
    import torch

    words = {word: i for i, word in enumerate(WORDS)}
    asked = [[words[word] for word in prompt.split()] for prompt in prompts]
    said = [[words[word] for word in answer.split()] for answer in answers]
    said = [[*answer, _EOS] if len(answer) < LONGEST else answer for answer in said]
    rows = torch.full((len(asked), max(len(a) + len(b) for a, b in zip(asked, said, strict=True))), _PAD)
    own = torch.zeros_like(rows, dtype=torch.bool)
    for row, (prompt, answer) in enumerate(zip(asked, said, strict=True)):
        rows[row, : len(prompt) + len(answer)] = torch.tensor(prompt + answer)
        own[row, len(prompt) : len(prompt) + len(answer)] = True
    mask = torch.arange(rows.shape[1]) < own.int().cumsum(1).gt(0).int().argmax(1, keepdim=True) + own.sum(
        1, keepdim=True
    )
    with torch.inference_mode():
        logits = model(input_ids=rows, attention_mask=mask.long()).logits[:, :-1].log_softmax(-1)
    told = logits.gather(2, rows[:, 1:, None])[:, :, 0]
    return torch.where(own[:, 1:], told, torch.zeros_like(told)).sum(1).double().numpy()
