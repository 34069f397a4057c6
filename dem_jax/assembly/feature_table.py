"""Tables of faces, corners and edges of convex polytopes for the general narrow phase, padded to a
few sizes.

A shape with fewer entries than its table repeats its first one; ``PolytopeFeatures.counts`` gives
the number of its own entries.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import DTypeLike

from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import Shape
from dem_jax.types import Array, PolytopeFeatures, as_array

# [14, 3]
SUPPORT_DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3), list(product((-1.0, 1.0), repeat=3))])
TABLE_SIZES = (
    4,
    6,
    8,
    12,
    16,
    24,
    32,
    48,
    64,
    96,
    128,
    192,
    256,
    384,
    512,
    768,
    1024,
    1536,
    2048,
    3072,
    4096,
)
# sizes of tables that different products share: of bodies of prisms, and of smooth bodies
CLASS_SIZES = {
    "faces": (6, 8, 48),
    "corners": (8, 32),
    "edges": (12, 96),
    "directions": (4, 64),
    "sides": (4, 16),
}


def round_to_class(what: str, count: int, rounded: bool, exact: int | None = None) -> int:
    """Size of a table: that of a class if ``rounded`` and if there is one, else ``exact``, by default
    the next of the TABLE_SIZES.

    Args:
        what: a key of CLASS_SIZES.
        count: largest number of any shape.
        rounded: whether products share tables.
        exact: size of a table that is not shared.
    """
    exact = _next_table_size(count) if exact is None else exact
    classes = CLASS_SIZES[what] if rounded else ()
    return next((size for size in classes if size >= count), exact)


def build_feature_table(
    shapes: Sequence[Shape],
    dtype: DTypeLike,
    parts: Sequence[Shape] | None = None,
    inner: Sequence[Sequence[bool]] | None = None,
    all_clip: bool = False,
    is_bent: bool = False,
    rounded: bool = False,
) -> PolytopeFeatures:
    """Features of S polytopes, from which depth and normal are found.

    Args:
        shapes: the polytopes.
        dtype: of the arrays.
        parts: the parts whose faces can touch; None if these are the shapes themselves.
        inner: for each face of a part, whether other parts cover it.
        all_clip, is_bent: as in ``PolytopeFeatures``.
        rounded: as in ``round_to_class``.
    """
    rows = [_ShapeFeatures(shape) for shape in shapes]
    own = rows if parts is None else [_ShapeFeatures(shape) for shape in parts]
    planes, corners = _stack_planes(rows, dtype, rounded), _stack_corners(rows, dtype, rounded)
    sides = max(len(ring) for row in own for ring in row.rings)
    sides = round_to_class("sides", sides, rounded, sides)
    faces = round_to_class("faces", max(len(row.rings) for row in own), rounded)
    edges = round_to_class("edges", max(len(row.edges) for row in rows), rounded)
    return PolytopeFeatures(
        planes=planes,
        corners=corners,
        edges=_stack_rows([_pad_rows(row.edges, edges) for row in rows], dtype),
        extreme_vertices=_stack_rows(
            [row.corners[np.argmax(row.corners @ SUPPORT_DIRECTIONS.T, axis=0)] for row in rows],
            dtype,
        ),
        part_planes=planes if parts is None else _stack_planes(own, dtype, rounded),
        part_corners=corners if parts is None else _stack_corners(own, dtype, rounded),
        interior_faces=None if inner is None else _stack_interior(inner, faces, dtype),
        face_vertices=_stack_rows(
            [
                _pad_rows(np.array([_fill_loop(ring, sides) for ring in row.rings]), faces)
                for row in own
            ],
            np.int32,
        ),
        counts=_count_features(rows, own),
        all_clip=all_clip,
        is_bent=is_bent,
    )


class _ShapeFeatures:
    """Faces [F, 4], corners [V, 3], edges [E, 13] and face loops of a shape, in its principal
    frame.
    """

    def __init__(self, shape: Shape) -> None:
        turn = quaternion_to_matrix(shape.principal)
        self.corners = shape.vertices @ turn
        normals = shape.normals @ turn
        self.planes = np.c_[normals, shape.offsets]
        self.rings = shape.faces
        self.edges = self._describe_edges(normals, shape.edges)

    def _describe_edges(self, normals: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Midpoint, unit direction, half length, and for both adjacent faces the in-face direction
        perpendicular to the edge, [E, 13].
        """
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
        # opposite to the normal of the other face
        inward *= np.sign(np.einsum("ekc,ekc->ek", inward, -both[:, ::-1]))[..., None]
        return np.concatenate([0.5 * (start + end), along, half, inward.reshape(-1, 6)], axis=1)


def _count_features(rows: list[_ShapeFeatures], own: list[_ShapeFeatures]) -> Array:
    each = [
        [len(r.planes), len(r.corners), len(r.edges), len(o.planes)]
        for r, o in zip(rows, own, strict=True)
    ]
    return as_array(np.array(each, np.int32).T)


def _stack_interior(covered: Sequence[Sequence[bool]], faces: int, dtype: DTypeLike) -> Array:
    """``PolytopeFeatures.interior_faces`` of S shapes."""
    return as_array(
        np.stack([_pad_rows(np.asarray(x, float), faces) for x in covered], axis=-1).astype(dtype)
    )


def _stack_planes(rows: list[_ShapeFeatures], dtype: DTypeLike, rounded: bool) -> Array:
    count = round_to_class("faces", max(len(row.planes) for row in rows), rounded)
    return _stack_rows([_pad_rows(row.planes, count) for row in rows], dtype)


def _stack_corners(rows: list[_ShapeFeatures], dtype: DTypeLike, rounded: bool) -> Array:
    count = round_to_class("corners", max(len(row.corners) for row in rows), rounded)
    return _stack_rows([_pad_rows(row.corners, count) for row in rows], dtype)


def _next_table_size(count: int) -> int:
    """The next of a few table sizes, so that shapes with similar numbers of features share a
    compiled program.
    """
    return next((size for size in TABLE_SIZES if size >= count), count)


def _pad_rows(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[:1], count - len(rows), axis=0)])


def _fill_loop(ring: tuple[int, ...], sides: int) -> tuple[int, ...]:
    return ring + ring[-1:] * (sides - len(ring))


def _stack_rows(rows: list[np.ndarray], dtype: DTypeLike) -> Array:
    """Stack S arrays [K, c] into one [c, K, S]."""
    return as_array(np.stack(rows, axis=-1).transpose(1, 0, 2).astype(dtype))
