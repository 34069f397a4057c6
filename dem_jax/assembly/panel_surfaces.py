"""Surfaces that are made of several wall panels, and the data of adjacent panels that each panel
needs.

Panels of one wall group that share an edge and meet there at no more than the smooth angle are
facets of one smooth surface: contacts with several of them are merged into one
(``contacts.contact_reduction`` for planes, ``contacts.smooth_surfaces`` where they meet at an
angle). A sharper edge is a true edge, and so is the rim. Host side, float64, SI.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.math.loops import cross_product, loop_normal, next_corners
from dem_jax.shapes import wall_meshes

FLAT_BEND = 2e-6  # (rad) panels that meet at a smaller angle are one plane within rounding
OPEN_BEND = 0.01  # (rad) angle from which on a convex seam is as much an edge of the surface as the
# rim
REACH = 3.0  # bounding radii of the largest piece, within which a panel stores the neighbours
# beyond its convex seams
FINEST = 0.004  # (rad) smallest angle between the normals of such neighbours; intermediate ones are
# omitted
MOST_PLANES = 48  # largest number of such neighbours of a panel; with more, a coarser selection is
# stored
NEAREST = 16  # number of nearest ones that stay in place if others are omitted
SAME_CORNER = 1e-3  # of a seam: corners of two panels at one end of it are no further apart
ROUNDS = 20  # iterations in which the others are moved inwards
STEEPEST = 0.2  # cosine of the angle to the panel, up to which planes are moved
BEHIND = 1e-3  # of the reach: depth behind a panel of a point inside its solid
BELOW = 1e-6  # of the reach: tolerance for corners above a plane

Group = tuple[str, np.ndarray]  # name of the wall group, corners of a panel [k, 3] (m)


class PanelSeams(NamedTuple):
    """Seams at which other panels continue a panel, in its own frame, about its own centre."""

    across: np.ndarray  # [m, 3] outward unit directions, in its plane, across each seam
    outline: np.ndarray  # [m, 2, 3] unit directions in which the outline of the panel beyond goes
    # on from where each seam begins and ends, 0 where none does; [0, 2, 3] of bent surfaces
    openness: np.ndarray  # [m] degree to which the seam is an edge of the surface: 0 for flat and
    # concave seams, 1 for convex ones
    planes: np.ndarray  # [k, 4] outward normals and offsets (m) of the neighbours beyond convex
    # seams
    is_bent: bool  # whether it meets any of its neighbours at an angle

    def to_panel_frame(self, turn: np.ndarray, origin: np.ndarray) -> "PanelSeams":
        """These seams in the frame of the panel.

        Args:
            turn: [3, 3], panel frame to scene.
            origin: [3] (m), origin of the panel frame in the scene.
        """
        normals, offsets = self.planes[:, :3], self.planes[:, 3]
        planes = np.c_[normals @ turn, offsets - normals @ origin]
        return self._replace(across=self.across @ turn, outline=self.outline @ turn, planes=planes)


NO_SEAMS = PanelSeams(np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0), np.zeros((0, 4)), False)


class PanelSurfaces(NamedTuple):
    """The surfaces that panels form."""

    seams: list[PanelSeams]  # of each panel, in the frame of the scene
    number: np.ndarray  # [W] int: surface number of each panel, -1 for a panel without seams
    is_bent: bool  # whether panels of any surface meet at an angle


def find_surfaces(
    panels: Sequence[Group], smooth_angle: float, piece_radius: float
) -> PanelSurfaces | None:
    """The surfaces of panels; None if no panel continues another.

    Args:
        panels: all of the scene.
        smooth_angle: (rad) largest angle between two panels of one surface.
        piece_radius: (m) bounding radius of the largest piece.
    """
    members = [
        np.array([i for i, (name, _) in enumerate(panels) if name == group])
        for group in dict.fromkeys(group for group, _ in panels)
    ]
    beyond: list[list[list[int]]] = [[] for _ in panels]
    for group in members:
        found = wall_meshes.find_neighbours(
            [panels[i][1] for i in group], max(smooth_angle, wall_meshes.COPLANAR_ANGLE)
        )
        for i, edges in zip(group, found, strict=True):
            beyond[i] = [[int(group[j]) for j in edge] for edge in edges]
    normals = np.array([loop_normal(corners) for _, corners in panels])
    if not any(map(any, beyond)):
        return None
    sines = [
        np.linalg.norm(cross_product(normals[i], normals[j]))
        for i, edges in enumerate(beyond)
        for e in edges
        for j in e
    ]
    if max(sines) <= FLAT_BEND:
        return _group_coplanar_panels(panels, normals, members, beyond)
    return _group_smooth_panels(panels, normals, beyond, piece_radius)


def count_surfaces(found: PanelSurfaces | None, panels: int) -> int:
    """Number of surfaces that a number of panels form."""
    if found is None:
        return panels
    alone = int((found.number < 0).sum())
    return alone + len(np.unique(found.number[found.number >= 0]))


# --- planes ---


def _group_coplanar_panels(
    panels: Sequence[Group],
    normals: np.ndarray,
    members: Sequence[np.ndarray],
    beyond: list[list[list[int]]],
) -> PanelSurfaces:
    """Surfaces of panels that continue each other only in a plane."""
    seams, number = [NO_SEAMS for _ in panels], np.full(len(panels), -1)
    known: list[int] = []  # the first panel of each plane
    for i in (int(i) for group in members for i in group if any(beyond[i])):
        flag = [bool(edge) for edge in beyond[i]]
        across = _outward_directions(panels[i][1], normals[i])[flag]
        outline = [
            _outline_beyond(start, end, [np.asarray(panels[j][1], float) for j in edge])
            for start, end, edge in zip(
                np.asarray(panels[i][1], float), next_corners(panels[i][1]), beyond[i], strict=True
            )
            if edge
        ]
        seams[i] = NO_SEAMS._replace(
            across=across, outline=np.array(outline), openness=np.zeros(len(across))
        )
        found = [k for k, first in enumerate(known) if _are_coplanar(panels, normals, first, i)]
        number[i] = found[0] if found else len(known)
        known += [] if found else [i]
    return PanelSurfaces(seams, number, False)


def _are_coplanar(panels: Sequence[Group], normals: np.ndarray, first: int, second: int) -> bool:
    """Whether two panels belong to one group and lie in one plane, to within COPLANAR times the
    size of the second one.
    """
    (group, points), (name, corners) = panels[first], panels[second]
    if group != name or normals[first] @ normals[second] <= np.cos(wall_meshes.COPLANAR_ANGLE):
        return False
    size = float(np.linalg.norm(np.ptp(corners, axis=0)))
    return bool(abs((corners[0] - points[0]) @ normals[first]) < wall_meshes.COPLANAR_ANGLE * size)


def _outward_directions(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Outward unit directions [k, 3] across the edges of a panel [k, 3] (m)."""
    out = cross_product(next_corners(corners) - corners, normal)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _outline_beyond(start: np.ndarray, end: np.ndarray, others: Sequence[np.ndarray]) -> np.ndarray:
    """Unit directions [2, 3] in which the outlines of the panels [., 3] (m) beyond a seam go on from
    its start and from its end, 0 where none has a corner.
    """
    near = SAME_CORNER * float(np.linalg.norm(end - start))
    ways = np.zeros((2, 3))
    for way, corner, step in zip(ways, (start, end), (1, -1), strict=True):
        for points in others:
            distance = np.linalg.norm(points - corner, axis=1)
            k = int(np.argmin(distance))
            if distance[k] <= near:
                side = points[(k + step) % len(points)] - corner
                way[:] = side / np.linalg.norm(side)
    return ways


# --- smooth surfaces of facets ---


def _group_smooth_panels(
    panels: Sequence[Group], normals: np.ndarray, beyond: list[list[list[int]]], piece_radius: float
) -> PanelSurfaces:
    """Surfaces of panels of which some meet at an angle."""
    corners = [np.asarray(panel, float) for _, panel in panels]
    seams = []
    for i, edges in enumerate(beyond):
        flag = np.array([bool(edge) for edge in edges])
        bends = [_edge_bend(corners, normals, i, edge) for edge in edges if edge]
        openness = np.clip([max(bend, 0.0) / OPEN_BEND for bend in bends], 0, 1)
        planes = _find_planes_beyond(corners, normals, beyond, i, REACH * piece_radius)
        is_bent = any(abs(bend) > FLAT_BEND for bend in bends)
        seams.append(
            PanelSeams(
                _outward_directions(corners[i], normals[i])[flag],
                NO_SEAMS.outline,
                openness,
                planes,
                is_bent,
            )
        )
    return PanelSurfaces(seams, _label_surfaces(panels, normals, beyond), True)


def _edge_bend(
    corners: Sequence[np.ndarray], normals: np.ndarray, i: int, others: Sequence[int]
) -> float:
    """Largest angle (rad) by which the surface falls away from panel i at an edge; negative where
    it rises.
    """
    return max((_bend_angle(corners, normals, i, j) for j in others), key=abs)


def _bend_angle(corners: Sequence[np.ndarray], normals: np.ndarray, i: int, j: int) -> float:
    """Angle (rad) by which panel j falls away from panel i; negative where it rises."""
    height = (corners[j] - corners[i][0]) @ normals[i]
    sine = float(np.linalg.norm(cross_product(normals[i], normals[j])))
    return float(np.arcsin(min(sine, 1.0))) * (1.0 if -height.min() > height.max() else -1.0)


def _find_planes_beyond(
    corners: Sequence[np.ndarray],
    normals: np.ndarray,
    beyond: list[list[list[int]]],
    i: int,
    reach: float,
) -> np.ndarray:
    """Planes [k, 4] of the panels that are reached from panel i over convex seams within a reach
    (m); they bound its solid.
    """
    low, high = corners[i].min(axis=0) - reach, corners[i].max(axis=0) + reach
    found: list[tuple[int, float]] = []  # panel, offset
    seen, front = {i}, deque([i])
    while front:
        here = front.popleft()
        for j in dict.fromkeys(k for edge in beyond[here] for k in edge):
            if j in seen or _bend_angle(corners, normals, here, j) < -FLAT_BEND:
                continue
            seen.add(j)
            if (corners[j] < low).all(axis=0).any() or (corners[j] > high).all(axis=0).any():
                continue
            offset = float((corners[j] @ normals[j]).mean())
            if (corners[i] @ normals[j] > offset + BELOW * reach).any():
                continue
            front.append(j)
            found.append((j, offset))
    inside = corners[i].mean(axis=0) - BEHIND * reach * normals[i]
    return _thin_planes(normals, found, normals[i], inside, reach)


def _thin_planes(
    normals: np.ndarray,
    found: Sequence[tuple[int, float]],
    own: np.ndarray,
    inside: np.ndarray,
    reach: float,
) -> np.ndarray:
    """Planes [k, 4] of the panels found, nearest first, without nearly parallel pairs.

    Args:
        normals: [W, 3], of all panels.
        found: number and offset (m) of panels, nearest first.
        own: [3], normal of the panel whose solid they bound.
        inside: [3] (m), a point of that solid.
        reach: distance (m) from that point within which the solid must end where the surface does.
    """
    finest, exact = FINEST, 3
    while True:
        kept, left_out = list[tuple[int, float]](), list[tuple[int, float]]()
        directions = own[None]
        for j, offset in found:
            is_new = np.linalg.norm(directions - normals[j], axis=1) > (
                finest if len(kept) >= exact else FLAT_BEND
            )
            (kept if is_new.all() else left_out).append((j, offset))
            directions = (
                np.concatenate([directions, normals[j][None]]) if is_new.all() else directions
            )
        if len(kept) <= MOST_PLANES:
            planes = _stack_planes(normals, kept)
            if finest == FINEST:
                return planes
            is_fixed = (np.arange(len(planes)) < exact) | (planes[:, :3] @ own < STEEPEST)
            return _move_planes_inwards(
                planes, is_fixed, _stack_planes(normals, left_out), inside, reach
            )
        finest, exact = 1.5 * finest, NEAREST


def _stack_planes(normals: np.ndarray, panels: Sequence[tuple[int, float]]) -> np.ndarray:
    """Planes [k, 4] of panels, given by number and offset (m)."""
    return np.array([[*normals[j], offset] for j, offset in panels]).reshape(-1, 4)


def _move_planes_inwards(
    planes: np.ndarray, is_fixed: np.ndarray, left_out: np.ndarray, inside: np.ndarray, reach: float
) -> np.ndarray:
    """Planes [k, 4]; those that are not fixed are moved inwards until the solid ends where the
    omitted planes bound it.

    A solid that is too large would overlap with a piece that does not touch the surface; one that
    is too small far from its panel has a negligible effect on contacts there.
    """
    from scipy.spatial import HalfspaceIntersection, QhullError

    box = np.concatenate([np.eye(3), -np.eye(3)])
    rows = np.concatenate([planes, np.c_[box, box @ inside + reach]])
    for _ in range(ROUNDS):
        try:
            corners = HalfspaceIntersection(rows * [1, 1, 1, -1], inside).intersections
        except QhullError:  # a solid without interior
            break
        above = (corners @ left_out[:, :3].T - left_out[:, 3]).max(axis=1)
        meets = np.abs(corners @ planes[:, :3].T - rows[: len(planes), 3]) < BELOW * reach
        way = np.where(meets, np.maximum(above, 0)[:, None], 0).max(axis=0)
        way[is_fixed] = 0
        if way.max() < BELOW * reach:
            break
        room = rows[: len(planes), 3] - planes[:, :3] @ inside
        rows[: len(planes), 3] -= np.minimum(way, 0.5 * room)
    return rows[: len(planes)]


def _label_surfaces(
    panels: Sequence[Group], normals: np.ndarray, beyond: list[list[list[int]]]
) -> np.ndarray:
    """Surface number of each panel, [W]; -1 for a panel without seams."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = [(i, j) for i, edges in enumerate(beyond) for edge in edges for j in edge]
    rows, columns = np.array(joined).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(panels), len(panels)))
    _, labels = connected_components(graph, directed=False)
    has_seam = np.array([any(map(bool, edges)) for edges in beyond])
    return _compact_labels(
        np.where(has_seam, _merge_coplanar_labels(panels, normals, labels, has_seam), -1)
    )


def _merge_coplanar_labels(
    panels: Sequence[Group], normals: np.ndarray, labels: np.ndarray, has_seam: np.ndarray
) -> np.ndarray:
    """Merge the labels of surfaces of one group that have panels in one plane, so that a piece
    lying on both has one contact.
    """
    labels = labels.copy()
    known = np.flatnonzero(has_seam).tolist()
    for n, i in enumerate(known):
        for other in known[:n]:
            if labels[other] != labels[i] and _are_coplanar(panels, normals, other, i):
                labels[labels == labels[i]] = labels[other]
    return labels


def _compact_labels(labels: np.ndarray) -> np.ndarray:
    """Labels renumbered from 0 in the order of their first panels; -1 stays."""
    order = {label: k for k, label in enumerate(dict.fromkeys(labels[labels >= 0].tolist()))}
    return np.array([order.get(label, -1) for label in labels.tolist()])
