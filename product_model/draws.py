"""Uniform random numbers of a key, those of ``jax.random.uniform``, in a form that is fast on a
CPU.

On a CPU, JAX computes the rounds of Threefry in a loop, each iteration of which is a dozen tasks
for a thread pool: longer than all the rest of one portion. Unrolled, the rounds are one function.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

DType = type[np.floating] | np.dtype[np.floating]

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))  # of Threefry-2x32 with 20 rounds, Salmon et al.,
# SC 2011
PARITY = 0x1BD11BDA
MANTISSA: dict[str, Any] = {
    "float32": (9, 0x3F800000, jnp.uint32),
    "float64": (12, 0x3FF0000000000000, jnp.uint64),
}


def uniform(
    key: jax.Array, count: int, dtype: DType, low: float | np.ndarray, high: float | np.ndarray
) -> jax.Array:
    """[count] uniform on [low, high), the same as ``jax.random.uniform`` gives for a key of any
    generator.
    """
    if str(jax.random.key_impl(key)) != "threefry2x32":
        return jax.random.uniform(key, (count,), dtype, low, high)
    first, second = threefry(jax.random.key_data(key), count)
    shift, one, word = MANTISSA[np.dtype(dtype).name]
    bits = (
        first ^ second
        if word == jnp.uint32
        else (first.astype(word) << word(32)) | second.astype(word)
    )
    # on [0, 1)
    unit = jax.lax.bitcast_convert_type((bits >> word(shift)) | word(one), dtype) - np.array(
        1, dtype
    )
    low, high = np.array(low, dtype), np.array(high, dtype)
    return jnp.maximum(low, unit * (high - low) + low)


def threefry(key: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Two words [count] each, uint32: Threefry-2x32 of the counters 0 to count - 1. key: [2]
    uint32.
    """
    keys = key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(PARITY)
    a = jnp.broadcast_to(keys[0], (count,))
    b = jnp.arange(count, dtype=jnp.uint32) + keys[1]
    for turn in range(5):
        for distance in ROTATIONS[turn % 2]:
            a = a + b
            b = a ^ ((b << jnp.uint32(distance)) | (b >> jnp.uint32(32 - distance)))
        a, b = a + keys[(turn + 1) % 3], b + (keys[(turn + 2) % 3] + jnp.uint32(turn + 1))
    return a, b
