"""Faces, corners and edges of convex polytopes as tables on which general narrow-phase search works, padded to few sizes.

A shape with fewer of them than its table has repeats its first; ``Features.counts`` says how many are its own.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import DTypeLike

from dem_jax.maths.pose import matrix_of_quaternion
from dem_jax.shapes import Shape
from dem_jax.types import Array, Features, host

AROUND = np.concatenate([np.eye(3), -np.eye(3), list(product((-1.0, 1.0), repeat=3))])  # [14, 3]
SIZES = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)


def table(
    shapes: Sequence[Shape],
    dtype: DTypeLike,
    parts: Sequence[Shape] | None = None,
    inner: Sequence[Sequence[bool]] | None = None,
    all_clip: bool = False,
    is_bent: bool = False,
) -> Features:
    """Features of polytopes [S] by which depth and normal are found.

    parts: what of them has the faces that touch, None: all of it; inner: for each of its faces whether other parts cover it;
    all_clip, is_bent: as in Features.
    """
    rows = [_Rows(shape) for shape in shapes]
    own = rows if parts is None else [_Rows(shape) for shape in parts]
    planes, corners = _planes(rows, dtype), _corners(rows, dtype)
    sides = max(len(ring) for row in own for ring in row.rings)
    faces = _roomy(max(len(row.rings) for row in own))
    edges = _roomy(max(len(row.edges) for row in rows))
    return Features(
        planes=planes,
        corners=corners,
        edges=_stack([_padded(row.edges, edges) for row in rows], dtype),
        tips=_stack([row.corners[np.argmax(row.corners @ AROUND.T, axis=0)] for row in rows], dtype),
        own_planes=planes if parts is None else _planes(own, dtype),
        own_corners=corners if parts is None else _corners(own, dtype),
        inner=None if inner is None else _inner(inner, faces, dtype),
        rings=_stack([_padded(np.array([_filled(ring, sides) for ring in row.rings]), faces) for row in own], np.int32),
        counts=_counts(rows, own),
        all_clip=all_clip,
        is_bent=is_bent,
    )


class _Rows:
    """A shape's faces [F, 4], corners [V, 3], edges [E, 13] and the corners of each face, in the
    principal frame."""

    def __init__(self, shape: Shape) -> None:
        turn = matrix_of_quaternion(shape.principal)
        self.corners = shape.vertices @ turn
        normals = shape.normals @ turn
        self.planes = np.c_[normals, shape.offsets]
        self.rings = shape.faces
        self.edges = self._edges(normals, shape.edges)

    def _edges(self, normals: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Middle, unit direction, half length, and the directions into the two faces, in them and square to the edge."""
        number = {tuple(edge): k for k, edge in enumerate(ends.tolist())}
        faces: list[list[int]] = [[] for _ in number]
        for f, ring in enumerate(self.rings):
            for i in range(len(ring)):
                one, other = ring[i - 1], ring[i]
                faces[number[(min(one, other), max(one, other))]].append(f)
        both = normals[np.array(faces)]  # [E, 2, 3]
        start, end = (self.corners[ends[:, k]] for k in (0, 1))
        half = 0.5 * np.linalg.norm(end - start, axis=1, keepdims=True)
        along = 0.5 * (end - start) / half
        inward = np.cross(both, along[:, None])
        inward *= np.sign(np.einsum("ekc,ekc->ek", inward, -both[:, ::-1]))[..., None]  # away from where the other face looks
        return np.concatenate([0.5 * (start + end), along, half, inward.reshape(-1, 6)], axis=1)


def _counts(rows: list[_Rows], own: list[_Rows]) -> Array:
    each = [[len(r.planes), len(r.corners), len(r.edges), len(o.planes)] for r, o in zip(rows, own, strict=True)]
    return host(np.array(each, np.int32).T)


def _inner(covered: Sequence[Sequence[bool]], faces: int, dtype: DTypeLike) -> Array:
    """Features.inner."""
    return host(np.stack([_padded(np.asarray(x, float), faces) for x in covered], axis=-1).astype(dtype))


def _planes(rows: list[_Rows], dtype: DTypeLike) -> Array:
    count = _roomy(max(len(row.planes) for row in rows))
    return _stack([_padded(row.planes, count) for row in rows], dtype)


def _corners(rows: list[_Rows], dtype: DTypeLike) -> Array:
    count = _roomy(max(len(row.corners) for row in rows))
    return _stack([_padded(row.corners, count) for row in rows], dtype)


def _roomy(count: int) -> int:
    """The next of a few sizes, so that shapes of about as many corners share what is compiled."""
    return next((size for size in SIZES if size >= count), count)


def _padded(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[:1], count - len(rows), axis=0)])


def _filled(ring: tuple[int, ...], sides: int) -> tuple[int, ...]:
    return ring + ring[-1:] * (sides - len(ring))


def _stack(rows: list[np.ndarray], dtype: DTypeLike) -> Array:
    """S arrays [K, c] -> [c, K, S]."""
    return host(np.stack(rows, axis=-1).transpose(1, 0, 2).astype(dtype))
