"""The streaming form gives the batch form's numbers, one at a time, with a state that does not
grow.
"""

import jax
import numpy as np
import pytest

from product_model import BadInput, parameters, simulate, stream


@pytest.mark.parametrize("form", ["rectangular", "interval-mean"])
# some 100 x the unit of rounding
@pytest.mark.parametrize(("precision", "rounding"), [("f64", 1e-13), ("f32", 1e-5)])
def test_stream_equals_batch(form, precision, rounding):
    params = parameters(form=form, precision=precision, pieces=64, start=0.15, duration=0.2)
    batch = simulate(params, 7)
    state = stream.start(params, jax.random.key(7))
    size = sum(leaf.size for leaf in jax.tree.leaves(state))
    end, force = jax.jit(
        lambda s: jax.lax.scan(lambda s, _: stream.step(s), s, None, length=batch.grid.samples)
    )(state)
    assert force.dtype == np.dtype({"f32": "float32", "f64": "float64"}[precision])
    np.testing.assert_allclose(force, batch.force, atol=rounding * float(batch.force.max()))
    assert sum(leaf.size for leaf in jax.tree.leaves(end)) == size == 3 * 128 + 4


def test_calls_one_by_one_compile_once_and_go_on_after_the_grid():
    params = parameters(pieces=3, sample=1e-3, duration=0.3)
    batch = simulate(params, 1)
    state = stream.start(params, 1)
    step = jax.jit(stream.step)
    forces = []
    for _ in range(350):
        state, force = step(state)
        forces.append(float(force))
    assert step._cache_size() == 1
    np.testing.assert_allclose(forces[:300], batch.force, atol=1e-12)
    assert forces[-1] == pytest.approx(3 * 5.832e-3 * 9.81)


def test_a_station_model_takes_the_stream_as_its_input():
    """An under-damped oscillator (50 Hz) driven by the stream inside one scan settles at the static
    deflection of the portion.
    """
    params = parameters(pieces=9, sample=1e-4, duration=0.6)
    state = stream.start(params, 0)
    stiffness, mass, damping = 1e5, 1.0, 60.0

    def station(carry, _):
        state, x, v = carry
        state, force = stream.step(state)
        v = v + 1e-4 * (force - stiffness * x - damping * v) / mass
        return (state, x + 1e-4 * v, v), x

    zero = np.zeros(())
    (_, x, _), _ = jax.jit(lambda s: jax.lax.scan(station, (s, zero, zero), None, length=6000))(
        state
    )
    assert float(x) == pytest.approx(9 * 5.832e-3 * 9.81 / stiffness, rel=1e-3)  # e^-30*0.3 of the
    # impact is left


def test_a_smooth_stream_is_refused():
    with pytest.raises(BadInput, match="smooth"):
        stream.start(parameters(form="smooth"), 0)
