import math

import numpy as np
import pytest

from uard import Abstention, InvalidValueError
from uard.method.abstention import uncertainty_ratio


@pytest.mark.parametrize(
    ("u", "mu", "eps", "expected"), [(1.5, -3.0, 1e-6, 0.5), (1.5, -3.0, 1.0, 0.375), (2.0, 0.0, 0.5, 4.0)]
)
def test_ratio_by_hand(u, mu, eps, expected):
    assert uncertainty_ratio(u, mu, eps) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("rule", "u", "mu", "abstains"),
    [
        ("threshold", 0.5, 100.0, False),
        ("threshold", 0.51, 100.0, True),
        ("ratio", 0.51, 100.0, False),
        ("ratio", 0.51, -1.0, True),
        ("ratio", 0.01, 0.0, True),
        ("ratio", 0.0, 0.0, False),
    ],
)
def test_abstains_above_the_limit(rule, u, mu, abstains):
    assert bool(Abstention(rule=rule, limit=0.5).abstains(u, mu)) is abstains


@pytest.mark.parametrize("rule", ["threshold", "ratio"])
def test_every_array_library_gives_the_same(backend, rule):
    u, mu = np.array([0.0, 0.4, 0.5, 2.0]), np.array([0.0, -0.5, 3.0, 3.0])
    result = backend.call(Abstention(rule=rule, limit=0.5).abstains, u, mu)
    assert isinstance(result, backend.kind)
    assert np.asarray(result).tolist() == ([False, rule == "ratio", False, True])
    backend.agrees(uncertainty_ratio, u, mu)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rule": "ration"}, r"^rule = 'ration': must be one of ratio, threshold \(did you mean 'ratio'\?\)$"),
        ({"response": "saf"}, r"^response = 'saf': must be one of ask, safe, skip \(did you mean 'safe'\?\)$"),
        ({"limit": 0}, "^limit = 0: must be a finite number > 0$"),
        ({"eps": -1.0}, r"^eps = -1\.0: must be a finite number > 0$"),
    ],
)
def test_bad_parameters_are_refused(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        Abstention(**arguments)


@pytest.mark.parametrize("rule", ["threshold", "ratio"])
@pytest.mark.parametrize(
    ("u", "mu", "message"),
    [(math.nan, 0.0, r"^u = nan"), (-1.0, 0.0, r"^u = -1\.0: must be finite and >= 0"), (1.0, math.inf, r"^mu = inf")],
)
def test_an_unusable_uncertainty_is_no_reason_to_act(rule, u, mu, message):
    with pytest.raises(InvalidValueError, match=message):
        Abstention(rule=rule).abstains(u, mu)
    with pytest.raises(InvalidValueError, match=r"^eps = 0"):
        uncertainty_ratio(1.0, 1.0, eps=0)
