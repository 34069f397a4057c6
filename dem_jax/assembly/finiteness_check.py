"""Checks that the arrays of a scene are finite in the precision of the run, and that its counts are
not too large.
"""

from typing import Any

import jax
import numpy as np

from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.scene.unusual_numbers import most_unusual_key
from dem_jax.types import State, System

MOST_STEPS = 2**31 - 2**17  # steps are counted in 32 bits, with a reserve for the steps until a
# rebuild
MOST_PIECES = 10**6
# of a System
FINITE_PARTS = (
    "pieces",
    "materials",
    "law",
    "reach",
    "gravity",
    "dt",
    "skin",
    "domain_low",
    "domain_high",
)
POSITIVE_PARTS = (
    "pieces.mass",
    "pieces.inertia",
    "pieces.size",
    "pieces.width",
    "materials.youngs_modulus",
    "dt",
    "skin",
)


def check_steps(scene: Scene, settling: int, samples: int, substeps: int, dt: float) -> None:
    """Raise SceneError for a run with more steps than an int32 counts. settling: steps before the
    release.
    """
    steps = settling + samples * substeps
    if steps > MOST_STEPS:
        raise SceneError(
            f"{scene.name}: {steps:.4g} steps of {dt:.3g} s; allowed: at most {MOST_STEPS:.4g}; "
            f"furthest from what is usual is {most_unusual_key(scene)}"
        )


def check_pieces(scene: Scene, count: float) -> None:
    """Raise SceneError for a number of pieces beyond ``MOST_PIECES``."""
    if not count <= MOST_PIECES:
        raise SceneError(
            f"{scene.name}: {count:.4g} pieces; allowed: at most {MOST_PIECES:.0e}; "
            f"furthest from what is usual is {most_unusual_key(scene)}"
        )


def check_finite(scene: Scene, system: System, state: State, reuse: AssemblyCache) -> None:
    """Raise SceneError if an initial array is not finite in the precision of the run. reuse: arrays
    of earlier scenes are not checked again.
    """
    known = reuse.get("finite", dict[int, Any])  # id -> the leaf, which is kept alive
    for tree, must in ((system, FINITE_PARTS), (state.replace(scratch=None), None)):
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
            if id(leaf) in known or not np.issubdtype(leaf.dtype, np.floating):
                continue
            known[id(leaf)] = leaf
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            values = np.asarray(leaf)
            finite = must is None or name.split(".")[0] in must
            bad = ~np.isfinite(values) if finite else np.isnan(values)
            if bad.any() or (must and name in POSITIVE_PARTS and not (values > 0).all()):
                precision = {"f32": "single", "f64": "double"}[scene.run.precision]
                raise SceneError(
                    f"{scene.name}: {name.replace('_', ' ')} is beyond the numbers of {precision} precision; "
                    f"furthest from what is usual is {most_unusual_key(scene)}"
                )
