"""Precision is the caller's explicit choice, with and without the global flag."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import product_model
from product_model import compiled, ensemble, parameters, simulate

SCRIPT = """
import jax, numpy as np
import product_model as pm
assert not jax.config.jax_enable_x64
double = pm.simulate(pm.parameters(pieces=9, duration=0.3, sample=1e-3), 3)
single = pm.simulate(pm.parameters(pieces=9, duration=0.3, sample=1e-3, precision="f32"), 3)
assert double.force.dtype == np.float64 and single.force.dtype == np.float32
assert pm.compiled(pm.parameters(pieces=9, duration=0.3, sample=1e-3))(jax.random.key(3)).force.dtype == np.float64
assert not jax.config.jax_enable_x64
print(repr(float(np.asarray(double.force).sum())))
"""


def test_double_precision_without_the_global_flag_gives_the_same_numbers():
    environment = os.environ | {"PYTHONPATH": str(Path(product_model.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, env=environment
    )
    expected = float(
        np.asarray(simulate(parameters(pieces=9, duration=0.3, sample=1e-3), 3).force).sum()
    )
    assert float(done.stdout) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(("precision", "dtype"), [("f32", np.float32), ("f64", np.float64)])
def test_every_entry_point_keeps_the_precision(precision, dtype):
    params = parameters(pieces=4, duration=0.3, sample=1e-3, precision=precision)
    for trace in (simulate(params, 0), compiled(params)(jax.random.key(0)), ensemble(params, 0, 2)):
        assert {
            leaf.dtype
            for leaf in (trace.force, trace.height, trace.pulses.start, trace.sigma_height)
        } == {np.dtype(dtype)}


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_fast_way_makes_the_same_trace(precision):
    """To rounding: with its inputs fixed the compiler may work out products of them beforehand."""
    import jax.numpy as jnp

    params = parameters(pieces=9, duration=0.3, sample=1e-3, precision=precision)
    fast, slow = compiled(params)(jax.random.key(5)), simulate(params, 5)
    assert jax.tree.structure(fast) == jax.tree.structure(slow) and fast.grid == slow.grid
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        eps = jnp.finfo(a.dtype).eps if a.dtype != bool else 0.0
        np.testing.assert_allclose(
            np.asarray(a),
            np.asarray(b),
            rtol=16 * eps,
            atol=16 * eps * float(np.max(np.asarray(b))),
        )


def test_single_precision_is_as_good_as_its_digits():
    """Same heights in f32 and f64: times good to 2e-8 s, so 1e-3 of a sample, on pulses whose edges
    lie anywhere in one.
    """
    import jax.numpy as jnp

    from product_model import model
    from product_model.grid import Grid
    from product_model.portion import render

    height = 0.25 + 0.02 * np.random.default_rng(1).standard_normal(64)
    force = {}
    for dtype in (np.float32, np.float64):
        pulses = model.pulses(
            *(jnp.asarray(v, dtype) for v in (height, np.full(64, 1e-3), 500e-6, 9.81))
        )
        force[dtype] = np.asarray(
            jax.jit(render, static_argnums=(1, 2, 3))(
                pulses, Grid(0.15, 30e-6, 5000), "interval-mean", 1.0
            )
        )
    lone = 1e-3 * 2.2 / 500e-6
    assert np.abs(force[np.float32] - force[np.float64]).max() < 5e-3 * lone
