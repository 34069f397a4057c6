"""Walls from STL files: coplanar facets as convex panels, and the plate of some thickness behind a
panel. Host side.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math.loops import cross_product, loop_area, loop_normal, loop_normals, next_corners
from dem_jax.shapes.checks import require_length
from dem_jax.shapes.closed_bodies import find_bodies, measure_thickness
from dem_jax.shapes.coplanar_merge import corner_bulge
from dem_jax.shapes.shape import TOLERANCE
from dem_jax.shapes.stl import load_stl

if TYPE_CHECKING:
    import trimesh

Loop = Sequence[int]  # indices of points
LOST_AREA = 0.01  # of the area of coplanar facets, that panels may lack
THINNEST_RATIO = 1e-9  # thickness over size of a panel, or the inverse: beyond it no precision can
# represent the plate
SLIVER_AREA = 1e-4  # area over squared extent, of facets that may be left out
COPLANAR_ANGLE = 1e-3  # (rad) bend up to which two panels are in one plane


class Plate(NamedTuple):
    """Convex plate behind a panel, in the panel's frame.

    vertices: [2k, 3] (m) the panel's corners, then the same behind it.
    faces: vertex loops, counter-clockwise seen from outside: the surface, the back, the k sides.
    normals: [k + 2, 3] outward unit normals; offsets: [k + 2] (m): n . x <= offset inside.
    edges: [3k, 2] vertex indices: edge i of the surface runs from corner i to the next; then the
    back's; then across.
    """

    vertices: np.ndarray
    faces: tuple[tuple[int, ...], ...]
    normals: np.ndarray
    offsets: np.ndarray
    edges: np.ndarray


def build_plate(polygon: Any, thickness: float, name: str = "panel") -> Plate:
    """Plate behind a convex planar polygon [k, 3] (m), whose normal by the right-hand rule points
    to the pieces.

    thickness: (m), to the other side. name: of the panel, for messages.
    Raises SceneError for fewer than 3 corners, corners that coincide or are off their common plane
    by more than TOLERANCE of the panel's size, a reflex corner, an outline that crosses itself and
    a thickness that is not > 0.
    """
    corners = _require_polygon(polygon, name)
    thickness = require_length(f"{name}.thickness", thickness)
    size = float(np.linalg.norm(np.ptp(corners, axis=0)))
    low, high = THINNEST_RATIO * size, size / THINNEST_RATIO
    if not low < thickness < high:
        raise SceneError(
            f"{name}.thickness = {thickness:g}: allowed for a panel of {size:.3g} m: {low:.2g} to {high:.2g} m"
        )
    k, normal = len(corners), loop_normal(corners)
    vertices = np.concatenate([corners, corners - thickness * normal])
    ring = [(i, (i + 1) % k) for i in range(k)]
    sides = tuple((i, k + i, k + j, j) for i, j in ring)
    faces = (tuple(range(k)), tuple(range(2 * k - 1, k - 1, -1)), *sides)
    normals = loop_normals(vertices, faces)
    edges = np.array(ring + [(k + i, k + j) for i, j in ring] + [(i, k + i) for i in range(k)])
    return Plate(vertices, faces, normals, (vertices @ normals.T).max(axis=0), edges)


def drop_collinear_corners(polygon: np.ndarray) -> np.ndarray:
    """The polygon [k, 3] without the corners that lie on the line between their neighbours."""
    size = float(np.linalg.norm(np.ptp(polygon, axis=0)))
    return polygon[
        _drop_collinear(polygon, list(range(len(polygon))), loop_normal(polygon), TOLERANCE * size)
    ]


class WallMesh(NamedTuple):
    """Panels of an STL for walls.

    panels: convex, each [k, 3] (m). facets: their number. duplicate_count: number of facets left
    out because they were given twice. thinnest: (m) least thickness behind a facet of a closed
    body; inf: there is none. bodies: the closed bodies, in words.
    """

    panels: list[np.ndarray]
    facets: int
    duplicate_count: int
    thinnest: float = np.inf
    bodies: str = ""

    def __str__(self) -> str:
        points = np.concatenate(self.panels)
        area = sum(loop_area(panel) for panel in self.panels)
        nm = 1e-9  # of which less is rounding
        sides = zip(
            "xyz",
            *(
                np.round(bound / nm) * nm + 0.0
                for bound in (points.min(axis=0), points.max(axis=0))
            ),
            strict=True,
        )
        bounds = ", ".join(f"{axis} from {low:.6g} to {high:.6g} m" for axis, low, high in sides)
        twice = (
            f" ({self.duplicate_count} more were doubled, and left out)"
            if self.duplicate_count
            else ""
        )
        bodies = (
            f", {self.bodies}, {1e3 * self.thinnest:.3g} mm at the thinnest" if self.bodies else ""
        )
        return f"{self.facets} facets{twice}, {len(self.panels)} panels, {area:.6g} m2, {bounds}{bodies}"


def read_wall_panels(path: str | Path, unit: float = 1.0, angle: float = 0.01) -> list[np.ndarray]:
    """The panels of ``read_wall_mesh``."""
    return read_wall_mesh(path, unit, angle).panels


def read_wall_mesh(path: str | Path, unit: float = 1.0, angle: float = 0.01) -> WallMesh:
    """Convex panels, each [k, 3] (m), of the facets of an STL, counter-clockwise about the facets'
    own normals.

    unit: metres per unit of the file. angle: (degrees) adjacent facets whose normals differ by no
    more from that of the largest among them are merged, and laid into their mean plane. Panels that
    are not convex, or have a hole, are cut into convex parts. The mesh need not be closed; closed
    bodies that meet are united. Raises SceneError for a file that is missing, unreadable, empty or
    without area, or with corners that are not finite or far off, and for facets that face both
    ways.
    """
    mesh = load_stl(path, unit)
    doubled = _drop_doubled(mesh)
    bodies = find_bodies(mesh, path)
    mesh = bodies.mesh
    _check_one_sided(mesh, path)
    tolerance = TOLERANCE * mesh.scale
    vertices = np.asarray(mesh.vertices, np.float64)
    panels: list[np.ndarray] = []
    for group in _group_coplanar(mesh, np.cos(np.radians(angle)), tolerance):
        normal = mesh.area_faces[group] @ mesh.face_normals[group]
        normal /= np.linalg.norm(normal)
        triangles = mesh.faces[group].tolist()
        used = np.unique(mesh.faces[group])
        height = (vertices - vertices[used].mean(axis=0)) @ normal
        flat = vertices - height[:, None] * normal
        loops = _split_convex(flat, [tuple(triangle) for triangle in triangles], normal, tolerance)
        made = [flat[loop] for loop in loops]
        _check_complete(mesh, group, made, path)
        panels += made
    return WallMesh(panels, len(mesh.faces), doubled, measure_thickness(bodies, path), str(bodies))


def _drop_doubled(mesh: "trimesh.Trimesh") -> int:
    """Drop duplicate facets; returns their number."""
    faces = np.asarray(mesh.faces)
    first = faces.argmin(axis=1)
    # the same corners first in all
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    _, kept = np.unique(turned, axis=0, return_index=True)
    kept.sort()
    doubled = len(faces) - len(kept)
    if doubled:
        mesh.update_faces(kept)
    return doubled


def _check_one_sided(mesh: "trimesh.Trimesh", path: str | Path) -> None:
    """Raise SceneError for facets of the same corners that face both ways."""
    corners, count = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_counts=True)
    if (count > 1).any():
        where = mesh.vertices[corners[int(np.argmax(count > 1))]].mean(axis=0)
        raise SceneError(
            f"stl = {str(path)!r}: {(count > 1).sum()} of its facets face both ways, such as that about "
            f"{np.round(where, 6).tolist()} m; allowed: one side, towards the pieces (thickness is behind it)"
        )


def _check_complete(
    mesh: "trimesh.Trimesh", group: np.ndarray, panels: list[np.ndarray], path: str | Path
) -> None:
    """Raise SceneError if panels lack more of their coplanar facets than slivers, which are thinner
    than rounding.
    """
    facets = float(mesh.area_faces[group].sum())
    lost = facets - sum(loop_area(panel) for panel in panels)
    extent = float(np.linalg.norm(np.ptp(mesh.triangles[group].reshape(-1, 3), axis=0)))
    if abs(lost) > LOST_AREA * facets and facets > SLIVER_AREA * extent**2:
        low, high = (np.asarray(bound).tolist() for bound in mesh.bounds)
        raise SceneError(
            f"stl = {str(path)!r}: facets of {facets:.4g} m2 about {np.round(mesh.triangles[group[0]].mean(axis=0), 6).tolist()} m "
            f"make panels of {facets - lost:.4g} m2, as the mesh goes from {low} to {high} m; allowed: no corner that is far off"
        )


def find_seams(panels: Sequence[np.ndarray], tolerance: float | None = None) -> list[list[bool]]:
    """For each panel [k, 3] a list of k booleans: whether the edge from corner i to the next
    borders a coplanar panel.

    Such an edge is no edge of the wall: a piece that slides across must not catch on it. Coplanar
    panels have the same normal (to 1e-3); edges that overlap only in part count. tolerance: (m) by
    default 1e-4 of the largest panel's size.
    """
    return [
        [bool(beyond) for beyond in row]
        for row in find_neighbours(panels, COPLANAR_ANGLE, tolerance)
    ]


def find_neighbours(
    panels: Sequence[np.ndarray], largest_bend: float, tolerance: float | None = None
) -> list[list[list[int]]]:
    """For each panel, for each of its edges, the numbers of the panels that continue it beyond that
    edge.

    Args:
        panels: of one wall group, each [k, 3] (m), counter-clockwise about its normal.
        largest_bend: (rad) largest angle between the normals of two panels that continue each
            other.
        tolerance: (m) distance within which two edges are one; by default 1e-4 of the largest
            panel's size.

    Returns:
        Lists [panels][k] of panel numbers. Edges that overlap only in part count.
    """
    panels = [np.asarray(panel, np.float64) for panel in panels]
    tolerance = tolerance or 1e-4 * max(float(np.linalg.norm(np.ptp(p, axis=0))) for p in panels)
    normals = np.stack([loop_normal(panel) for panel in panels])
    low, high = (np.stack([of(panel, axis=0) for panel in panels]) for of in (np.min, np.max))
    found = []
    for i, panel in enumerate(panels):
        is_near = ((low <= high[i] + tolerance) & (high >= low[i] - tolerance)).all(axis=1)
        is_near &= normals @ normals[i] > np.cos(largest_bend)
        others = [(j, _edge_ends(panels[j])) for j in np.flatnonzero(is_near).tolist() if j != i]
        sides = zip(*_edge_ends(panel), strict=True)
        found.append(
            [
                [j for j, other in others if _is_shared_edge(*side, *other, tolerance)]
                for side in sides
            ]
        )
    return found


def _edge_ends(panel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends [k, 3] of a panel's edges."""
    corners = np.asarray(panel, np.float64)
    return corners, next_corners(corners)


def _is_shared_edge(
    start: np.ndarray, end: np.ndarray, starts: np.ndarray, ends: np.ndarray, tolerance: float
) -> bool:
    """Whether one of some edges [k, 3] runs along the edge start-end, the other way, for more than
    tolerance (m).
    """
    length = np.linalg.norm(end - start)
    along = (end - start) / length
    distance = [
        np.linalg.norm(cross_product(points - start, along), axis=1) for points in (starts, ends)
    ]
    head, tail = (ends - start) @ along, (starts - start) @ along
    shared = np.minimum(tail, length) - np.maximum(head, 0.0)
    return bool(((np.maximum(*distance) <= tolerance) & (shared > tolerance)).any())


# --- facets to convex polygons ---


def _group_coplanar(mesh: "trimesh.Trimesh", cosine: float, tolerance: float) -> list[np.ndarray]:
    """Groups of facets (index arrays), each grown from its largest over shared edges to those in
    the same plane.

    A facet is in the plane if its normal is, or (slivers, whose normal is inaccurate) if all its
    corners are.
    """
    neighbours: list[list[int]] = [[] for _ in mesh.faces]
    for a, b in mesh.face_adjacency.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    free = np.ones(len(mesh.faces), bool)
    groups = []
    for seed in np.argsort(-mesh.area_faces, kind="stable"):
        if not free[seed]:
            continue
        along = mesh.face_normals @ mesh.face_normals[seed]
        off_plane = np.abs(
            (mesh.triangles - mesh.triangles[seed, 0]) @ mesh.face_normals[seed]
        ).max(axis=1)
        joins = free & ((along >= cosine) | ((along > 0.0) & (off_plane <= tolerance)))
        group, front = {int(seed)}, [int(seed)]
        while front:
            new = [f for f in neighbours[front.pop()] if joins[f] and f not in group]
            group.update(new)
            front += new
        members = np.array(sorted(group))
        free[members] = False
        groups.append(members)
    return groups


def _split_convex(
    points: np.ndarray, triangles: list[Loop], normal: np.ndarray, tolerance: float
) -> list[Loop]:
    """Convex loops (lists of indices of points) that together cover coplanar triangles, without
    collinear corners.
    """
    outline = _trace_outline(triangles)
    if outline is not None and _is_convex(points[outline], normal, tolerance):
        found: list[Loop] = [outline]
    else:
        found = _merge_convex_loops(points, triangles, normal, tolerance)
    loops = [_drop_collinear(points, list(loop), normal, tolerance) for loop in found]
    return [loop for loop in loops if len(loop) >= 3]


def _merge_convex_loops(
    points: np.ndarray, loops: list[Loop], normal: np.ndarray, tolerance: float
) -> list[Loop]:
    """Loops joined in pairs over shared edges, the longest edge first, as long as the pair is
    convex.
    """
    merged = dict(enumerate(loops))
    owner = {side: i for i, loop in merged.items() for side in _directed_edges(loop)}
    shared = [side for side in owner if side[0] < side[1] and side[::-1] in owner]
    shared.sort(key=lambda side: -np.linalg.norm(points[side[0]] - points[side[1]]))
    joined = True
    while joined:
        joined = False
        for side in shared:
            a, b = owner.get(side), owner.get(side[::-1])
            if a is None or b is None or a == b:
                continue
            pair = _trace_outline([merged[a], merged[b]])
            if pair is not None and _is_convex(points[pair], normal, tolerance):
                for gone in _directed_edges(merged[a]) + _directed_edges(merged.pop(b)):
                    del owner[gone]
                merged[a] = pair
                owner.update({new: a for new in _directed_edges(pair)})
                joined = True
    return list(merged.values())


def _directed_edges(loop: Loop) -> list[tuple[int, int]]:
    return [(int(loop[i - 1]), int(loop[i])) for i in range(len(loop))]


def _trace_outline(loops: Sequence[Loop]) -> list[int] | None:
    """The one loop (a list) around some loops that share edges; None if there are several, or if it
    touches itself.
    """
    sides = [side for loop in loops for side in _directed_edges(loop)]
    inside = set(sides)
    rim = [side for side in sides if side[::-1] not in inside]
    following = dict(rim)
    if not rim or len(following) != len(rim):
        return None
    start = rim[0][0]
    outline = [start]
    while (corner := following[outline[-1]]) != start:
        outline.append(corner)
    return outline if len(outline) == len(rim) else None


def _is_convex(corners: np.ndarray, normal: np.ndarray, tolerance: float) -> bool:
    return (
        bool((corner_bulge(corners, normal) >= -tolerance).all())
        and _winding_number(corners, normal) == 1
    )


def _winding_number(corners: np.ndarray, normal: np.ndarray) -> int:
    """Winding number of a loop [k, 3] about its normal: 1 for a simple outline."""
    before = next_corners(corners) - corners
    after = next_corners(before)
    turn = np.arctan2(cross_product(before, after) @ normal, (before * after).sum(axis=1))
    return round(float(turn.sum() / (2.0 * np.pi)))


def _drop_collinear(
    points: np.ndarray, loop: list[int], normal: np.ndarray, tolerance: float
) -> list[int]:
    """The loop without corners that stand out by no more than tolerance (m), the flattest dropped
    first.
    """
    while len(loop) >= 3:
        out = np.abs(corner_bulge(points[loop], normal))
        flattest = int(np.argmin(out))
        if out[flattest] > tolerance:
            break
        del loop[flattest]
    return loop


# --- validation of user input ---


def _require_polygon(polygon: Any, name: str) -> np.ndarray:
    try:
        corners = np.asarray(polygon, np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{name} must be a list of corners [x, y, z] (m)") from error
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3:
        raise SceneError(
            f"{name} of form {list(corners.shape)} must be a list of at least 3 corners [x, y, z] (m)"
        )
    if not np.isfinite(corners).all():
        raise SceneError(
            f"{name} corner {int(np.argmin(np.isfinite(corners).all(axis=1)))} must be finite (m)"
        )
    size = float(np.linalg.norm(np.ptp(corners, axis=0)))
    sides = np.linalg.norm(next_corners(corners) - corners, axis=1)
    if sides.min() <= TOLERANCE * size:
        i = int(np.argmin(sides))
        raise SceneError(
            f"{name} corners {i} and {(i + 1) % len(corners)} coincide at {corners[i].tolist()} m"
        )
    _check_polygon_form(corners, size, name)
    return corners


def _check_polygon_form(corners: np.ndarray, size: float, name: str) -> None:
    area = loop_area(corners)
    if area <= TOLERANCE * size**2:
        raise SceneError(
            f"{name} has no area ({area:.3g} m2): its corners must not lie on one line or cancel out"
        )
    normal = loop_normal(corners)
    off_plane = np.abs((corners - corners.mean(axis=0)) @ normal)
    if off_plane.max() > TOLERANCE * size:
        far, allowed = int(np.argmax(off_plane)), TOLERANCE * size
        raise SceneError(
            f"{name} corner {far} is {off_plane[far]:.3g} m off its plane; at most {allowed:.1g} m is allowed"
        )
    out = corner_bulge(corners, normal)
    if out.min() < -TOLERANCE * size:
        reflex = int(np.argmin(out))
        raise SceneError(
            f"{name} must be convex; its corner {reflex} at {corners[reflex].tolist()} m is reflex"
        )
    if _winding_number(corners, normal) != 1:
        raise SceneError(f"{name} must be convex; its outline crosses itself")
