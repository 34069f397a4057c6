"""Uniform numbers against those of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from product_model import draws


@pytest.mark.parametrize("generator", ["threefry2x32", "rbg"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("count", [1, 319])
def test_numbers_are_those_of_jax(generator, dtype, count):
    low = np.nextafter(np.array(-1.0, dtype), np.array(0.0, dtype))
    with jax.enable_x64(True):
        for seed in (0, 1, 2**31 - 1):
            key = jax.random.key(seed, impl=generator)
            found = jax.jit(draws.uniform, static_argnums=(1, 2, 3, 4))(key, count, dtype, low, 1.0)
            assert found.dtype == dtype
            np.testing.assert_array_equal(found, jax.random.uniform(key, (count,), dtype, low, 1.0))


def test_keys_of_the_older_kind_and_keys_side_by_side():
    keys = jax.random.split(jax.random.key(5), 4)
    many = jax.vmap(lambda key: draws.uniform(key, 9, jnp.float32, 0.0, 1.0))(keys)
    for key, found in zip(keys, many, strict=True):
        np.testing.assert_array_equal(found, jax.random.uniform(key, (9,), jnp.float32))
    old = jax.random.PRNGKey(3)
    np.testing.assert_array_equal(
        draws.uniform(old, 9, jnp.float32, 0.0, 1.0), jax.random.uniform(old, (9,), jnp.float32)
    )
