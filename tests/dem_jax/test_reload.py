"""The scalar Walton-Braun law, eqs 1-4, case by case, and its work over load, unload, reload."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax.contact_laws import springs, walton_braun

K, EPSILON, LAMBDA = 2.0, 0.5, 0.001


def law(force, overlap, new_overlap):
    """F_n where the bodies do not turn: the approach is the change of the overlap (0 where apart),
    eq. 4.
    """
    return walton_braun.clamp_to_branches(
        force + K / EPSILON**2 * (max(new_overlap, 0.0) - overlap), new_overlap, K, LAMBDA
    )


@pytest.mark.parametrize(
    ("force", "overlap", "new_overlap", "expected", "case"),
    [
        (
            0.0,
            0.0,
            0.1,
            0.2,
            "first touch: s_prev = 0, so that K_nu s exceeds K_nl s and eq. 2 holds",
        ),
        (0.2, 0.1, 0.3, 0.6, "further loading: eq. 2"),
        (0.6, 0.3, 0.25, 0.2, "unloading: eq. 3, 0.6 - 8 x 0.05"),
        (0.6, 0.3, 0.225, 0.001 * 2 * 0.225, "unloading to below the floor: lambda K_nl s"),
        (0.1, 0.25, 0.26, 0.18, "reloading below the loading line: eq. 3, 0.1 + 8 x 0.01"),
        (0.1, 0.25, 0.35, 0.7, "reloading up to the loading line: the smaller of the two, eq. 2"),
        (0.4, 0.2, 0.2, 0.4, "no motion: the force stays"),
        (0.1, 0.2, 0.2, 0.1, "no motion below the loading line: the force stays"),
        (0.6, 0.3, 0.0, 0.0, "separation at zero overlap"),
        (0.6, 0.3, -0.1, 0.0, "separation: no adhesion, lambda K_nl s would be negative"),
        (0.0, 0.0, -0.1, 0.0, "apart"),
    ],
)
def test_law_case_by_case(force, overlap, new_overlap, expected, case):
    # Four operations in double precision.
    np.testing.assert_allclose(law(force, overlap, new_overlap), expected, rtol=1e-14, err_msg=case)


def path(overlaps, epsilon, separation=0.0):
    """Forces along a path of overlaps (m), from no contact, with K_nl = 1 N/m."""

    def one(carry, s):
        force, overlap = carry
        f = walton_braun.clamp_to_branches(force + (s - overlap) / epsilon**2, s, 1.0, separation)
        return (f, jnp.maximum(s, 0.0)), f

    zero = jnp.zeros(())
    return np.asarray(jax.lax.scan(one, (zero, zero), jnp.asarray(overlaps))[1])


def work(force, overlap):
    """Trapezoidal work on the spring (J)."""
    force, overlap = np.append(0.0, force), np.append(0.0, overlap)
    return np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(overlap))


def legs(*ends, steps=20000):
    """A path of overlaps 0 -> ends[0] -> ends[1] ..."""
    starts = (0.0, *ends[:-1])
    return np.concatenate(
        [np.linspace(a, b, steps + 1)[1:] for a, b in zip(starts, ends, strict=True)]
    )


@pytest.mark.parametrize(
    ("epsilon", "turn", "expected"),
    [
        (0.1, 0.9, 0.58591),
        (0.1, 0.6, 0.81318),
        (0.1, 0.3, 0.94955),
        (0.1, 0.0, 0.995),
        (0.5, 0.6, 0.635),
        (0.5, 0.3, 0.815),
        (0.5, 0.0, 0.875),
    ],
)
def test_work_of_load_unload_reload(epsilon, turn, expected):
    # The residual overlap is not remembered: reloading from below it climbs along K_nu at once.
    # With that memory the work would be 1/2 in every row. The table has 5 digits.
    overlap = legs(1.0, turn, 1.0)
    total = work(path(overlap, epsilon), overlap)
    meeting = turn / (1 - epsilon**2)  # where the climb along K_nu meets the loading line again
    assert abs(total - 0.5 * (1 + (1 - epsilon**2) * (1 - meeting**2))) < 2e-6  # kinks within
    # steps: 1 / epsilon^2 / steps^2 each
    assert abs(total - expected) < 8e-6


@pytest.mark.parametrize("epsilon", [0.1, 0.3, 0.7])
def test_reloading_above_the_floor_is_elastic(epsilon):
    # Cycles that stay off both the loading line and the floor take no work: the law has no damping
    # there.
    residual = 1 - epsilon**2
    near, far = residual + 0.2 * epsilon**2, residual + 0.8 * epsilon**2
    once, more = legs(1.0, near, steps=2000), legs(1.0, near, far, near, far, near, steps=2000)
    w_once, w_more = work(path(once, epsilon), once), work(path(more, epsilon), more)
    assert abs(w_more - w_once) < 1e-13  # rounding of 10^4 terms below 1


@pytest.mark.parametrize("epsilon", [0.1, 0.3, 0.7])
def test_work_kept_by_a_full_cycle_is_one_less_epsilon_squared(epsilon):
    # Load to 1 and separate: 1/2 goes in, epsilon^2 / 2 comes out (lambda = 0). Kinks within steps,
    # as above.
    overlap = legs(1.0, 0.0)
    assert abs(work(path(overlap, epsilon), overlap) - 0.5 * (1 - epsilon**2)) < 2e-6
    # With lambda the floor gives back lambda s*^2 / 2 more, less the triangle that the unloading
    # line keeps below it.
    switch = (1 - epsilon**2) / (1 - LAMBDA * epsilon**2)
    back = 0.5 * LAMBDA * switch**2 + 0.5 * (1 + LAMBDA * switch) * (1 - switch)
    assert abs(work(path(overlap, epsilon, LAMBDA), overlap) - (0.5 - back)) < 2e-6


def test_restitution_of_one_is_an_elastic_spring():
    overlap = legs(1.0, 0.2, 0.7, 0.0, steps=500)
    np.testing.assert_allclose(path(overlap, 1.0, LAMBDA), overlap, atol=1e-13)  # rounding of 2000
    # increments


def test_force_stays_between_floor_and_loading_line():
    overlap = np.maximum(np.cumsum(np.random.default_rng(0).normal(0, 0.02, 4000)), -0.05)
    force, s = path(overlap, 0.1, LAMBDA), np.maximum(overlap, 0)
    assert (force <= s * (1 + 1e-12)).all() and (force >= LAMBDA * s * (1 - 1e-12)).all()
    assert (force < 0.5 * s).any() and (force > 0.99 * s)[s > 0].any()  # both ends are visited


def test_stiffness_of_a_pair_is_in_series():
    np.testing.assert_allclose(springs.combine_in_series(3.0, 6.0), 2.0, rtol=1e-15)
