"""Policies over discrete and continuous actions: against SciPy, and second derivatives taken by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from uard.agents import heads
from uard.agents.heads import GaussianPolicy, Normal
from uard.agents.networks import Network

RANDOM = np.random.default_rng(0)
DISTRIBUTIONS = {
    "discrete": jnp.asarray(RANDOM.normal(size=(6, 4)), jnp.float32),
    "continuous": Normal(jnp.asarray(RANDOM.normal(size=(6, 2)), jnp.float32), jnp.asarray([-0.5, 0.3], jnp.float32)),
}


def test_a_normal_is_scipys():
    distribution = DISTRIBUTIONS["continuous"]
    action = RANDOM.normal(size=(6, 2)).astype(np.float32)
    theirs = stats.norm(np.asarray(distribution.mean), np.exp(np.asarray(distribution.log_deviation)))
    np.testing.assert_allclose(heads.log_probability(distribution, action), theirs.logpdf(action).sum(1), rtol=1e-5)
    np.testing.assert_allclose(heads.entropy(distribution), theirs.entropy()[0].sum(), rtol=1e-6)
    np.testing.assert_array_equal(heads.likeliest(distribution), distribution.mean)


def test_divergence_of_normals_is_the_textbooks():
    old = Normal(jnp.array([[0.0], [1.0]]), jnp.log(jnp.array([1.0])))
    new = Normal(jnp.array([[1.0], [1.0]]), jnp.log(jnp.array([2.0])))
    # KL(N(0,1) || N(1,4)) = log 2 + (1 + 1) / 8 - 1/2; without the shift (1) / 8
    np.testing.assert_allclose(heads.divergence(old, new), np.log(2) - 0.5 + (2 / 8 + 1 / 8) / 2, rtol=1e-6)


@pytest.mark.parametrize("kind", DISTRIBUTIONS)
def test_divergence_is_zero_only_at_itself(kind):
    distribution = DISTRIBUTIONS[kind]
    other = jax.tree.map(lambda x: x * 1.3 + 0.1 * jnp.arange(x.shape[-1], dtype=jnp.float32), distribution)
    assert abs(float(heads.divergence(distribution, distribution))) < 1e-6
    assert float(heads.divergence(distribution, other)) > 1e-3


@pytest.mark.parametrize("kind", DISTRIBUTIONS)
def test_curvature_is_the_second_derivative_of_the_divergence(kind):
    distribution = DISTRIBUTIONS[kind]
    direction = jax.tree.map(lambda x: jnp.asarray(RANDOM.normal(size=x.shape), jnp.float32), distribution)
    exact = jax.jvp(jax.grad(lambda new: heads.divergence(distribution, new)), (distribution,), (direction,))[1]
    ours = heads.curvature(distribution, direction)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_draws_have_the_distributions_mean_and_deviation():
    distribution = Normal(jnp.full((40_000, 1), 2.0), jnp.log(jnp.array([0.5])))
    drawn = np.asarray(heads.draw(distribution, jax.random.key(0)))
    assert drawn.mean() == pytest.approx(2.0, abs=0.01)
    assert drawn.std() == pytest.approx(0.5, abs=0.01)


def test_a_fresh_policy_is_almost_a_standard_normal():
    policy = heads.init(jax.random.key(0), Network(), 5, 2, continuous=True)
    assert isinstance(policy, GaussianPolicy)
    distribution = heads.action_distribution(Network(), policy, jnp.ones((3, 5)))
    assert isinstance(distribution, Normal)
    assert np.abs(distribution.mean).max() < 0.1
    np.testing.assert_array_equal(distribution.log_deviation, 0.0)
