"""Vectors as three arrays, rotation matrices as three rows of three arrays.

On a CPU the layout of arrays changes the speed by a factor of 100: with the components unrolled in
Python and the pair index last and contiguous, XLA makes one vectorised loop of an expression; a sum
over a component axis of length 3 does not vectorise. A vector here is therefore a tuple ``(x, y,
z)`` of arrays of one shape (or shapes of one rank that broadcast), in any unit.
"""

from collections.abc import Callable
from typing import Any, overload

import jax
import jax.numpy as jnp

from dem_jax.math.barrier_primitives import DERIVATIVE_BARRIER, FUSION_BARRIER

Array = jax.Array
Vector = tuple[Array, Array, Array]
Matrix = tuple[Vector, Vector, Vector]


def dot(a: Vector, b: Vector) -> Array:
    """a . b."""
    return DERIVATIVE_BARRIER.bind(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(s: Array | float, a: Vector) -> Vector:
    """s a, with s an array or a number."""
    return (s * a[0], s * a[1], s * a[2])


def add_scaled(a: Vector, s: Array | float, b: Vector) -> Vector:
    """a + s b."""
    return (a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


def where(condition: Array, a: Vector, b: Vector) -> Vector:
    """a where the condition holds, b elsewhere."""
    return (
        jnp.where(condition, a[0], b[0]),
        jnp.where(condition, a[1], b[1]),
        jnp.where(condition, a[2], b[2]),
    )


def safe_sqrt(x: Array) -> Array:
    """Square root with derivative 0 (instead of infinity) at and below 0."""
    positive = x > 0
    return jnp.where(
        positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x)
    )


def norm(a: Vector) -> Array:
    """|a|, differentiable (with derivative 0) at a = 0."""
    return safe_sqrt(dot(a, a))


def normalize(a: Vector) -> Vector:
    """a / |a|, and 0 (with derivative 0) where a is 0."""
    size = norm(a)
    return scale(jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 0), a)


def map_components(function: Callable[[Array], Array], a: Vector) -> Vector:
    """Apply a function to each component."""
    return (function(a[0]), function(a[1]), function(a[2]))


def take_entries(a: Vector, index: Any) -> Vector:
    """Entries of each component; index: any array index."""
    return (a[0][index], a[1][index], a[2][index])


def expand_dims(a: Vector, axis: int | tuple[int, ...]) -> Vector:
    """Insert an axis of length 1, or several, into each component."""
    return (jnp.expand_dims(a[0], axis), jnp.expand_dims(a[1], axis), jnp.expand_dims(a[2], axis))


def rotate(r: Matrix, a: Vector) -> Vector:
    """R a."""
    return (dot(r[0], a), dot(r[1], a), dot(r[2], a))


def transpose(r: Matrix) -> Matrix:
    """Transpose of R, the inverse rotation."""
    x, y, z = r
    return ((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]))


def rotate_back(r: Matrix, a: Vector) -> Vector:
    """R^T a."""
    return rotate(transpose(r), a)


def matmul(r: Matrix, s: Matrix) -> Matrix:
    """R S."""
    x, y, z = transpose(s)
    return transpose((rotate(r, x), rotate(r, y), rotate(r, z)))


def expand_matrix_dims(r: Matrix, axis: int | tuple[int, ...]) -> Matrix:
    """Insert an axis of length 1, or several, into each entry."""
    return (expand_dims(r[0], axis), expand_dims(r[1], axis), expand_dims(r[2], axis))


def unstack_vector(array: Array) -> Vector:
    """The tuple of the components of an array [3, ...]."""
    return (array[0], array[1], array[2])


@overload
def fusion_barrier(array: Array, /) -> Array: ...
@overload
def fusion_barrier(x: Array, y: Array, /) -> tuple[Array, Array]: ...
@overload
def fusion_barrier(x: Array, y: Array, z: Array, /) -> Vector: ...
@overload
def fusion_barrier(*arrays: Array) -> tuple[Array, ...]: ...
def fusion_barrier(*arrays: Array) -> Any:
    """The same arrays, to the last bit, each computed once although several kernels use it, see
    ``barrier_primitives``.
    """
    found = tuple(FUSION_BARRIER.bind(x) for x in arrays)
    return found if len(found) > 1 else found[0]
