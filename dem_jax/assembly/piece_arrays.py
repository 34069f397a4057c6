"""Shapes and arrays of the pieces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax import shapes
from dem_jax.assembly import portion_counts
from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.finiteness_check import check_pieces
from dem_jax.assembly.stl_unit_check import check_stl_unit
from dem_jax.errors import SceneError
from dem_jax.scene import (
    SHAPE_KEYS,
    BodyMass,
    ConvexShape,
    Part,
    PieceShape,
    Portion,
    Product,
    Scene,
    placement,
)
from dem_jax.scene.array_namespace import as_float_array
from dem_jax.scene.material_properties import MaterialTable, build_material_table, find_piece_rows
from dem_jax.scene.sections.contact import HERTZIAN_LAWS
from dem_jax.types import Pieces, as_array

REQUIRED_SIZES = {
    "sphere": ("radius",),
    "cuboid": ("size",),
    "prism": ("sides", "radius", "height"),
    "cylinder": ("radius", "height"),
    "tube": ("outer_radius", "inner_radius", "height"),
    "compound": ("part",),
    "decomposed": ("stl",),
}
SIZES = frozenset().union(*SHAPE_KEYS.values()) - {"unit"}  # keys that belong to some shapes only;
# unit is never unset


def make_shape(row: PieceShape, folder: str | Path = ".") -> shapes.Shape:
    """The shape that a scene names, scaled; STL paths are relative to the folder. Raises
    SceneError.
    """
    given = _collect_sizes(row)
    if row.shape == "compound":
        return shapes.scale_shape(_compound_from_row(row, folder), row.scale_factor)
    if row.shape == "decomposed":
        return shapes.scale_shape(
            shapes.make_decomposed_shape(
                Path(folder) / given["stl"], row.unit, **_decomposition_options(row)
            )[0],
            row.scale_factor,
        )
    if row.shape == "tube":
        return shapes.scale_shape(shapes.tube(**given), row.scale_factor)
    if row.shape == "hull":
        found = _make_hull(row, folder)
        shape = (
            found.shape
            if found.mass is None
            else shapes.replace_mass(found.shape, found.centre, found.mass)
        )
        return shapes.scale_shape(shape, row.scale_factor)
    return _make_convex_shape(row, folder)[0]


def _collect_sizes(row: ConvexShape) -> dict[str, Any]:
    """The sizes of a shape that are set. Raises SceneError for a size of another shape and for a
    missing one.
    """
    given = {
        k: getattr(row, k)
        for k in sorted(SIZES & set(type(row).model_fields))
        if getattr(row, k) not in (None, ())
    }
    stray = sorted(set(given) - SHAPE_KEYS[row.shape])
    if stray:
        allowed = ", ".join(sorted(SHAPE_KEYS[row.shape]))
        raise SceneError(
            f"{stray[0]} = {given[stray[0]]}: not a key of shape {row.shape!r}; allowed: {allowed}"
        )
    if row.shape == "hull" and (row.points is None) == (row.stl is None):
        raise SceneError("shape 'hull': points, stl: exactly one of the two must be given")
    for key in ("hull_tolerance",) if row.stl is None else ("mass_properties",):
        if row.shape == "hull" and given.get(key) is not None:
            other = (
                "stl, whose own mass properties count" if row.stl else "points, whose hull is exact"
            )
            raise SceneError(f"{key}: no effect beside {other}")
    for key in REQUIRED_SIZES.get(row.shape, ()):
        if key not in given:
            raise SceneError(f"{key}: missing; shape {row.shape!r} needs it")
    return given


def _make_convex_shape(row: ConvexShape, folder: str | Path) -> tuple[shapes.Shape, np.ndarray]:
    """A convex shape, scaled, and its centre of mass [3] (m) in the frame of its points or STL,
    else zero. Raises SceneError.
    """
    given = _collect_sizes(row)
    if row.shape == "hull":
        found = _make_hull(row, folder)
        shape, centre = found.shape, found.centre
    else:
        shape, centre = getattr(shapes, row.shape.replace("-", "_"))(**given), np.zeros(3)
    return shapes.scale_shape(shape, row.scale_factor), row.scale_factor * centre


def _make_hull(row: ConvexShape, folder: str | Path) -> shapes.MeshHull:
    """The hull of a row before scaling, simplified to few corners, with notes on changes by reading
    and simplifying.
    """
    if row.stl is not None:
        found = shapes.read_hull(
            Path(folder) / row.stl, row.unit, row.hull_tolerance or shapes.HULL_TOLERANCE
        )
        check_stl_unit(row, row.stl, [found.shape.vertices])
    else:
        mass = _given_mass_properties(row.mass_properties) if isinstance(row, PieceShape) else None
        found = shapes.MeshHull(*shapes.hull_and_centre(np.array(row.points) * row.unit), mass, ())
    most = row.max_vertices or shapes.MOST_CORNERS
    if len(found.shape.vertices) <= most:
        return found
    fewer = shapes.simplify_hull(found.shape.vertices + found.centre, most)
    return shapes.MeshHull(
        *shapes.hull_and_centre(fewer.points), found.mass, (*found.notes, str(fewer))
    )


def _given_mass_properties(given: BodyMass | None) -> shapes.MassProperties | None:
    """The mass properties that a row specifies, if any."""
    return (
        None
        if given is None
        else shapes.require_mass_properties(given.volume, given.centre, given.gyration)
    )


def _compound_from_row(row: PieceShape, folder: str | Path) -> shapes.Shape:
    placed = []
    for n, part in enumerate(row.part):
        shape, centre = call_with_key(f"part.{n}", _make_convex_shape, part, folder)
        placed.append(
            shapes.PlacedShape(
                shape, centre if part.position is None else part.position, part.orientation
            )
        )
    return shapes.make_compound(
        placed,
        _given_mass_properties(row.mass_properties),
        row.coplanarity_tolerance or shapes.TOLERANCE,
    )


def _decomposition_options(row: PieceShape) -> dict[str, Any]:
    """Options of a row for the decomposition of its STL."""
    return {
        k: getattr(row, k)
        for k in ("concavity", "max_parts", "max_volume_loss", "max_vertices")
        if getattr(row, k) is not None
    }


@dataclass(frozen=True)
class PieceSet:
    """The N pieces of a scene before placement."""

    shapes: tuple[shapes.Shape, ...]  # of each piece, scaled; identical pieces share one object
    materials: tuple[str | None, ...]  # name of the material of each; None: the section [material]
    numbers: tuple[int, ...]  # pieces in the portion, on the feeder if there is one, and waiting if
    # there is an inlet; () for listed pieces
    densities: tuple[float | None, ...]  # of each (kg/m3), where its weight is given; None: that of
    # its material


def build_piece_set(scene: Scene, reuse: AssemblyCache | None = None) -> PieceSet:
    """The pieces of a scene: as listed, or those of a portion product by product, then those on the
    feeder. reuse: results of earlier scenes. Raises SceneError.
    """
    reuse = reuse or AssemblyCache()
    if scene.piece:
        listed = _make_row_shapes(scene.piece, "piece.{}", scene.folder, reuse)
        own = tuple(map(_density_from_weight, scene.piece, listed))
        return PieceSet(tuple(listed), tuple(row.material for row in scene.piece), (), own)
    assert scene.portion is not None  # as a Scene makes sure
    rows, made = scene.portion.product_rows, make_portion_shapes(scene, reuse)
    resized = reuse.get("resized", lambda: cache(shapes.scale_shape))
    found: list[shapes.Shape] = []
    names: list[str | None] = []
    densities: list[float | None] = []
    numbers: list[int] = []
    for counts in count_portion_pieces(scene, scene.portion, made):
        for shape, row, number in zip(made, rows, counts, strict=True):
            each = portion_counts.distribute_sizes(number, *_size_or_weight_spread(row))
            found += [shape if size == 1.0 else resized(shape, float(size)) for size in each]
            names += [row.material] * number
            densities += [_density_from_weight(row, shape)] * number
        numbers.append(sum(counts))
    return PieceSet(tuple(found), tuple(names), tuple(numbers), tuple(densities))


def reuse_piece_set(scene: Scene, table: MaterialTable, reuse: AssemblyCache) -> PieceSet:
    """As ``build_piece_set``, but the pieces of the previous scene if their inputs are unchanged.
    Raises SceneError.
    """
    made_from = (
        scene.piece,
        scene.portion,
        scene.feeder,
        scene.inlet,
        scene.folder,
        material_inputs(scene, table),
    )
    return reuse.get("goods", lambda: build_piece_set(scene, reuse), made_from)


def material_inputs(scene: Scene, table: MaterialTable) -> tuple[Any, ...]:
    """Inputs of a piece set and its arrays besides their sections: densities, names, wall flags and
    the definition of the size L.
    """
    return (
        tuple(table.density.tolist()),
        table.names,
        table.is_wall.tolist(),
        scene.material.stiffness_length,
    )


def make_portion_shapes(scene: Scene, reuse: AssemblyCache | None = None) -> list[shapes.Shape]:
    """The shape of each product of the portion, at its nominal size. Raises SceneError."""
    assert scene.portion is not None
    key = "portion.product.{}" if scene.portion.product else "portion"
    return _make_row_shapes(scene.portion.product_rows, key, scene.folder, reuse or AssemblyCache())


def _density_from_weight(row: PieceShape, shape: shapes.Shape) -> float | None:
    """Density (kg/m3) of pieces whose weight is given, else None; shape: of one of them at its
    nominal size.
    """
    return None if row.piece_weight is None else row.piece_weight / shape.volume


def _size_or_weight_spread(row: Product | Portion) -> tuple[float, bool]:
    """Relative standard deviation of the pieces of a row, and whether it refers to the weight."""
    by_weight = row.piece_weight_spread > 0
    return (row.piece_weight_spread if by_weight else row.size_spread), by_weight


def compute_densities(
    table: MaterialTable, materials: Sequence[str | None], own: Sequence[float | None]
) -> np.ndarray:
    """Densities [N] (kg/m3) of pieces: their own, or that of their material by name."""
    found = table.density[find_piece_rows(table, materials)]
    if all(one is None for one in own):
        return found
    return as_float_array(
        [density if one is None else one for one, density in zip(own, found, strict=True)]
    )


def compute_masses(goods: PieceSet, table: MaterialTable) -> np.ndarray:
    """Masses [N] (kg) of the pieces."""
    distinct, index = find_distinct_shapes(goods.shapes)
    volume = np.array([shape.volume for shape in distinct])[index]
    return compute_densities(table, goods.materials, goods.densities) * volume


def make_piece_shapes(scene: Scene) -> list[shapes.Shape]:
    """The shape of each piece; identical pieces share one object. Raises SceneError."""
    return list(build_piece_set(scene).shapes)


def _make_row_shapes(
    rows: Sequence[PieceShape], key: str, folder: str, reuse: AssemblyCache
) -> list[shapes.Shape]:
    made = reuse.get("shapes", dict[str, shapes.Shape], (folder,))
    out = []
    for n, row in enumerate(rows):
        text = row.model_dump_json(include=set(PieceShape.model_fields))
        if text not in made:
            made[text] = call_with_key(key.format(n), make_shape, row, folder)
        out.append(made[text])
    return out


def count_portion_pieces(
    scene: Scene, of: Portion, made: Sequence[shapes.Shape]
) -> list[tuple[int, ...]]:
    """Numbers of pieces of each product (shapes ``made``): in the portion, on the feeder if there
    is one, and waiting for the inlet if there is one (by default as many as in the portion).
    """
    table = build_material_table(scene)
    own = [
        _density_from_weight(row, shape) for row, shape in zip(of.product_rows, made, strict=True)
    ]
    mass = compute_densities(table, [row.material for row in of.product_rows], own) * np.array(
        [shape.volume for shape in made]
    )
    spread, of_weight = zip(*map(_size_or_weight_spread, of.product_rows), strict=True)
    mix = portion_counts.ProductMix(
        mass,
        np.array([row.share for row in of.product] or [1.0]),
        np.array(spread),
        of.share_by,
        of_weight,
    )
    if not of.count:
        with np.errstate(divide="ignore"):
            each = mix.share / mix.share.sum()
            check_pieces(
                scene,
                of.target_weight
                * float(np.sum(each / mass) if of.share_by == "weight" else 1 / (each @ mass)),
            )
    if of.count:
        held = portion_counts.apportion_count(mix, of.count)
    elif of.product or any(spread):
        held = portion_counts.apportion_weight(mix, of.target_weight)
    else:
        held = (placement.count_pieces(of.target_weight, float(mass[0])),)
    more = [scene.feeder.count] if scene.feeder else []
    more += [scene.inlet.reservoir] if scene.inlet else []
    return [
        held,
        *(
            held if count is None else portion_counts.apportion_by_remainder(np.array(held), count)
            for count in more
        ),
    ]


def call_with_key(key: str, function: Callable, *arguments: Any) -> Any:
    """Return the function's value; a SceneError is prefixed with the key of the section."""
    try:
        return function(*arguments)
    except SceneError as error:
        raise SceneError(f"{key}.{error}") from error


def find_distinct_shapes(made: Sequence[shapes.Shape]) -> tuple[list[shapes.Shape], list[int]]:
    """The distinct shapes, and for each piece the index of its shape in that list."""
    distinct = list({id(m): m for m in made}.values())
    place = {id(m): k for k, m in enumerate(distinct)}
    return distinct, [place[id(m)] for m in made]


def inline_shape_points(row: PieceShape, folder: str | Path) -> PieceShape:
    """The row with its STL replaced by the corners read from it, whole or decomposed into parts;
    other rows unchanged. Raises SceneError.
    """
    given = _collect_sizes(row)
    if row.shape == "decomposed":
        cut = shapes.decompose_mesh(
            Path(folder) / given["stl"], row.unit, **_decomposition_options(row)
        )
        check_stl_unit(row, given["stl"], cut.points)
        return _decomposed_row(row, cut)
    if row.shape == "compound":
        parts = [
            call_with_key(f"part.{n}", _inline_part_points, part, folder)
            for n, part in enumerate(row.part)
        ]
        notes = [f"part.{n}: {what}" for n, (_, what) in enumerate(parts) if what]
        return row.model_copy(
            update={"part": tuple(part for part, _ in parts)} | _append_note(row, notes)
        )
    if row.shape != "hull":
        return row
    found = _make_hull(row, folder)
    if row.stl is None and not found.notes:
        return row
    points: dict[str, Any] = {
        "stl": None,
        "unit": 1.0,
        "max_vertices": None,
        "hull_tolerance": None,
    }
    points |= {
        "points": to_point_tuples(found.shape.vertices.tolist()),
        "mass_properties": _mass_section(found.mass, found.centre),
    }
    said = "; ".join(found.notes)
    return row.model_copy(
        update=points
        | _append_note(row, [f"{row.stl}: {said}" if row.stl else said] if said else [])
    )


def _mass_section(mass: shapes.MassProperties | None, origin: np.ndarray) -> BodyMass | None:
    """The section of a scene that specifies mass properties, in axes with their origin at [3]
    (m).
    """
    if mass is None:
        return None
    g = mass.gyration.tolist()
    gyration = (g[0][0], g[1][1], g[2][2], g[0][1], g[0][2], g[1][2])
    return BodyMass(
        volume=mass.volume, centre=tuple((mass.centre - origin).tolist()), gyration=gyration
    )


def _append_note(row: PieceShape, said: Sequence[str]) -> dict[str, str]:
    """The note of a row, extended by remarks on its shape."""
    return {"note": "; ".join([*([row.note] if row.note else []), *said])} if said else {}


def _inline_part_points(part: Part, folder: str | Path) -> tuple[Part, str | None]:
    if part.shape != "hull":
        return part, None
    found = _make_hull(part, folder)
    if part.stl is None and not found.notes:
        return part, None
    points = to_point_tuples(((found.shape.vertices + found.centre) * part.scale_factor).tolist())
    whole = {
        "stl": None,
        "unit": 1.0,
        "scale_factor": 1.0,
        "max_vertices": None,
        "hull_tolerance": None,
        "points": points,
    }
    return part.model_copy(update=whole), "; ".join(found.notes) or None


def _decomposed_row(row: PieceShape, found: shapes.Decomposition) -> PieceShape:
    """The row of a decomposed STL as a compound of hulls with the mass of the STL; a single part
    becomes a hull.
    """
    whole: dict[str, Any] = dict.fromkeys(
        ("stl", "concavity", "max_parts", "max_volume_loss", "max_vertices")
    ) | {"unit": 1.0}
    whole |= _append_note(row, [f"{row.stl}: {'; '.join((*found.notes, str(found)))}"])
    points = [to_point_tuples(part.tolist()) for part in found.points]
    mass = _mass_section(found.mass, np.zeros(3))
    if len(points) == 1:
        differs = shapes.has_other_mass(*shapes.hull_and_centre(found.points[0]), found.mass)
        own = {"shape": "hull", "points": points[0], "mass_properties": mass if differs else None}
        return inline_shape_points(row.model_copy(update=whole | own), ".")
    whole_parts = max(16, *map(len, points))  # simplified parts would not be flush at the cuts
    parts = tuple(Part(shape="hull", points=each, max_vertices=whole_parts) for each in points)
    return row.model_copy(
        update=whole
        | {
            "shape": "compound",
            "part": parts,
            "mass_properties": mass,
            "coplanarity_tolerance": shapes.JOINT_TOLERANCE,
        }
    )


def build_piece_arrays(scene: Scene, goods: PieceSet, table: MaterialTable | None = None) -> Pieces:
    """Arrays of the pieces, in numpy or of traced values. table: materials of the scene, if already
    known. Raises SceneError.
    """
    table = table or build_material_table(scene)
    row = find_piece_rows(table, goods.materials)
    distinct, index = find_distinct_shapes(goods.shapes)
    each = lambda value: np.array([value(shape) for shape in distinct])[index]
    mass = compute_masses(goods, table)
    return Pieces(
        mass=as_array(mass),
        inertia=as_array(mass[None] * each(lambda s: s.gyration).T),
        size=as_array(each(lambda s: shapes.size_length(s, scene.material.stiffness_length))),
        curvature=as_array(2 / each(shapes.SIZE_LENGTHS["equivalent-diameter"])),
        material=as_array(row),
        bounding_radius=as_array(each(lambda s: s.bounding_radius)),
        width=as_array(each(_smallest_width)),
    )


def find_piece_size(scene: Scene, law: str) -> float:
    """The size L (m) of the first piece, which enters the stiffness of a contact law. Raises
    SceneError.
    """
    # as in ``Pieces``
    convention = "equivalent-diameter" if law in HERTZIAN_LAWS else scene.material.stiffness_length
    return shapes.size_length(build_piece_set(scene).shapes[0], convention)


def _smallest_width(shape: shapes.Shape) -> float:
    """Smallest width (m): the least extent along a face normal; for several parts that of the
    narrowest.
    """
    if shape.radius > 0:
        return 2 * shape.radius
    if shape.parts:
        return min(_smallest_width(part.shape) for part in shape.parts)
    heights = shape.vertices @ shape.normals.T
    return float((heights.max(0) - heights.min(0)).min())


def find_alike_kinds(goods: PieceSet) -> tuple[str, ...]:
    """``System.alike`` of the pieces."""
    if any(shape.parts for shape in goods.shapes):
        return ()
    both = list(zip(goods.shapes, goods.materials, strict=True))
    of_kind: dict[str, set[object]] = {
        "hulls": {id(shape) for shape, _ in both if shape.radius == 0},
        "spheres": {(id(shape), name) for shape, name in both if shape.radius > 0},
    }
    return tuple(kind for kind, different in of_kind.items() if len(different) == 1)


def to_point_tuples(points: Sequence[Sequence[float]]) -> tuple[tuple[float, float, float], ...]:
    """Points as tuples."""
    return tuple((x, y, z) for x, y, z in points)
