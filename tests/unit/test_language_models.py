"""The models of the language: what is read does not depend on what stands beside it, and probabilities are right."""

import numpy as np
import pytest
import torch

from uard.lab.language.models import (
    language_model,
    log_probabilities,
    preferred,
    read,
    reward_model,
    sampled,
    taught,
    tokenizer,
)
from uard.lab.language.task import WORDS, Annotator, Question, gold, questions, truth

PROMPTS = [question.prompt for question in questions(6, seed=0)]


@pytest.fixture(scope="module")
def small():
    return language_model(0, hidden=16, layers=1).eval()


def test_a_million_parameters():
    assert 0.8e6 < sum(x.numel() for x in language_model(0).parameters()) < 1.3e6


def test_words_come_back():
    words = tokenizer()
    assert words.decode(words("its colour is red .")["input_ids"]) == "its colour is red ."


def test_probabilities_are_those_of_word_by_word(small):
    answers = ["its colour is red .", "so", "", "lovely dear", "its home is lake .", "."]
    found = log_probabilities(small, PROMPTS, answers)
    for prompt, answer, value in zip(PROMPTS, answers, found, strict=True):
        said, by_hand = [*answer.split(), "<eos>"], 0.0
        context = [WORDS.index(word) for word in prompt.split()]
        for word in said:
            with torch.inference_mode():
                logits = small(input_ids=torch.tensor([context])).logits[0, -1].log_softmax(-1)
            by_hand += float(logits[WORDS.index(word)])
            context.append(WORDS.index(word))
        assert value == pytest.approx(by_hand, abs=1e-4)


def test_a_reward_model_reads_each_answer_alone():
    model = reward_model(language_model(0, hidden=16, layers=1), seed=0).eval()
    answers = ["its colour is red .", "so", "dear", "lovely dear so really", "its home is lake .", "."]
    with torch.inference_mode():
        together = read(model, PROMPTS, answers)
        alone = torch.cat([read(model, [p], [a]) for p, a in zip(PROMPTS, answers, strict=True)])
    assert together.numpy() == pytest.approx(alone.numpy(), abs=1e-5)


def test_models_learn_and_seeds_decide():
    prompts = [question.prompt for question in questions(200, seed=1)]
    wild, model = language_model(0), taught(language_model(0), 0, steps=80, batch=16)
    worth = [np.mean([gold(p, a) for p, a in zip(prompts, sampled(m, prompts, 0), strict=True)]) for m in (wild, model)]
    assert worth[1] > worth[0] + 0.5
    assert sampled(model, prompts[:5], 3) == sampled(model, prompts[:5], 3)
    asked = [Question.of(prompt) for prompt in prompts]
    first = [f"its {q.facts[0]} is {truth(q.animal, q.facts[0])} ." for q in asked]
    second = ["so so so"] * 200
    judge = preferred(wild, Annotator(), prompts, (first, second), seed=0, steps=20)
    with torch.inference_mode():
        assert (read(judge, prompts, first) > read(judge, prompts, second)).float().mean() > 0.9
