"""Panels of the walls, their motion groups, and the seams between them."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from dem_jax import shapes
from dem_jax.assembly.dtype_cast import cast_tree
from dem_jax.assembly.flap_drive_setup import build_flap_drives
from dem_jax.assembly.hull_table import pad_rows
from dem_jax.assembly.initial_conditions import Box
from dem_jax.assembly.load_cell_setup import build_load_cell_model
from dem_jax.assembly.panel_cuts import cut_at_ends_of_seams
from dem_jax.assembly.panel_surfaces import NO_SEAMS, PanelSeams, count_surfaces, find_surfaces
from dem_jax.assembly.stl_unit_check import check_stl_unit
from dem_jax.errors import SceneError
from dem_jax.math.loops import cross_product, loop_normal
from dem_jax.scene import Bucket, Feeder, Motion, Region, Scene, Wall, bucket_geometry
from dem_jax.scene.array_namespace import is_traced
from dem_jax.scene.bucket_geometry import Panel
from dem_jax.scene.cycle_timing import apply_cycle
from dem_jax.scene.fill_level import find_mouth_middle
from dem_jax.scene.material_properties import build_material_table, find_group_rows
from dem_jax.shapes import Shape, wall_meshes
from dem_jax.types import Plates, Walls, as_array
from dem_jax.walls import motion

AS_READ = {"unit": 1.0, "rotate_deg": (0.0, 0.0, 0.0), "move": (0.0, 0.0, 0.0)}  # settings of
# panels that are in metres and in place

# Thickness of the panels of a closed body over the smallest thickness behind its facets. Even a
# piece that penetrates a sheet by nine tenths does not touch the panels of the other side.
SHARE_OF_SHEET = 0.1


def lay_out_walls(
    scene: Scene,
) -> tuple[list[Panel], list[Motion], dict[str, str], list[Region], list[Box]]:
    """Panels (group, corners, thickness), sections of motions, reported names, blocks, and the
    boxes (low, high) in the feed bucket and on the feeder in which pieces start.
    """
    scene = inline_buckets(apply_cycle(scene))
    panels: list[Panel] = []
    joint: dict[str, str] = {}
    blocks, regions = list(scene.region), list[Box]()
    motions = [motion.load_table_rows(row, scene.folder) for row in scene.motion]
    for wall in scene.wall:
        panels += list_wall_panels(wall, scene.folder)
    found = []
    if scene.weigh_bucket:
        found.append(bucket_geometry.build_bucket_parts(scene.weigh_bucket, "wb", 0.0))
        blocks.append(found[-1].block)
    if scene.feed_bucket:
        found.append(
            bucket_geometry.build_bucket_parts(
                scene.feed_bucket, "fb", scene.drop.height if scene.weigh_bucket else 0.0
            )
        )
        regions.append((found[-1].interior_low, found[-1].interior_high))
    for bucket in found:
        panels += bucket.panels
        motions += bucket.motions
        joint |= bucket.joint
    if scene.feeder:
        feeder = bucket_geometry.build_feeder_parts(scene.feeder, found[-1])
        panels += feeder.panels
        motions.append(feeder.motion)
        blocks += [found[-1].block, feeder.block]
        regions.append((feeder.interior_low, feeder.interior_high))
    if not any(is_traced(corners) for _, corners, _ in panels):
        panels = cut_at_ends_of_seams(panels, smooth_angle(scene))
    known = {group for group, _, _ in panels}
    for row in motions:
        if row.group not in known:
            raise SceneError(
                f"motion.group = {row.group!r}: no wall has this group; allowed: {', '.join(sorted(known))}"
            )
    return panels, motions, joint, blocks, regions


def list_wall_panels(wall: Wall, folder: str | Path) -> list[Panel]:
    """The panels of a wall section; STL paths are relative to the folder. Raises SceneError."""
    if (wall.corners is None) == (wall.stl is None):
        raise SceneError(f"wall {wall.group!r}: corners, stl: exactly one of the two must be given")
    if wall.stl is None:
        return [(wall.group, np.array(wall.corners, float), wall.thickness)]
    mesh = _read_panels(wall, wall.stl, folder)
    thickness, _ = _limit_thickness(wall, [mesh])
    return [(wall.group, polygon, thickness) for polygon in mesh.panels]


def _read_panels(row: Wall | Bucket | Feeder, stl: str, folder: str | Path) -> wall_meshes.WallMesh:
    """The panels of an STL, placed in the scene. Raises SceneError."""
    found = wall_meshes.read_wall_mesh(Path(folder) / stl, row.unit)
    check_stl_unit(row, stl, found.panels)
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", row.rotate_deg, degrees=True).as_matrix()
    still = not any(row.rotate_deg) and not any(row.move)
    return (
        found
        if still
        else found._replace(panels=[panel @ turn.T + np.array(row.move) for panel in found.panels])
    )


def _limit_thickness(
    row: Wall | Bucket | Feeder, read: Sequence[wall_meshes.WallMesh]
) -> tuple[float, list[str]]:
    """Thickness (m) of the panels of a row, limited to ``SHARE_OF_SHEET`` of the space behind the
    facets of closed bodies; and notes on a reduction.
    """
    most = SHARE_OF_SHEET * min(mesh.thinnest for mesh in read)
    if row.thickness <= most:
        return row.thickness, []
    return most, [
        f"thickness of the panels {1e3 * most:.3g} mm, not {1e3 * row.thickness:.3g} mm, as there is a body behind them"
    ]


def inline_buckets(scene: Scene) -> Scene:
    """The scene with the STL files of its buckets and its feeder replaced by their panels, and with
    notes on them. Raises SceneError.
    """
    readers: dict[str, Callable[..., Any]] = {
        "weigh_bucket": _inline_bucket,
        "feed_bucket": _inline_bucket,
        "feeder": _inline_feeder,
    }
    parts = {name: getattr(scene, name) for name in readers}
    changes = {
        name: readers[name](row, scene.folder)
        for name, row in parts.items()
        if row is not None and row.stl
    }
    return scene.model_copy(update=changes)


def _inline_bucket(bucket: Bucket, folder: str | Path) -> Bucket:
    """The bucket with its lowest point, when closed, at z = 0 and, with ``centre``, the middle of
    its mouth at x = y = 0, both before ``move``.
    """
    assert bucket.stl is not None
    files = (bucket.stl, *(bucket.flap_stl or ()))
    found = [_read_panels(bucket, stl, folder) for stl in files]
    lowest = np.concatenate([panel for mesh in (found[1:] or found) for panel in mesh.panels])[
        :, 2
    ].min()
    every = [panel for mesh in found for panel in mesh.panels]
    aside = find_mouth_middle(every) - bucket.move[:2] if bucket.centre else np.zeros(2)
    down = np.array([*aside, lowest - bucket.move[2]])
    placed = [mesh._replace(panels=[panel - down for panel in mesh.panels]) for mesh in found]
    rows = [_to_corner_tuples(mesh) for mesh in placed]
    thickness, thinner = _limit_thickness(bucket, found)
    said = [
        bucket.note,
        *(f"{stl}: {mesh}" for stl, mesh in zip(files, placed, strict=True)),
        *thinner,
    ]
    panels = {
        "panels": rows[0],
        "flap_panels": tuple(rows[1:]) or None,
        "stl": None,
        "flap_stl": None,
        "centre": False,
    }
    changes = {"thickness": thickness, "note": "; ".join(filter(None, said))} | panels
    return bucket.model_copy(update=changes | AS_READ)


def _inline_feeder(feeder: Feeder, folder: str | Path) -> Feeder:
    """The feeder with the end of its floor (largest x) at x = z = 0, before ``move``."""
    assert feeder.stl is not None
    mesh = _read_panels(feeder, feeder.stl, folder)
    floor = np.concatenate(bucket_geometry.select_floor_panels(mesh.panels) or mesh.panels)
    front = floor[:, 0].max()
    end = floor[floor[:, 0] > front - 1e-3 * np.ptp(floor, axis=0).max()]
    edge = np.array([front - feeder.move[0], 0.0, end[:, 2].min() - feeder.move[2]])
    placed = mesh._replace(panels=[panel - edge for panel in mesh.panels])
    thickness, thinner = _limit_thickness(feeder, [placed])
    said = "; ".join(filter(None, [feeder.note, f"{feeder.stl}: {placed}", *thinner]))
    changes = {
        "panels": _to_corner_tuples(placed),
        "note": said,
        "stl": None,
        "thickness": thickness,
    }
    return feeder.model_copy(update=changes | AS_READ)


def _to_corner_tuples(mesh: wall_meshes.WallMesh) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """The corners of each panel in the form of a scene."""
    return tuple(tuple(map(tuple, panel.tolist())) for panel in mesh.panels)


def inline_wall_panels(wall: Wall, folder: str | Path) -> list[Wall]:
    """One wall for each panel of the STL of a wall, the first with notes on the file; a wall
    without an STL unchanged. Raises SceneError.
    """
    if wall.stl is None or wall.corners is not None:
        return [wall]
    mesh = _read_panels(wall, wall.stl, folder)
    thickness, thinner = _limit_thickness(wall, [mesh])
    said = "; ".join(filter(None, [wall.note, f"{wall.stl}: {mesh}", *thinner]))
    notes = [said] + [None] * (len(mesh.panels) - 1)
    own = {"stl": None, "thickness": thickness}
    changes = [
        own | {"corners": corners, "note": note}
        for corners, note in zip(_to_corner_tuples(mesh), notes, strict=True)
    ]
    return [wall.model_copy(update=change | AS_READ) for change in changes]


def build_walls(
    scene: Scene,
    panels: Sequence[Panel],
    motions: list[Motion],
    joint: dict[str, str],
    dtype: DTypeLike,
    piece_radius: float = 0.0,
) -> tuple[Walls, list[Shape], list[PanelSeams] | None]:
    """The walls, the shapes of their panels and the seams of each; piece_radius: (m) see
    ``find_surfaces``, 0 if contacts are not needed. Raises SceneError.
    """
    walls, plates, seams = build_panel_arrays(scene, panels, joint, dtype, piece_radius)
    return (
        walls.replace(**cast_tree(build_motion_arrays(scene, motions, walls), dtype)),
        plates,
        seams,
    )


def build_motion_arrays(scene: Scene, motions: Sequence[Motion], walls: Walls) -> dict[str, Any]:
    """Fields of Walls for the motion of the groups (pivots, motions, load cell and drives), in
    numpy or of traced values.

    Args:
        scene: its numbers may be traced.
        motions: sections of all motions, see ``lay_out_walls``.
        walls: the panels and their groups.

    Raises:
        SceneError: motions that cannot be combined.
    """
    moved, pivot = motion.build_motions(motions, walls.groups)
    return {
        "pivot": as_array(pivot),
        "motions": moved,
        "load_cell": build_load_cell_model(scene, walls.groups, np.asarray(walls.group)),
        "drive": build_flap_drives(motions, walls.groups),
    }


def build_panel_arrays(
    scene: Scene,
    panels: Sequence[Panel],
    joint: dict[str, str],
    dtype: DTypeLike,
    piece_radius: float = 0.0,
) -> tuple[Walls, list[Shape], list[PanelSeams] | None]:
    """As ``build_walls``, for walls at rest. Raises SceneError."""
    groups = list(dict.fromkeys(group for group, _, _ in panels))
    made = [
        _build_panel(corners, thickness, f"corners of wall group {group!r}")
        for group, corners, thickness in panels
    ]
    reports: dict[str, list[int]] = {}
    for i, group in enumerate(groups):
        reports.setdefault(joint.get(group, group), []).append(i)
    number = np.array([groups.index(name) for name, _, _ in panels], int)
    material = find_group_rows(build_material_table(scene), scene, groups)
    extent = [np.abs(shape.vertices).max(0) for shape, _, _ in made]
    surfaces = find_surfaces(
        [(group, corners) for group, corners, _ in panels], smooth_angle(scene), piece_radius
    )
    is_bent = surfaces is not None and surfaces.is_bent
    seams = None
    if surfaces:
        seams = [
            of.to_panel_frame(turn, centre)
            for of, (_, centre, turn) in zip(surfaces.seams, made, strict=True)
        ]
    walls = Walls(
        centre=as_array(np.array([c for _, c, _ in made], float).reshape(-1, 3).T),
        rotation=as_array(
            np.array([r for _, _, r in made], float).reshape(-1, 3, 3).transpose(1, 2, 0)
        ),
        half_extent=as_array(np.array(extent, float).reshape(-1, 3).T),
        plates=_build_plates([shape for shape, _, _ in made], None if is_bent else seams),
        group=as_array(number),
        material=as_array(material[number]),
        plane=None if surfaces is None else as_array(surfaces.number),
        pivot=as_array(np.zeros((3, len(groups)))),
        motions=(),
        load_cell=None,
        drive=None,
        is_bent=is_bent,
        groups=tuple(groups),
        reports=tuple((name, tuple(members)) for name, members in reports.items()),
    )
    return cast_tree(walls, dtype), [shape for shape, _, _ in made], seams


def smooth_angle(scene: Scene) -> float:
    """The largest angle (rad) between two panels of one smooth surface."""
    return float(np.radians(scene.contact.smooth_angle_deg))


def describe_surfaces(scene: Scene) -> list[str]:
    """A line for each wall group whose panels form smooth surfaces with bends, with the number of
    surfaces.
    """
    panels = [(group, corners) for group, corners, _ in lay_out_walls(scene)[0]]
    lines = []
    for name in dict.fromkeys(group for group, _ in panels):
        members = [panel for panel in panels if panel[0] == name]
        found = find_surfaces(members, smooth_angle(scene), 0.0)
        if found and found.is_bent:
            made, angle = count_surfaces(found, len(members)), scene.contact.smooth_angle_deg
            lines.append(
                f"wall group {name!r}: {len(members)} facets make {made} surface{'s' if made > 1 else ''}; facets that meet at "
                f"no more than {angle:g} degrees (contact.smooth_angle_deg) are one surface"
            )
    return lines


def _build_plates(panels: Sequence[Shape], seams: Sequence[PanelSeams] | None) -> Plates:
    """The outlines of panels from ``_build_panel``."""
    outlines = [shape.vertices[list(shape.faces[0]), :2] for shape in panels]
    most = max(map(len, outlines), default=3)
    rows = []
    for corners, of in zip(outlines, seams or [NO_SEAMS] * len(panels), strict=True):
        edges = np.roll(corners, -1, axis=0) - corners
        lengths = np.linalg.norm(edges, axis=1, keepdims=True)
        along = edges / lengths
        columns = [corners, along, lengths, _find_seam_edges(along, of)]
        rows.append(pad_rows(np.concatenate(columns, axis=1), most))
    x, y, along_x, along_y, lengths, *seam_rows = (
        np.array(rows, float).reshape(-1, most, 10).transpose(2, 1, 0)
    )
    return Plates(
        corners=(as_array(x), as_array(y)),
        directions=(as_array(along_x), as_array(along_y)),
        lengths=as_array(lengths),
        half_thickness=as_array(np.array([shape.vertices[:, 2].max() for shape in panels], float)),
        seams=tuple(map(as_array, seam_rows)) if seams else None,
    )


def _find_seam_edges(along: np.ndarray, seams: PanelSeams) -> np.ndarray:
    """``Plates.seams`` of the edges of a panel, [k, 5]; along: [k, 2] unit, of each edge; seams: in
    the frame of the panel.
    """
    out = np.c_[along[:, 1], -along[:, 0]]
    found = np.zeros((len(along), 5))
    for across, outline in zip(seams.across, seams.outline, strict=True):
        found[np.argmax(out @ across[:2])] = [1.0, *outline[:, :2].ravel()]
    return found


def _build_panel(
    corners: np.ndarray, thickness: float, name: str
) -> tuple[Shape, np.ndarray, np.ndarray]:
    """A panel as a shape about its own centre with the surface normal along z, its centre and its
    rotation.
    """
    return _build_cached_panel(
        tuple(map(tuple, np.asarray(corners, float).tolist())), thickness, name
    )


@lru_cache(maxsize=4096)
def _build_cached_panel(
    rows: tuple[tuple[float, ...], ...], thickness: float, name: str
) -> tuple[Shape, np.ndarray, np.ndarray]:
    """``_build_panel``, cached for all runs of an ensemble; the arrays must not be modified."""
    corners = np.array(rows)
    plate = wall_meshes.build_plate(corners, thickness, name)  # raises errors about the corners as
    # given
    left = wall_meshes.drop_collinear_corners(corners)
    if len(left) < len(corners):
        plate = wall_meshes.build_plate(left, thickness, name)
    x, z = corners[1] - corners[0], loop_normal(corners)
    x = (x - (x @ z) * z) / np.linalg.norm(x - (x @ z) * z)
    turn = np.stack([x, cross_product(z, x), z], axis=1)  # panel frame -> scene
    local = plate.vertices @ turn
    shape = shapes.make_polytope(name, local, plate.faces)
    centre = turn @ (local.mean(0) - shape.vertices.mean(0))  # centre of mass, the origin that
    # make_polytope() chooses
    return dataclasses.replace(shape, principal=np.array([1.0, 0, 0, 0])), centre, turn
