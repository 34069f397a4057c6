"""Operations that return their argument: to the last bit, with the derivatives of the identity, in
every transformation.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax.math.barrier_primitives import DERIVATIVE_BARRIER, FUSION_BARRIER

VALUES = [0.0, -0.0, 1.0, -2.5, 1e-40, 3e38, np.inf, -np.inf, np.nan]


@pytest.mark.parametrize("identity", [FUSION_BARRIER, DERIVATIVE_BARRIER])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int32"])
def test_the_value_is_the_same_to_the_last_bit(identity, dtype):
    x = np.arange(-4, 5, dtype=dtype) if dtype == "int32" else np.array(VALUES, dtype)
    with np.errstate(all="ignore"):
        for found in (identity.bind(x), jax.jit(identity.bind)(x), jax.vmap(identity.bind)(x)):
            assert found.dtype == x.dtype
            if dtype != "int32":
                # XLA flushes these
                x, found = (
                    np.where(np.abs(y) < np.finfo(dtype).tiny, 0 * y, y) for y in (x, found)
                )
            np.testing.assert_array_equal(found, x)
            assert dtype == "int32" or np.array_equal(np.signbit(found), np.signbit(x))


@pytest.mark.parametrize("identity", [FUSION_BARRIER, DERIVATIVE_BARRIER])
def test_derivatives_are_those_of_the_identity(identity):
    f = lambda x: jnp.sum(jnp.sin(identity.bind(x)) * identity.bind(x * x))
    g = lambda x: jnp.sum(jnp.sin(x) * (x * x))
    x, along = jnp.array([0.3, -1.2, 2.0]), jnp.array([1.0, 0.5, -2.0])
    for transform in (
        jax.grad,
        jax.jacfwd,
        jax.hessian,
        lambda f: lambda x: jax.jvp(f, (x,), (along,))[1],
    ):
        np.testing.assert_allclose(jax.jit(transform(f))(x), jax.jit(transform(g))(x), rtol=1e-12)
    rows = jnp.stack([x, 2 * x])
    np.testing.assert_allclose(jax.vmap(jax.grad(f))(rows), jax.vmap(jax.grad(g))(rows), rtol=1e-12)
    np.testing.assert_allclose(jax.grad(jax.checkpoint(f))(x), jax.grad(g)(x), rtol=1e-12)
