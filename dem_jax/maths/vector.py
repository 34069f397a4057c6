"""Vectors as three arrays, rotation matrices as three rows of three arrays.

On a CPU the way arrays are written decides a factor of 100 in speed: with the components unrolled in
Python and the pair index last and contiguous, XLA makes one vectorised loop of an expression; a
component axis of length 3 that is summed over does not vectorise. A vector here is therefore a tuple
``(x, y, z)`` of arrays of one shape (or shapes of one rank that broadcast), in any unit.
"""

import jax
import jax.numpy as jnp


def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(a, b):
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a, b):
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(s, a):
    """s a, with s an array or a number."""
    return (s * a[0], s * a[1], s * a[2])


def add_scaled(a, s, b):
    """a + s b."""
    return (a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


def where(condition, a, b):
    """a where the condition holds, b elsewhere."""
    return tuple(jnp.where(condition, p, q) for p, q in zip(a, b, strict=True))


def safe_sqrt(x):
    """Square root with derivative 0 (instead of infinity) at and below 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x))


def norm(a):
    """|a|, differentiable (with derivative 0) at a = 0."""
    return safe_sqrt(dot(a, a))


def unit(a):
    """a / |a|, and 0 (with derivative 0) where a is 0."""
    size = norm(a)
    return scale(jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 0), a)


def expand(a, axis):
    """Insert an axis of length 1 into each component."""
    return tuple(jnp.expand_dims(p, axis) for p in a)


def rotate(r, a):
    """R a."""
    return (dot(r[0], a), dot(r[1], a), dot(r[2], a))


def transpose(r):
    """Transpose of R, the inverse rotation."""
    return tuple((r[0][i], r[1][i], r[2][i]) for i in range(3))


def rotate_back(r, a):
    """R^T a."""
    return rotate(transpose(r), a)


def compose(r, s):
    """R S."""
    columns = [rotate(r, c) for c in transpose(s)]
    return transpose(tuple(columns))


def expand_matrix(r, axis):
    """Insert an axis of length 1 into each entry."""
    return tuple(expand(row, axis) for row in r)


def unpack(array):
    """[3, ...] -> the tuple of its components."""
    return (array[0], array[1], array[2])


def kept(*arrays):
    """The same arrays, to the last bit, each computed once although several kernels use it.

    XLA fuses a cheap producer into every consumer, and on the CPU an optimisation barrier does not stop it; what ends
    in a division it takes for too expensive to repeat.
    """
    kept = tuple(_kept(x) for x in arrays)
    return kept if len(kept) > 1 else kept[0]


@jax.custom_jvp
def _kept(x):
    """x / 1, where it takes the compiler of machine code, who leaves the division out, to see that it is 1."""
    bits = jax.lax.bitcast_convert_type(x, {4: jnp.int32, 8: jnp.int64}[x.dtype.itemsize])
    return x / jnp.maximum(jnp.minimum(bits, 1), 1).astype(x.dtype)


@_kept.defjvp
def _derivative_of_kept(primals, tangents):
    """That of the identity."""
    return _kept(*primals), *tangents
