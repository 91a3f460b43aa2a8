import math

import numpy as np
import pytest
import torch

from uard._checks import InvalidValueError
from uard.method.adaptation import adaptive_lambda, z_score


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((5.0, 1.0, 0.5), 8.0),
        ((5.0, 1.0, 0.5, 1.0), 4.0),
        ((-1.0, 1.0, 0.5), -4.0),
        ((5.0, 1.0, 0.0), 0.0),
        ((5.0, 1.0, 0.0, 2.0), 2.0),
    ],
)
def test_standing_by_hand(arguments, expected):
    assert z_score(*arguments) == expected
    assert z_score(*(np.array([a, a]) for a in arguments)).tolist() == [expected] * 2


@pytest.mark.parametrize(("z", "expected"), [(3.0, 10.0), (1.5, 4.0), (1.0, 2.0), (0.0, 2.0), (-5.0, 2.0)])
def test_adaptive_lambda_by_hand(z, expected):
    assert adaptive_lambda(z, lam=2.0, kappa=2.0) == expected
    assert adaptive_lambda(z, lam=2.0, kappa=0.0) == 2.0


CASES = {
    "z_score": lambda a: z_score(a["v"], a["l"], a["d"]),
    "z_score-floor": lambda a: z_score(a["v"], 0.5, 0.1, floor=a["d"]),
    "z_score-flat": lambda a: z_score(a["v"], 0.5, 0.0),
    "z_score-scalar": lambda a: z_score(2.0, a["l"], a["d"]),
    "adaptive_lambda": lambda a: adaptive_lambda(a["v"], 0.2, 20.0),
}


@pytest.mark.parametrize("case", CASES)
def test_every_array_library_gives_the_same(backend, case):
    values = {"v": np.array([-1.0, 0.5, 3.0]), "l": np.array([0.0, 0.5, 1.0]), "d": np.array([0.0, 0.5, 0.25])}
    backend.agrees(CASES[case], values)


def test_numpys_numbers_go_with_torch():
    z = z_score(torch.tensor([-1.0, 3.0]), np.float64(0.5), np.float64(0.25))
    assert z.dtype == torch.float32
    assert adaptive_lambda(z, lam=2.0, kappa=2.0).tolist() == [2.0, 38.0]


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (adaptive_lambda, (1.0, -1.0), r"^lam = -1\.0: must be a finite number >= 0$"),
        (adaptive_lambda, (1.0, 2.0, math.inf), "^kappa = inf: must be a finite number >= 0$"),
    ],
)
def test_bad_parameters_are_refused(function, arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        function(*arguments)
