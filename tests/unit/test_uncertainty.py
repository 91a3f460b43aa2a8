import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from uard import sigma_human, sigma_model
from uard._checks import InvalidValueError
from uard.method.uncertainty import OneAnnotatorWarning, location_and_mad, shrink, with_proxy

RATINGS = np.array([[-1.0, 2.0, 1.0], [0.5, 0.5, 0.5], [3.0, -3.0, 0.0]])
MASK = np.array([[True, True, True], [True, True, False], [True, False, True]])


@pytest.mark.parametrize(("ddof", "expected"), [(0, 1.2472191), (1, 1.5275252)])
def test_the_papers_three_ratings(ddof, expected):
    assert sigma_human([-1, 2, 1], ddof=ddof) == pytest.approx(expected, abs=1e-7)
    assert sigma_human(np.array([[-1.0], [2.0], [1.0]]), axis=0, ddof=ddof) == pytest.approx([expected])
    assert sigma_model([-1, 2, 1], ddof=ddof) == pytest.approx(expected, abs=1e-7)


def test_defaults_are_population_for_annotators_and_sample_for_members():
    assert sigma_human([0.0, 2.0]) == 1.0
    assert sigma_model([0.0, 2.0]) == pytest.approx(math.sqrt(2))


@pytest.mark.parametrize(("ddof", "expected"), [(0, [1.247219, 0.5, 1.5]), (1, [1.527525, 0.707107, 2.121320])])
def test_masked_ratings_by_hand(ddof, expected):
    ratings = [[-1, 2, 1], [0, 1, math.nan], [3, None, 0]]
    assert sigma_human(ratings, mask=MASK.tolist(), ddof=ddof) == pytest.approx(expected, abs=1e-6)


def test_a_full_mask_changes_nothing():
    for ddof in (0, 1):
        assert sigma_human(RATINGS, mask=np.ones_like(MASK), ddof=ddof) == pytest.approx(
            sigma_human(RATINGS, ddof=ddof)
        )


@pytest.mark.parametrize(("ddof", "mask"), [(0, [0, 0]), (1, [0, 0]), (1, [1, 0])])
def test_too_few_ratings_are_an_error_or_empty(ddof, mask):
    ratings, mask = [[1.0, 3.0], [1.0, 3.0]], [mask, [1, 1]]
    with pytest.raises(InvalidValueError, match=f"^mask = .*must be more than {ddof} everywhere, or give empty=$"):
        sigma_human(ratings, mask=mask, ddof=ddof)
    assert sigma_human(ratings, mask=mask, ddof=ddof, empty=7.0).tolist() == [7.0, math.sqrt(2.0 / (2 - ddof))]


def test_too_few_ratings_under_jit_give_nan_and_not_blind_trust():
    sigma = jax.jit(lambda r, m: sigma_human(r, mask=m))(jnp.ones((2, 2)), jnp.array([[False, False], [True, True]]))
    assert np.isnan(sigma[0])
    assert sigma[1] == 0.0


@pytest.mark.parametrize(
    ("ratings", "arguments", "message"),
    [
        ([1.0, math.nan, 2.0], {}, r"^ratings\[1\] = nan: must be finite"),
        ([[1.0, 2.0], [math.inf, 0.0]], {}, r"^ratings\[1, 0\] = inf: must be finite"),
        ([1.0, None, 2.0], {}, r"^ratings = \[1\.0, None, 2\.0\]: must be real numbers .*mask="),
        (["1", "2"], {}, r"^ratings = \['1', '2'\]: must be real numbers"),
        (["1", 2], {"mask": [True, True]}, r"^ratings = \['1', 2\]: must be real numbers"),
        ([[1, 2], [3]], {}, r"^ratings = \[\[1, 2\], \[3\]\]: must be real numbers in rows of equal length"),
        ([[1, 2], [3]], {"mask": [[True, True], [True]]}, r"^mask = .*rows of equal length"),
        ([1.0, None], {"mask": [True, True]}, r"^ratings = .*None.*: must be real numbers"),
        ([1.0, math.nan], {"mask": [True, True]}, r"^ratings\[1\] = nan: must be finite"),
        (RATINGS, {"mask": MASK[0]}, r"^mask\.shape = \(3,\): must be \(3, 3\), the shape of ratings$"),
        (RATINGS, {"mask": MASK[:2]}, r"^mask\.shape = \(2, 3\): must be \(3, 3\)"),
        ([], {}, r"^ratings\.shape = \(0,\): must be at least one annotator on the axis$"),
        (np.zeros((4, 0)), {}, r"^ratings\.shape = \(4, 0\): must be at least one annotator"),
        (3.0, {}, r"^ratings\.shape = \(\): must be at least one annotator"),
        ([1.0, 2.0], {"ddof": 2}, r"^number of annotators = 2: must be more than ddof = 2$"),
    ],
)
def test_sigma_human_refuses_bad_ratings(ratings, arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        sigma_human(ratings, **arguments)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0], r"^number of members = 1: must be more than ddof = 1$"),
        (2.0, r"^number of members = 0: must be more than ddof = 1$"),
        ([1.0, math.nan], r"^values\[1\] = nan: must be finite"),
        ([1.0, None], r"^values = \[1\.0, None\]: must be real numbers"),
    ],
)
def test_sigma_model_refuses_bad_values(values, message):
    with pytest.raises(InvalidValueError, match=message):
        sigma_model(values)


@pytest.mark.parametrize("arguments", [{}, {"mask": [[True], [True]]}, {"ddof": 1, "empty": 0.0}])
def test_one_annotator_warns_of_blind_trust(arguments):
    with pytest.warns(OneAnnotatorWarning, match="one annotator: sigma_h is 0 everywhere, which means blind trust"):
        sigma = sigma_human([[3.0], [-1.0]], **arguments)
    assert sigma.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("library", [np.asarray, jnp.asarray, torch.tensor], ids=["numpy", "jax", "torch"])
def test_whole_numbers_are_ratings_too(library):
    stars = library(np.array([[1, 5, 3], [2, 2, 2]], np.int32))
    mask = library(np.array([[1, 1, 0], [1, 1, 1]], np.int32))
    assert np.asarray(sigma_human(stars)) == pytest.approx([math.sqrt(8 / 3), 0.0])
    assert np.asarray(sigma_human(stars, mask=mask)) == pytest.approx([2.0, 0.0])
    assert np.asarray(sigma_model(stars)) == pytest.approx([2.0, 0.0])


def test_where_all_agree_the_gradient_is_zero_and_not_nan():
    values = np.array([[1.0, 1.0], [1.0, 3.0]], np.float32)
    expected = [[0.0, 0.0], [-math.sqrt(0.5), math.sqrt(0.5)]]
    np.testing.assert_allclose(jax.grad(lambda x: sigma_model(x).sum())(jnp.asarray(values)), expected, rtol=1e-6)
    leaf = torch.tensor(values, requires_grad=True)
    sigma_model(leaf).sum().backward()
    np.testing.assert_allclose(leaf.grad, expected, rtol=1e-6)


def test_half_precision_of_torch():
    ratings = torch.tensor([-1.0, 2.0, 1.0], dtype=torch.bfloat16)
    assert sigma_human(ratings).dtype == torch.float32
    assert sigma_human(torch.tensor([-300.0, 300.0], dtype=torch.float16)) == 300.0  # whose square is no float16
    assert float(sigma_human(ratings)) == pytest.approx(1.247, abs=0.01)


def test_with_proxy_by_hand():
    # {-1, 2, 1, 4}: mean 1.5, squared deviations 6.25 + .25 + .25 + 6.25 = 13, and 13 / 4 = 3.25
    assert with_proxy(2 / 3, math.sqrt(14 / 9), 4.0, 3) == pytest.approx(math.sqrt(3.25))
    assert with_proxy(1.0, 0.0, 1.0, 3) == 0.0
    assert with_proxy(1.0, 0.0, 2.0, 1) == pytest.approx(0.5)


@pytest.mark.parametrize("raters", [1, 2, 3, 10])
def test_with_proxy_is_the_deviation_of_the_union(raters):
    rng = np.random.default_rng(raters)
    ratings, proxy = rng.normal(2.0, 3.0, (50, raters)), rng.normal(-1.0, 5.0, 50)
    union = np.concatenate([ratings, proxy[:, None]], axis=-1).std(-1)
    np.testing.assert_allclose(with_proxy(ratings.mean(-1), ratings.std(-1), proxy, raters), union)


@pytest.mark.parametrize(
    ("sigma", "count", "strength", "expected"),
    [(2.0, 3.0, 1.0, 1.625), (2.0, 3.0, 0.0, 2.0), (2.0, 0.0, 1.0, 0.5), (math.nan, 0.0, 0.0, 0.5)],
)
def test_shrink_by_hand(sigma, count, strength, expected):
    assert shrink(sigma, count, 0.5, strength) == expected
    assert shrink(np.array([sigma, 1.0]), np.array([count, 9.0]), 0.5, strength)[0] == expected


def test_location_and_mad_are_over_the_masked_in():
    values = np.array([1.0, 2.0, 6.0, math.nan])
    assert location_and_mad(values, np.array([True, True, False, False])) == (1.5, 0.5)
    assert location_and_mad(values, np.array([True, True, True, False])) == (3.0, 2.0)
    assert location_and_mad(values, np.zeros(4, bool)) == (0.0, 0.0)


CASES = {
    "sigma_model": lambda a: sigma_model(a["r"]),
    "sigma_model-axis": lambda a: sigma_model(a["r"], axis=0, ddof=0),
    "sigma_human": lambda a: sigma_human(a["r"]),
    "sigma_human-ddof": lambda a: sigma_human(a["r"], ddof=1),
    "sigma_human-mask": lambda a: sigma_human(a["r"], mask=a["m"]),
    "sigma_human-mask-axis": lambda a: sigma_human(a["r"], mask=a["m"], axis=0, ddof=1),
    "sigma_human-few": lambda a: sigma_human(a["r"], mask=a["m"], ddof=2, empty=0.25),
    "sigma_human-empty": lambda a: sigma_human(a["r"], ddof=3, empty=0.5),
    "with_proxy": lambda a: with_proxy(a["r"], abs(a["r"]), a["x"], 3),
    "with_proxy-scalar": lambda a: with_proxy(a["r"], 0.5, 2.0, 3),
    "shrink": lambda a: shrink(a["r"], a["x"], 0.5),
    "shrink-unshrunk": lambda a: shrink(a["r"], a["x"], a["r"], 0.0),
    "shrink-scalar": lambda a: shrink(a["r"], 2, 0.5, 1.0),
    "location": lambda a: location_and_mad(a["r"], a["m"]),
    "location-none": lambda a: location_and_mad(a["r"], a["r"] > 99.0),
}


@pytest.mark.parametrize("case", CASES)
def test_every_array_library_gives_the_same(backend, case):
    backend.agrees(CASES[case], {"r": RATINGS, "m": MASK, "x": np.array([0.0, 1.0, 4.0])})
