"""The heap in a weigh bucket at the end of a run: its height, the filling of the bucket, and the
pieces that are not part of it.
"""

from typing import NamedTuple

import numpy as np

from dem_jax.assembly.bucket_fill import bucket_capacity, scene_bucket_parts
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.io.run_data import Run
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.scene import Scene, parse_scene
from dem_jax.scene.fill_level import BucketCapacity, map_heights
from dem_jax.shapes import Shape, surface_mesh
from dem_jax.types import SETTLED_SPEED


class Heap(NamedTuple):
    """A heap in a bucket.

    height: (m) of its highest point above the bucket's deepest. brim_height: (m) of the brim.
    level: volume below the heap as seen from above over that of the bucket. count_above_brim:
    pieces in it whose highest point is above the brim. count_moving: pieces over the bucket's inside
    that are not at rest (``SETTLED_SPEED``), as in flight, which are not part of the heap.
    count_beside: pieces below the brim that are outside the mouth.
    """

    height: float
    brim_height: float
    level: float
    count_above_brim: int
    count_moving: int
    count_beside: int

    def __str__(self) -> str:
        size = f"heap {1e3 * self.height:.3g} mm high at the end, of {1e3 * self.brim_height:.3g} mm to the brim"
        said = f"{size}, {100 * self.level:.0f} % full"
        said += (
            f"; overfull: {_format_count(self.count_above_brim)} above the brim"
            if self.count_above_brim
            else ""
        )
        if self.count_moving:
            said += f"; {_format_count(self.count_moving)} still moving"
        return said + (
            f"; {_format_count(self.count_beside)} beside the bucket" if self.count_beside else ""
        )


def describe_heap(run: Run) -> str | None:
    """Describe the heap in the weigh bucket of a run, or of the first run of an ensemble; None: see
    ``find_heap``.
    """
    first = run if run.run_count is None else run.member(0)
    heap = find_heap(first)
    return (
        None
        if heap is None
        else f"weigh bucket{'' if run.run_count is None else ', first run'}: {heap}"
    )


def find_heap(run: Run) -> Heap | None:
    """The heap in the weigh bucket at the last stored poses of a single run; None for a scene
    without a weigh bucket or with one that opens, a run without poses, and an empty bucket.
    """
    scene = parse_scene(run.scene, "the file's scene")
    bucket = scene.weigh_bucket
    if (
        bucket is None
        or bucket.opening_angle_deg
        or scene.cycle
        or run.pieces is None
        or not len(run.pieces.time)
    ):
        return None
    capacity = bucket_capacity(scene, "weigh_bucket")
    if capacity is None:
        return None
    return _measure_heap(
        scene,
        capacity,
        np.asarray(run.pieces.position[-1], float),
        np.asarray(run.pieces.orientation[-1], float),
        np.linalg.norm(run.pieces.velocity[-1], axis=-1) >= SETTLED_SPEED,
    )


def _measure_heap(
    scene: Scene,
    capacity: BucketCapacity,
    position: np.ndarray,
    orientation: np.ndarray,
    moves: np.ndarray,
) -> Heap:
    """The heap of pieces at positions [N, 3] (m) with orientations [N, 4], in a bucket; moves: [N]
    bool, pieces that are not at rest.
    """
    feed = scene_bucket_parts(scene, "feed_bucket")
    top = np.inf if feed is None else feed.block.low[2]  # above it they are in the feed bucket
    cells = np.floor((position[:, :2] - capacity.surface.origin) / capacity.surface.cell).astype(
        int
    )
    there = ((cells >= 0) & (cells < capacity.is_wet.shape)).all(axis=1)
    is_in = there.copy()
    is_in[there] = capacity.is_wet[tuple(cells[there].T)]
    is_in &= (position[:, 2] > capacity.bottom) & (position[:, 2] < top)
    beside = int((~is_in & (position[:, 2] < capacity.brim)).sum())
    moving, is_in = int((is_in & moves).sum()), is_in & ~moves
    made = [
        shape for shape, taken in zip(build_piece_set(scene).shapes, is_in, strict=True) if taken
    ]
    faces = [
        _transform_faces(*row)
        for row in zip(made, position[is_in], orientation[is_in], strict=True)
    ]
    tops = np.array([max(face[:, 2].max() for face in piece) for piece in faces])
    if not faces:
        return Heap(0.0, capacity.brim - capacity.bottom, 0.0, 0, moving, beside)
    heights = map_heights([face for piece in faces for face in piece], like=capacity.surface).ridge
    ground = np.where(np.isfinite(capacity.surface.floor), capacity.surface.floor, capacity.brim)
    depth = np.where(capacity.is_wet, np.maximum(heights - ground, 0.0), 0.0)
    level = float(depth.sum()) * capacity.surface.cell**2 / capacity.volume
    over = int((tops > capacity.brim).sum())
    height = float(tops.max() - capacity.bottom)
    return Heap(height, capacity.brim - capacity.bottom, level, over, moving, beside)


def _transform_faces(
    shape: Shape, position: np.ndarray, orientation: np.ndarray
) -> list[np.ndarray]:
    """Faces of a piece at its pose, each [k, 3] (m)."""
    points, faces = surface_mesh(shape)
    placed = points @ quaternion_to_matrix(orientation).T + position
    return [placed[list(face)] for face in faces]


def _format_count(number: int) -> str:
    return f"{number} piece{'s' if number != 1 else ''}"
