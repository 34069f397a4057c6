"""Conversion of arrays to the precision of the run."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from dem_jax.assembly.assembly_cache import AssemblyCache

Tree = TypeVar("Tree")


def put_array(x: ArrayLike) -> jax.Array:
    """An array as JAX's. ``jnp.asarray`` would compile a copy for each shape, in 4 to 19 ms."""
    return jax.device_put(x) if isinstance(x, np.ndarray | np.generic) else jnp.asarray(x)


def cast_tree(tree: Tree, dtype: DTypeLike) -> Tree:
    """Convert float leaves to the dtype and int leaves to int32."""

    def cast_leaf(x: ArrayLike) -> np.ndarray | jax.Array:
        if isinstance(x, jax.core.Tracer):
            return jnp.asarray(x, np.dtype(dtype))
        x = np.asarray(x)  # converted here: nothing to compile
        return x.astype(np.int32 if x.dtype.kind == "i" else dtype)

    leaves, structure = jax.tree.flatten(tree)
    with np.errstate(over="ignore"):  # see assembly.finiteness_check
        cast = [cast_leaf(x) for x in leaves]
    on_host = [k for k, x in enumerate(cast) if isinstance(x, np.ndarray)]
    put = jax.device_put([cast[k] for k in on_host])  # in one call, which takes most of the time
    for k, array in zip(on_host, put, strict=True):
        cast[k] = array
    made: Tree = jax.tree.unflatten(structure, cast)
    return made


def cast_array(x: ArrayLike, dtype: DTypeLike) -> jax.Array:
    """Numbers as an array, converted as by ``cast_tree``."""
    return put_array(np.asarray(x, dtype))


def reuse_array(reuse: AssemblyCache, name: str, numbers: ArrayLike, dtype: DTypeLike) -> jax.Array:
    """Numbers as an array; the array of an earlier scene if the numbers are equal."""
    found = np.asarray(numbers, dtype)
    return reuse.get(
        name, lambda: cast_array(found, dtype), (found.tobytes(), found.shape, found.dtype)
    )


def reuse_tree(reuse: AssemblyCache, name: str, tree: Tree, dtype: DTypeLike) -> Tree:
    """Convert as ``cast_tree``, reusing the arrays of an earlier scene for leaves with equal
    numbers.
    """
    leaves, structure = jax.tree.flatten(tree)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return cast_tree(tree, dtype)
    with np.errstate(over="ignore"):  # see assembly.finiteness_check
        types = [np.int32 if np.asarray(leaf).dtype.kind == "i" else dtype for leaf in leaves]
        kept = [
            reuse_array(reuse, f"{name} {k}", x, own)
            for k, (x, own) in enumerate(zip(leaves, types, strict=True))
        ]
    return reuse.get(name, lambda: jax.tree.unflatten(structure, kept), (structure,), tuple(kept))
