"""Panels that are cut where a seam ends within an edge: afterwards other panels continue an edge along
its whole length or nowhere, as ``panel_surfaces`` needs. Host side, float64, SI.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from dem_jax.math.loops import next_corners
from dem_jax.scene.bucket_geometry import Panel
from dem_jax.shapes import wall_meshes

GAP = 1e-4  # of an edge: a shorter part of it beside a seam does not count

Corners = tuple[tuple[float, ...], ...]
Cut = tuple[np.ndarray, np.ndarray]  # a point of an edge (m), and the unit direction of the edge


def cut_at_ends_of_seams(panels: Sequence[Panel], smooth_angle: float) -> list[Panel]:
    """The panels in their order, those with a seam that ends within an edge cut across that edge.

    Args:
        panels: of the scene.
        smooth_angle: (rad) largest angle between two panels that continue each other.
    """
    cut = list[list[Panel]]([panel] for panel in panels)
    for group in dict.fromkeys(name for name, _, _ in panels):
        members = [i for i, (name, _, _) in enumerate(panels) if name == group]
        if len(members) == 1:
            continue
        rows = tuple(tuple(map(tuple, np.asarray(panels[i][1], float).tolist())) for i in members)
        for i, parts in zip(members, _cut_group(rows, smooth_angle), strict=True):
            if len(parts) > 1:
                cut[i] = [(group, np.array(part), panels[i][2]) for part in parts]
    return [part for parts in cut for part in parts]


@lru_cache(maxsize=32)
def _cut_group(panels: tuple[Corners, ...], smooth_angle: float) -> list[list[np.ndarray]]:
    """The parts [k, 3] (m) of each panel of a group; cached, as a scene is laid out several times."""
    corners = [np.array(panel) for panel in panels]
    beyond = wall_meshes.find_neighbours(corners, max(smooth_angle, wall_meshes.COPLANAR_ANGLE))
    found = []
    for own, edges in zip(corners, beyond, strict=True):
        parts = [own]
        for start, end, others in zip(own, next_corners(own), edges, strict=True):
            for cut in _list_cuts(start, end, [corners[j] for j in others]):
                parts = [piece for part in parts for piece in _cut_part(part, cut)]
        found.append(parts)
    return found


def _list_cuts(start: np.ndarray, end: np.ndarray, others: Sequence[np.ndarray]) -> list[Cut]:
    """Where an edge is to be cut: at the ends of seams with others [., 3] (m) that lie within it."""
    length = float(np.linalg.norm(end - start))
    along, near = (end - start) / length, GAP * length
    seams: list[list[float]] = []
    for low, high in sorted(_project_edge(points, start, along, near) for points in others):
        if seams and low <= seams[-1][1] + near:
            seams[-1][1] = max(seams[-1][1], high)
        else:
            seams.append([low, high])
    ends = (way for seam in seams for way in seam if near < way < length - near)
    return [(start + way * along, along) for way in ends]


def _project_edge(
    points: np.ndarray, start: np.ndarray, along: np.ndarray, near: float
) -> tuple[float, float]:
    """From where to where (m) the edge of a panel [k, 3] lies that is on a line, along it."""
    way = (points - start) @ along
    aside = np.linalg.norm(points - start - way[:, None] * along, axis=1)
    way = way[aside <= np.sort(aside)[1] + near]
    return float(way.min()), float(way.max())


def _cut_part(part: np.ndarray, cut: Cut) -> list[np.ndarray]:
    """A convex polygon [k, 3] (m), or its two halves if the point of the cut is within one of its
    edges.
    """
    point, along = cut
    before, after = part - point, next_corners(part) - point
    length = np.linalg.norm(after - before, axis=1)
    aside = np.linalg.norm(np.cross(before, after), axis=1) / length
    is_within = (before @ along) * (after @ along) < 0
    if not (is_within & (aside <= GAP * length)).any():
        return [part]
    return [_clip_half(part, point, side * along) for side in (1.0, -1.0)]


def _clip_half(part: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The part of a convex polygon [k, 3] (m) behind the plane through a point."""
    height = (part - point) @ normal
    least = 1e-12 * np.abs(height).max()
    kept = []
    for here, there, a, b in zip(
        part, next_corners(part), height, np.roll(height, -1), strict=True
    ):
        kept += [here] if a <= least else []
        kept += (
            [here + a / (a - b) * (there - here)]
            if min(a, b) < -least and max(a, b) > least
            else []
        )
    return np.array(kept)
