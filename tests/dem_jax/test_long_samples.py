"""Sample intervals of many steps: cut into parts, with the same trace and without compiling for
long.
"""

import numpy as np

import dem_jax
from dem_jax import assembly


def test_a_long_sample_interval_has_the_mean_of_the_short_ones():
    """A prime number of steps, 61, to a sample is rounded up to parts of equally many."""
    short = dem_jax.load_scene("plate-drop").replace(
        {
            "piece": [{"position": (0.0, 0.0, 0.03)}],
            "run.precision": "f64", "run.duration": 0.16, "run.sample_interval": 1e-4, "run.frame_interval": 0.0,
        }
    )  # fmt: skip
    made = assembly.assemble_system(short, 0)
    dt = made.step.dt
    many = 61 * 40 * dt
    long = short.replace({"run.sample_interval": many, "run.time_step": dt})
    parted = assembly.assemble_system(long, 0)
    assert parted.system.sample_parts > 40 and parted.system.block_steps >= int(
        parted.system.substeps
    )
    assert (
        int(parted.system.substeps) * parted.system.sample_parts == parted.step.substeps >= 61 * 40
    )
    coarse, fine = dem_jax.simulate(long), dem_jax.simulate(short)
    impulse = lambda run, interval: -run.mean_force["plate"][:, 2].sum() * interval
    assert impulse(fine, 1e-4) > 1e-3
    end = coarse.time[-1]
    until = fine.time <= end + 1e-9
    expected = -fine.mean_force["plate"][until, 2].sum() * 1e-4
    np.testing.assert_allclose(impulse(coarse, many), expected, rtol=0.02)
