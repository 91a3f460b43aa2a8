import math

import jax
import numpy as np
import pytest
import torch

from uard import ReliabilityFilter, discount, total_uncertainty
from uard._checks import InvalidValueError, UnknownNameError
from uard.method.arrays import namespace
from uard.method.weights import (
    FORMS,
    certainty_equivalent_weight,
    exponential_weight,
    linear_weight,
    reciprocal_weight,
    wiener_weight,
)

U = np.array([0.0, 0.1, 0.6235, 3.0])
MU = np.array([4.0, -1.0, 2.0, 0.0])
SIGMA = np.array([0.0, 0.4, 1.247, 10.0])


def test_total_uncertainty():
    assert total_uncertainty(0.4, 1.247) == pytest.approx(0.8235)
    assert total_uncertainty(0.4, 1.247, alpha=1.0, beta=0.25) == pytest.approx(0.71175)


@pytest.mark.parametrize(
    ("form", "sigma_m", "sigma_h", "mu", "expected"),
    [
        ("reciprocal", 0.0, 1.247, None, 0.445037),
        ("reciprocal", 0.4, 1.247, None, 0.377786),
        ("exponential", 0.0, 1.247, None, 0.287365),
        ("linear", 0.0, 1.247, 2.0, 0.3765),
        ("linear", 0.0, 1.247, 1.0, 0.0),
        ("linear", 0.0, 1.247, -2.0, 0.0),
        ("certainty-equivalent", 0.0, 1.247, 2.0, 0.837258),
        ("certainty-equivalent", 0.0, 1.247, -2.0, 0.0),
        ("wiener", 0.0, 1.247, 2.0, 0.720071),
        ("wiener", 0.0, 1.247, -2.0, 0.720071),
    ],
)
def test_weight_by_hand(form, sigma_m, sigma_h, mu, expected):
    weight = ReliabilityFilter(form=form).weight(sigma_m, sigma_h, mu=mu)
    assert float(weight) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("form", "anchor", "expected"),
    [
        ("reciprocal", 0.0, 4 * 0.4450378),
        ("reciprocal", -1.0, -1 + 5 * 0.4450378),
        ("linear", 0.0, 4 - 1.247),
        ("linear", -1.0, 4 - 1.247),
    ],
)
def test_score_by_hand(form, anchor, expected):
    assert float(ReliabilityFilter(form=form).score(4.0, 0.0, 1.247, anchor)) == pytest.approx(expected, abs=1e-6)


def test_certainty_equivalent_is_the_papers_reliability_ratio_to_first_order():
    # A26-A28: CE = mu - kappa U^2 / 2, r = CE / mu, w = 1 / (1 + (1 - r))
    u, mu, kappa = 0.3, 2.0, 1.5
    ratio = (mu - kappa / 2 * u**2) / mu
    assert float(certainty_equivalent_weight(u, mu, kappa)) == pytest.approx(1 / (2 - ratio))


def test_discount_draws_towards_the_anchor():
    assert discount(4.0, 0.25) == 1.0
    assert discount(4.0, 0.25, -1.0) == 0.25
    assert discount(4.0, 0.0, -1.0) == -1.0
    assert discount(4.0, 1.0, -1.0) == 4.0


@pytest.mark.parametrize("mu", [5e-324, 1e-200, 1e100])
def test_weights_stay_weights_for_extreme_values(mu):
    for form in ("linear", "wiener"):
        weight = ReliabilityFilter(form=form).weight(0.0, np.array([0.0, mu]), mu=np.full(2, mu))
        assert weight[0] == 1.0
        assert 0.0 <= weight[1] <= 1.0


def test_wiener_trusts_where_there_is_neither_signal_nor_noise():
    assert wiener_weight(np.zeros(2), np.array([0.0, 1.0])).tolist() == [1.0, 0.0]


CASES = {
    "total": lambda a: total_uncertainty(a["sigma"], a["u"]),
    "reciprocal": lambda a: reciprocal_weight(a["u"]),
    "exponential": lambda a: exponential_weight(a["u"]),
    "linear": lambda a: linear_weight(a["u"], a["mu"]),
    "certainty-equivalent": lambda a: certainty_equivalent_weight(a["u"], a["mu"]),
    "wiener": lambda a: wiener_weight(a["mu"] * a["mu"], a["u"]),
    "discount": lambda a: discount(a["mu"], reciprocal_weight(a["u"]), -1.0),
    "lambda-array": lambda a: ReliabilityFilter().weight(a["sigma"], a["u"], lam=a["sigma"]),
    "broadcast": lambda a: ReliabilityFilter(form="wiener").weight(a["sigma"], a["u"][:, None], mu=a["mu"]),
} | {
    f"{form}-{what}": function
    for form in FORMS
    for what, function in {
        "weight": lambda a, f=form: ReliabilityFilter(form=f).weight(a["sigma"], a["u"], mu=a["mu"]),
        "weight-mixed": lambda a, f=form: ReliabilityFilter(form=f).weight(a["sigma"], 0.0, mu=1.5),
        "score": lambda a, f=form: ReliabilityFilter(form=f).score(a["mu"], a["sigma"], a["u"]),
        "score-anchored": lambda a, f=form: ReliabilityFilter(form=f).score(a["mu"], a["sigma"], a["u"], a["mu"] - 1),
    }.items()
}


@pytest.mark.parametrize("case", CASES)
def test_every_array_library_gives_the_same(backend, case):
    backend.agrees(CASES[case], {"u": U, "mu": MU, "sigma": SIGMA})


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("scalar", [float, np.float64, np.array, torch.tensor, jax.numpy.float32])
def test_scalars_work(form, scalar):
    f = ReliabilityFilter(form=form)
    score = f.score(scalar(2.0), scalar(0.4), scalar(1.247), scalar(-1.0))
    array = f.score(np.array([2.0]), np.array([0.4]), np.array([1.247]), -1.0)
    assert float(score) == pytest.approx(array[0], rel=1e-6)
    assert np.shape(score) == ()


@pytest.mark.parametrize("form", FORMS)
def test_gradients_with_respect_to_the_value(form):
    f = ReliabilityFilter(form=form)

    def score(mu):
        return f.score(mu, 0.1, 0.2)

    mu = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    score(mu).backward()
    numeric = (float(score(2.0 + 1e-6)) - float(score(2.0 - 1e-6))) / 2e-6
    assert mu.grad.item() == pytest.approx(numeric, rel=1e-6)
    assert float(jax.grad(score)(2.0)) == pytest.approx(numeric, rel=1e-5)


def test_numpy_gives_way_to_other_libraries():
    assert namespace(1.0, 2) is np
    assert namespace(np.float64(1.0), torch.zeros(1)).__name__ == "array_api_compat.torch"
    assert namespace(np.zeros(1), jax.numpy.zeros(1)) is jax.numpy


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lam": -1.0}, r"^lam = -1\.0: must be a finite number >= 0$"),
        ({"lam": math.nan}, "^lam = nan: must be a finite number >= 0$"),
        ({"lam": None}, "^lam = None: must be a finite number >= 0$"),
        ({"alpha": 1.5}, r"^alpha = 1\.5: must be a finite number in \[0, 1\]$"),
        ({"beta": -0.1}, r"^beta = -0\.1: must be a finite number in \[0, 1\]$"),
        ({"form": "linaer"}, r"^form = 'linaer': must be one of .*\(did you mean 'linear'\?\)$"),
    ],
)
def test_filter_refuses_bad_parameters(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        ReliabilityFilter(**arguments)


def test_an_unknown_form_is_an_unknown_name():
    with pytest.raises(UnknownNameError):
        ReliabilityFilter(form="softmax")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sigma_m": -0.1}, r"^sigma_m = -0\.1: must be finite and >= 0$"),
        ({"sigma_h": [0.0, math.nan]}, r"^sigma_h\[1\] = nan: must be finite and >= 0$"),
        ({"sigma_h": math.inf}, "^sigma_h = inf: must be finite and >= 0$"),
        ({"alpha": 2}, r"^alpha = 2: must be a finite number in \[0, 1\]$"),
        ({"beta": "half"}, r"^beta = 'half': must be a finite number in \[0, 1\]$"),
    ],
)
def test_total_uncertainty_refuses_bad_input(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        total_uncertainty(**({"sigma_m": 0.0, "sigma_h": 0.0} | arguments))


@pytest.mark.parametrize("form", ["linear", "certainty-equivalent", "wiener"])
def test_forms_that_compare_with_the_value_ask_for_it(form):
    with pytest.raises(InvalidValueError, match=f"^mu = None: must be given for the form '{form}'$"):
        ReliabilityFilter(form=form).weight(0.1, 0.1)


def test_score_and_lambda_are_checked():
    with pytest.raises(InvalidValueError, match=r"^mu\[1\] = nan"):
        ReliabilityFilter().score(np.array([0.0, math.nan]), 0.1, 0.1)
    with pytest.raises(InvalidValueError, match=r"^lam\[0\] = -2\.0: must be finite and >= 0$"):
        ReliabilityFilter().weight(0.1, 0.1, lam=np.array([-2.0]))
