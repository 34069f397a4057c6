"""What kick, drift, kick leaves out where a force has a corner: against integrals that are known."""

import numpy as np

from dem_jax.contact_laws.impulse_correction import KinkCorrection, bernoulli_kernel


def hat(time, begin, top, end):
    """A force of slope 1 up to its top, and down to nothing at the end."""
    return np.maximum(np.minimum(time - begin, (top - begin) * (end - time) / (end - top)), 0)


def test_impulses_of_a_force_with_corners_are_exact():
    random, steps = np.random.default_rng(3), np.arange(20.0)  # dt = 1
    for _ in range(50):
        begin, top, end = np.sort(random.uniform(1, 18, 3))
        down = (top - begin) / (end - top)
        jumps = {begin: 1.0, top: -1 - down, end: down}
        added = sum(jump * bernoulli_kernel(np.ceil(at) - at) for at, jump in jumps.items())
        area, summed = 0.5 * (end - begin) * (top - begin), hat(steps, begin, top, end).sum()
        np.testing.assert_allclose(summed + added, area, rtol=1e-12)
    assert abs(bernoulli_kernel((np.arange(1000) + 0.5) / 1000).mean()) < 1e-7  # so that nothing is
    # added in the mean


def test_no_corner_pulls_and_friction_stays_below_its_limit():
    part, used = (x.ravel() for x in np.meshgrid(np.linspace(1e-3, 1, 200), np.linspace(0, 1, 21)))
    always, never = np.ones_like(part, bool), np.zeros_like(part, bool)
    for touches, parts in ((always, never), (never, always)):
        corner = KinkCorrection(touches, parts, np.ones_like(part), part)  # F_n goes by 1 N in a
        # step: it is as large as the part
        push = part + np.asarray(corner.normal_correction())
        drag = (
            0.3
            * used
            * part
            * (1 + np.asarray(corner.tangential_correction(part, 0.3 * used * part, 0.3)))
        )
        assert (push > 0).all()
        assert (np.abs(drag) <= 0.3 * push * (1 + 1e-12)).all()


def test_nothing_is_added_where_the_step_is_too_coarse():
    one = np.ones(1)
    for touches in (True, False):
        corner = KinkCorrection(np.array([touches]), np.array([not touches]), 0 * one, 0.3 * one)
        assert (
            corner.normal_correction() == 0
            and corner.tangential_correction(one, 0.1 * one, 0.3) == 0
        )
