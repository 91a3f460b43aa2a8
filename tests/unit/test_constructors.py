"""Silly values in every field of every configuration: refused by name, or of the kind that the field holds."""

import dataclasses
import importlib
import math
import pkgutil
from functools import partial
from inspect import isabstract
from pathlib import Path

import numpy as np
import pytest

import uard
from uard import InvalidValueError
from uard._support import fields
from uard.agents.policy import CPO
from uard.envs.locomotion.inverted_pendulum import InvertedPendulum
from uard.method.mitigations import Raw
from uard.training.host.loop import Job

SILLY = (
    *(None, "x", "", b"x", -1, 2, 1.5, True, math.nan, math.inf, 10**5000, 1e308, np.float32(np.nan)),
    *([], (), {}, object, np.zeros(3), lambda: 0),
)
GIVEN = {"Job": partial(Job, environment=InvertedPendulum(), agent=CPO(), mitigation=Raw())}  # what has no default


def configurations():
    for module in pkgutil.walk_packages([str(Path(uard.__file__).parent)], "uard."):
        if module.name.split(".")[1] in ("envs", "agents", "training", "lab", "method", "ratings"):
            for kind in vars(importlib.import_module(module.name)).values():
                mine = isinstance(kind, type) and kind.__module__ == module.name and hasattr(kind, "__post_init__")
                frozen = dataclasses.is_dataclass(kind) and kind.__dataclass_params__.frozen
                if mine and frozen and not isabstract(kind) and kind.__name__ != "Ray":
                    yield kind


CASES = [(kind, field) for kind in configurations() for field in dataclasses.fields(kind) if field.init]


@pytest.mark.parametrize(("kind", "field"), CASES, ids=lambda x: getattr(x, "__name__", None) or x.name)
def test_a_silly_value_is_refused_by_name_or_is_of_the_fields_kind(kind, field):
    for value in SILLY:
        try:
            GIVEN.get(kind.__name__, kind)(**{field.name: value})
        except InvalidValueError:
            continue
        except TypeError as error:
            if "missing" not in str(error):
                raise
            continue
        assert fields.scalar(field.name, value, field.type) is not None or value is None
        assert value is not object
        assert not callable(value)
        assert not isinstance(value, float) or math.isfinite(value)


def test_the_cases_are_many():
    assert len(CASES) > 150
    assert {"Cell", "PPO", "Locomotion", "Job", "Problem", "RewardDiscounting", "Rater"} <= {
        k.__name__ for k, _ in CASES
    }


@pytest.mark.parametrize(
    ("name", "value", "annotation", "expected"),
    [
        ("x", 2, float, 2.0),
        ("x", np.float32(0.5), "float | None", 0.5),
        ("x", None, "float | None", None),
        ("x", np.int64(2), "int", 2),
        ("x", np.True_, bool, True),
        ("x", (1, 2.0), "tuple[float, ...]", (1, 2.0)),
    ],
)
def test_a_scalar_has_one_form(name, value, annotation, expected):
    got = fields.scalar(name, value, annotation)
    assert (got, type(got)) == (expected, type(expected))
