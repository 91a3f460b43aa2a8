"""What tells prompts and completions apart: their content, whatever they print and wherever they lie."""

import gc
from dataclasses import dataclass, field
from decimal import Decimal

import numpy as np
import pytest

from uard.judges import Judge, ScoreLog
from uard.judges.contents import content_of
from uard.judges.groups import groups_of


class Hand:
    """Has no equality of its own, and prints like any other."""

    def __repr__(self):
        return "Hand"


@dataclass
class Turn:
    said: list
    seen: int = field(default=0, compare=False)


def within(part):
    return [{"role": "user", "content": [{"type": "image", "image": part}, ("why?", part)]}]


def long(place, **kind):
    values = np.zeros(3000, **kind)
    values[place] = 1
    return values


within_itself = []
within_itself.append(within_itself)

SAME = {
    "texts": ("why?", "".join(["why", "?"])),
    "numbers": (1.5, 3 / 2),
    "not a number": (float("nan"), -float("nan")),
    "nothing": (None, None),
    "sets": ({"a", "b"}, {"b", "a"}),
    "arrays": (long(1500), long(1500)),
    "turned arrays": (np.zeros((2, 3)).T, np.zeros((3, 2))),
    "arrays of objects": (np.array(["a", None], object), np.array(["a", None], object)),
    "scalars": (np.float32("nan"), np.float32("nan")),
    "dataclasses": (Turn(["a"], 1), Turn(["a"], 2)),
    "hashable objects": (Decimal(1), Decimal(1)),
    "large numbers": (10**5000, 10**5000),
}
DIFFERENT = {
    "kinds of number": (1, 1.0, True, np.int64(1), np.float64(1), "1", b"1", Decimal(1), Decimal("1.0")),
    "nothing": (None, "None", "", [], (), {}, 0, False),
    "zeros": (0.0, -0.0),
    "kinds of list": (["a"], ("a",), {"a"}, frozenset({"a"}), {"a": None}, [["a"]]),
    "places in a list": (["a", ["b"]], [["a"], "b"], ["a", "b"], ["b", "a"]),
    "dictionaries": ({"a": 1}, {"a": True}, {1: "a"}, {True: "a"}, {"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "sets": ({1}, {True}, {1.0}),
    "the middle of an array": (long(1500), long(1501), long(1500, dtype=np.float32), long(1500).reshape(2, -1)),
    "masks": tuple(np.ma.masked_array([1, 2], mask) for mask in ([0, 0], [0, 1])),
    "objects that print alike": (Hand(), Hand()),
    "dataclasses": (Turn(["a"]), Turn(["b"])),
    "what is within itself": (within_itself, [within_itself]),
}


@pytest.mark.parametrize("values", SAME.values(), ids=SAME)
def test_the_same_content_has_the_same_key(values):
    one, other = map(content_of, values)
    assert one == other
    assert hash(one) == hash(other)
    assert content_of(within(values[0])) == content_of(within(values[1]))


@pytest.mark.parametrize("values", DIFFERENT.values(), ids=DIFFERENT)
def test_other_content_has_another_key(values):
    assert len({content_of(value) for value in values}) == len(values)
    assert len({content_of(within(value)) for value in values}) == len(values)
    assert len({content_of(value) for value in (*values, *values)}) == len(values)


def test_tensors():
    torch = pytest.importorskip("torch")
    one = torch.zeros(3000)
    other = one.clone()
    other[1500] = 1
    assert content_of(one) == content_of(one.clone().requires_grad_())
    assert content_of(one.bfloat16()) == content_of(one.bfloat16())
    assert content_of(torch.tensor(1.0)) == content_of(torch.ones(()))
    many = [
        one,
        other,
        one.bfloat16(),
        other.bfloat16(),
        one.double(),
        one.reshape(2, -1),
        one.numpy(),
        one.to_sparse(),
    ]
    assert len({content_of(value) for value in many}) == len(many)


def test_images():
    pillow = pytest.importorskip("PIL.Image")
    image = pillow.new("P", (4, 4), 1)
    image.putpalette([0, 0, 0, 9, 9, 9])
    other = image.copy()
    other.putpalette([0, 0, 0, 8, 8, 8])
    assert content_of(image) == content_of(image.copy())
    many = [image, other, *(pillow.new(mode, size, 7) for mode in ("L", "RGB") for size in ((4, 4), (2, 8)))]
    assert len({content_of(value) for value in many}) == len(many)
    prompts = [within(pillow.new("L", (8, 8), shade)) for shade in (5, 5, 6, 6)]
    assert groups_of(prompts).tolist() == [0, 0, 1, 1]


def test_groups_are_told_apart_by_content():
    prompts = [within(long(place)) for place in (1, 1, 1500, 1501, 1501)]
    assert groups_of(prompts).tolist() == [0, 0, 1, 2, 2]
    log = ScoreLog(("a", "b"), np.zeros((5, 2)), prompts=[prompts[k] for k in (0, 2, 1, 3, 4)])
    assert log.groups.tolist() == [0, 1, 0, 2, 2]


def test_a_cache_gives_nobody_the_score_of_something_else():
    asked = []

    def total(prompt, completion, **question):
        asked.append(1)
        return float(np.sum(completion))

    judge = Judge(total, per_sample=True, cache=100)
    for _ in range(2):
        assert judge(["p"] * 3, [long(1500), 2 * long(1501), long(1500)]) == [1, 2, 1]
    assert len(asked) == 2


def test_what_a_cache_knows_keeps_its_place_in_memory():
    """An object that came later to the place of another would be taken for it."""

    def own(prompt, completion, **question):
        return completion.number

    judge = Judge(own, per_sample=True, cache=1000)
    for number in range(200):
        hand = Hand()
        hand.number = number
        assert judge(["p"], [hand]) == [number]
        del hand
        gc.collect(0)
