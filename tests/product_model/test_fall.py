"""Eqs 18-22: the distributions, by statistical tests. Each states its false-alarm rate; keys are
fixed, so a pass stays a pass.
"""

import jax
import jax.numpy as jnp
import numpy as np
import paper_equations as paper
import pytest
from scipy import stats

from product_model import ensemble, fall, parameters

ALARM = 1e-4  # false-alarm rate of each statistical test below, had its key been drawn anew


@pytest.fixture(scope="module")
def portions():
    return ensemble(parameters(pieces=64, sample=1e-3), 11, 4000)


def test_sigma_height_equals_the_paper():
    z = np.linspace(-4, 4, 41)
    expected = [paper.sigma_height(0.02, 0.06, value) for value in z]
    np.testing.assert_allclose(fall.sigma_height(0.02, 0.06, z), expected, rtol=1e-14)


def test_half_of_the_portions_have_gamma_low_exactly(portions):
    sigma = np.asarray(portions.sigma_height)
    at_limit = int((sigma == 0.02).sum())
    assert stats.binomtest(at_limit, len(sigma), 0.5).pvalue > ALARM


def test_the_others_are_half_normal(portions):
    sigma = np.asarray(portions.sigma_height)
    above = sigma[sigma > 0.02]
    assert stats.kstest((above - 0.02) / ((0.06 - 0.02) / 3), stats.halfnorm.cdf).pvalue > ALARM


def test_heights_and_arrival_times(portions):
    """Standardised heights are normal; impact times follow from them by eq. 14, checked through
    their own distribution.
    """
    sigma = np.asarray(portions.sigma_height)[:, None]
    eta = (np.asarray(portions.height) - 0.25) / sigma
    kept = ~np.asarray(portions.again)
    assert stats.kstest(eta[kept], stats.norm.cdf).pvalue > ALARM
    start = np.asarray(portions.pulses.start)
    quantile = stats.norm.cdf((9.81 * start**2 / 2 - 0.25) / sigma)
    assert stats.kstest(quantile[kept], stats.uniform.cdf).pvalue > ALARM


def test_spread_and_heights_are_independent(portions):
    eta = (np.asarray(portions.height) - 0.25) / np.asarray(portions.sigma_height)[:, None]
    assert stats.spearmanr(np.asarray(portions.sigma_height), eta.mean(1)).pvalue > ALARM
    assert stats.spearmanr(eta[:, 0], eta[:, 1]).pvalue > ALARM


def test_negative_heights_are_drawn_again_and_counted():
    """With sigma = h_mean a normal height is negative with probability Phi(-1); what remains is the
    normal cut off at zero.
    """
    trace = ensemble(
        parameters(h_mean=0.05, gamma_low=0.05, gamma_high=0.05, pieces=50, sample=1e-3), 4, 400
    )
    height, again = np.asarray(trace.height), np.asarray(trace.again)
    assert (height > 0).all() and np.isfinite(np.asarray(trace.force)).all()
    assert stats.binomtest(int(again.sum()), again.size, stats.norm.cdf(-1.0)).pvalue > ALARM
    cut_off = stats.truncnorm(-1.0, np.inf, loc=0.05, scale=0.05)
    assert stats.kstest(height.ravel(), cut_off.cdf).pvalue > ALARM
    assert stats.kstest(height[again], cut_off.cdf).pvalue > ALARM
    np.testing.assert_array_equal(trace.redrawn, again.sum(1))


def test_no_spread_means_equal_heights():
    height, again = fall.drop_heights(
        0.25, jnp.asarray(0.0), jax.random.uniform(jax.random.key(0), (9,), minval=-1.0)
    )
    np.testing.assert_array_equal(height, 0.25)
    assert not again.any()
