"""Shapes and arrays of the pieces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax import shapes
from dem_jax.build import portion
from dem_jax.build.finite import check_pieces
from dem_jax.build.reuse import Reuse
from dem_jax.build.unit import check_unit
from dem_jax.errors import SceneError
from dem_jax.scene import SHAPE_KEYS, BodyMass, ConvexShape, Part, PieceShape, Portion, Product, Scene, arrange
from dem_jax.scene.materials import MaterialTable, material_table, rows_of_pieces
from dem_jax.scene.numbers import array
from dem_jax.scene.sections.contact import HERTZIAN
from dem_jax.types import Pieces, host

REQUIRED = {
    "sphere": ("radius",),
    "cuboid": ("size",),
    "prism": ("sides", "radius", "height"),
    "cylinder": ("radius", "height"),
    "tube": ("outer_radius", "inner_radius", "height"),
    "compound": ("part",),
    "decomposed": ("stl",),
}
SIZES = frozenset().union(*SHAPE_KEYS.values()) - {"unit"}  # keys that belong to some shapes only; unit is never unset


def make_shape(row: PieceShape, folder: str | Path = ".") -> shapes.Shape:
    """The shape that a scene names, scaled; STL files are looked for in a folder. Raises SceneError."""
    given = _given(row)
    if row.shape == "compound":
        return shapes.scaled(_compound(row, folder), row.scale_factor)
    if row.shape == "decomposed":
        return shapes.scaled(shapes.decomposed(Path(folder) / given["stl"], row.unit, **_cutting(row))[0], row.scale_factor)
    if row.shape == "tube":
        return shapes.scaled(shapes.tube(**given), row.scale_factor)
    if row.shape == "hull":
        found = _hull(row, folder)
        shape = found.shape if found.mass is None else shapes.with_mass(found.shape, found.centre, found.mass)
        return shapes.scaled(shape, row.scale_factor)
    return _placed_shape(row, folder)[0]


def _given(row: ConvexShape) -> dict[str, Any]:
    """The sizes of a shape that are set. Raises SceneError for those of other shapes, and for one that it needs."""
    given = {k: getattr(row, k) for k in sorted(SIZES & set(type(row).model_fields)) if getattr(row, k) not in (None, ())}
    stray = sorted(set(given) - SHAPE_KEYS[row.shape])
    if stray:
        allowed = ", ".join(sorted(SHAPE_KEYS[row.shape]))
        raise SceneError(f"{stray[0]} = {given[stray[0]]}: not a key of shape {row.shape!r}; allowed: {allowed}")
    if row.shape == "hull" and (row.points is None) == (row.stl is None):
        raise SceneError("shape 'hull': points, stl: exactly one of the two must be given")
    for key in ("hull_tolerance",) if row.stl is None else ("mass_properties",):
        if row.shape == "hull" and given.get(key) is not None:
            other = "stl, whose own mass properties count" if row.stl else "points, whose hull is exact"
            raise SceneError(f"{key}: no effect beside {other}")
    for key in REQUIRED.get(row.shape, ()):
        if key not in given:
            raise SceneError(f"{key}: missing; shape {row.shape!r} needs it")
    return given


def _placed_shape(row: ConvexShape, folder: str | Path) -> tuple[shapes.Shape, np.ndarray]:
    """A convex shape, scaled, and its centre of mass [3] (m) in the frame of its points or its STL, else zero. Raises
    SceneError."""
    given = _given(row)
    if row.shape == "hull":
        found = _hull(row, folder)
        shape, centre = found.shape, found.centre
    else:
        shape, centre = getattr(shapes, row.shape.replace("-", "_"))(**given), np.zeros(3)
    return shapes.scaled(shape, row.scale_factor), row.scale_factor * centre


def _hull(row: ConvexShape, folder: str | Path) -> shapes.MeshHull:
    """The hull of a row before scaling, of few corners, with what reading and simplifying changed."""
    if row.stl is not None:
        found = shapes.read_hull(Path(folder) / row.stl, row.unit, row.hull_tolerance or shapes.HULL_TOLERANCE)
        check_unit(row, row.stl, [found.shape.vertices])
    else:
        mass = _own_mass(row.mass_properties) if isinstance(row, PieceShape) else None
        found = shapes.MeshHull(*shapes.placed_hull(np.array(row.points) * row.unit), mass, ())
    most = row.max_corners or shapes.MOST_CORNERS
    if len(found.shape.vertices) <= most:
        return found
    fewer = shapes.simplified(found.shape.vertices + found.centre, most)
    return shapes.MeshHull(*shapes.placed_hull(fewer.points), found.mass, (*found.notes, str(fewer)))


def _own_mass(given: BodyMass | None) -> shapes.MassProperties | None:
    """Mass properties that a row gives."""
    return None if given is None else shapes.checked_mass(given.volume, given.centre, given.gyration)


def _compound(row: PieceShape, folder: str | Path) -> shapes.Shape:
    placed = []
    for n, part in enumerate(row.part):
        shape, centre = named(f"part.{n}", _placed_shape, part, folder)
        placed.append(shapes.Placed(shape, centre if part.position is None else part.position, part.orientation))
    return shapes.compound(placed, _own_mass(row.mass_properties), row.joint_tolerance or shapes.TOLERANCE)


def _cutting(row: PieceShape) -> dict[str, Any]:
    """How an STL is decomposed: what the row says of it."""
    return {k: getattr(row, k) for k in ("concavity", "max_parts", "loss", "max_corners") if getattr(row, k) is not None}


@dataclass(frozen=True)
class Goods:
    """The N pieces of a scene before they are anywhere."""

    shapes: tuple[shapes.Shape, ...]  # of each piece, scaled; one object where pieces are alike
    materials: tuple[str | None, ...]  # name of the material of each, None: [material] itself
    numbers: tuple[int, ...]  # pieces of the portion, with a feeder on it, with an inlet those that wait; () of pieces listed
    densities: tuple[float | None, ...]  # of each (kg/m3), where its weight is given; None: that of its material


def goods_of(scene: Scene, reuse: Reuse | None = None) -> Goods:
    """The pieces of a scene: as listed, or of a portion product by product, then those on the feeder. reuse: of scenes before.
    Raises SceneError."""
    reuse = reuse or Reuse()
    if scene.piece:
        listed = _shapes_of_rows(scene.piece, "piece.{}", scene.folder, reuse)
        own = tuple(map(_own_density, scene.piece, listed))
        return Goods(tuple(listed), tuple(row.material for row in scene.piece), (), own)
    assert scene.portion is not None  # as a Scene makes sure
    rows, made = scene.portion.rows, shapes_of_portion(scene, reuse)
    resized = reuse.get("resized", lambda: cache(shapes.scaled))
    found: list[shapes.Shape] = []
    names: list[str | None] = []
    densities: list[float | None] = []
    numbers: list[int] = []
    for counts in counts_of(scene, scene.portion, made):
        for shape, row, number in zip(made, rows, counts, strict=True):
            each = portion.sizes(number, *_spread_of(row))
            found += [shape if size == 1.0 else resized(shape, float(size)) for size in each]
            names += [row.material] * number
            densities += [_own_density(row, shape)] * number
        numbers.append(sum(counts))
    return Goods(tuple(found), tuple(names), tuple(numbers), tuple(densities))


def kept_goods(scene: Scene, table: MaterialTable, reuse: Reuse) -> Goods:
    """As ``goods_of``, those of the scene before where all that they are made from is the same. Raises SceneError."""
    made_from = (scene.piece, scene.portion, scene.feeder, scene.inlet, scene.folder, material_inputs(scene, table))
    return reuse.get("goods", lambda: goods_of(scene, reuse), made_from)


def material_inputs(scene: Scene, table: MaterialTable) -> tuple[Any, ...]:
    """What goods and their arrays are made from besides their sections: densities, names, whether of walls, and the size L."""
    return tuple(table.density.tolist()), table.names, table.is_wall.tolist(), scene.material.stiffness_size


def shapes_of_portion(scene: Scene, reuse: Reuse | None = None) -> list[shapes.Shape]:
    """The shape of each product of the portion, at its size as given. Raises SceneError."""
    assert scene.portion is not None
    key = "portion.product.{}" if scene.portion.product else "portion"
    return _shapes_of_rows(scene.portion.rows, key, scene.folder, reuse or Reuse())


def _own_density(row: PieceShape, shape: shapes.Shape) -> float | None:
    """(kg/m3) of pieces whose weight is given; shape: of one of them at its size as given."""
    return None if row.piece_weight is None else row.piece_weight / shape.volume


def _spread_of(row: Product | Portion) -> tuple[float, bool]:
    """How much the pieces of a row differ (relative standard deviation), and whether in weight."""
    by_weight = row.piece_weight_spread > 0
    return (row.piece_weight_spread if by_weight else row.size_spread), by_weight


def densities_of(table: MaterialTable, materials: Sequence[str | None], own: Sequence[float | None]) -> np.ndarray:
    """[N] (kg/m3) of pieces of materials by name, or their own."""
    found = table.density[rows_of_pieces(table, materials)]
    if all(one is None for one in own):
        return found
    return array([density if one is None else one for one, density in zip(own, found, strict=True)])


def masses_of(goods: Goods, table: MaterialTable) -> np.ndarray:
    """[N] (kg)."""
    distinct, index = distinct_shapes(goods.shapes)
    volume = np.array([shape.volume for shape in distinct])[index]
    return densities_of(table, goods.materials, goods.densities) * volume


def pieces_of(scene: Scene) -> list[shapes.Shape]:
    """The shape of each piece; one object where pieces are alike. Raises SceneError."""
    return list(goods_of(scene).shapes)


def _shapes_of_rows(rows: Sequence[PieceShape], key: str, folder: str, reuse: Reuse) -> list[shapes.Shape]:
    made = reuse.get("shapes", dict[str, shapes.Shape], (folder,))
    out = []
    for n, row in enumerate(rows):
        text = row.model_dump_json(include=set(PieceShape.model_fields))
        if text not in made:
            made[text] = named(key.format(n), make_shape, row, folder)
        out.append(made[text])
    return out


def counts_of(scene: Scene, of: Portion, made: Sequence[shapes.Shape]) -> list[tuple[int, ...]]:
    """Pieces of each product (shapes ``made``): of the portion, on the feeder if there is one, and of those that wait for an inlet
    if there is one (by default as many)."""
    table = material_table(scene)
    own = [_own_density(row, shape) for row, shape in zip(of.rows, made, strict=True)]
    mass = densities_of(table, [row.material for row in of.rows], own) * np.array([shape.volume for shape in made])
    spread, of_weight = zip(*map(_spread_of, of.rows), strict=True)
    mix = portion.Mix(mass, np.array([row.share for row in of.product] or [1.0]), np.array(spread), of.share_by, of_weight)
    if not of.count:
        with np.errstate(divide="ignore"):
            each = mix.share / mix.share.sum()
            check_pieces(scene, of.target_weight * float(np.sum(each / mass) if of.share_by == "weight" else 1 / (each @ mass)))
    if of.count:
        held = portion.numbers_of_count(mix, of.count)
    elif of.product or any(spread):
        held = portion.numbers_of_weight(mix, of.target_weight)
    else:
        held = (arrange.count(of.target_weight, float(mass[0])),)
    more = [scene.feeder.count] if scene.feeder else []
    more += [scene.inlet.waiting] if scene.inlet else []
    return [held, *(held if count is None else portion.apportioned(np.array(held), count) for count in more)]


def named(key: str, function: Callable, *arguments: Any) -> Any:
    """The function's value; an error names the key of the section that it is about."""
    try:
        return function(*arguments)
    except SceneError as error:
        raise SceneError(f"{key}.{error}") from error


def distinct_shapes(made: Sequence[shapes.Shape]) -> tuple[list[shapes.Shape], list[int]]:
    """Each shape once, and the place in that list of each piece's."""
    distinct = list({id(m): m for m in made}.values())
    place = {id(m): k for k, m in enumerate(distinct)}
    return distinct, [place[id(m)] for m in made]


def with_points(row: PieceShape, folder: str | Path) -> PieceShape:
    """The row with the corners of the STL that it names, whole or cut into parts; others as they are. Raises SceneError."""
    given = _given(row)
    if row.shape == "decomposed":
        cut = shapes.decompose(Path(folder) / given["stl"], row.unit, **_cutting(row))
        check_unit(row, given["stl"], cut.points)
        return _cut(row, cut)
    if row.shape == "compound":
        parts = [named(f"part.{n}", _part_with_points, part, folder) for n, part in enumerate(row.part)]
        notes = [f"part.{n}: {what}" for n, (_, what) in enumerate(parts) if what]
        return row.model_copy(update={"part": tuple(part for part, _ in parts)} | _noted(row, notes))
    if row.shape != "hull":
        return row
    found = _hull(row, folder)
    if row.stl is None and not found.notes:
        return row
    points: dict[str, Any] = {"stl": None, "unit": 1.0, "max_corners": None, "hull_tolerance": None}
    points |= {"points": tuples(found.shape.vertices.tolist()), "mass_properties": _mass_section(found.mass, found.centre)}
    said = "; ".join(found.notes)
    return row.model_copy(update=points | _noted(row, [f"{row.stl}: {said}" if row.stl else said] if said else []))


def _mass_section(mass: shapes.MassProperties | None, origin: np.ndarray) -> BodyMass | None:
    """The section of a scene that gives these mass properties, in axes that begin at an origin [3] (m)."""
    if mass is None:
        return None
    g = mass.gyration.tolist()
    gyration = (g[0][0], g[1][1], g[2][2], g[0][1], g[0][2], g[1][2])
    return BodyMass(volume=mass.volume, centre=tuple((mass.centre - origin).tolist()), gyration=gyration)


def _noted(row: PieceShape, said: Sequence[str]) -> dict[str, str]:
    """What is said of a row's shape, added to its note."""
    return {"note": "; ".join([*([row.note] if row.note else []), *said])} if said else {}


def _part_with_points(part: Part, folder: str | Path) -> tuple[Part, str | None]:
    if part.shape != "hull":
        return part, None
    found = _hull(part, folder)
    if part.stl is None and not found.notes:
        return part, None
    points = tuples(((found.shape.vertices + found.centre) * part.scale_factor).tolist())
    whole = {"stl": None, "unit": 1.0, "scale_factor": 1.0, "max_corners": None, "hull_tolerance": None, "points": points}
    return part.model_copy(update=whole), "; ".join(found.notes) or None


def _cut(row: PieceShape, found: shapes.Decomposition) -> PieceShape:
    """The row of a decomposed STL as a compound of hulls with the mass of the STL; a single part is a hull."""
    whole: dict[str, Any] = dict.fromkeys(("stl", "concavity", "max_parts", "loss", "max_corners")) | {"unit": 1.0}
    whole |= _noted(row, [f"{row.stl}: {'; '.join((*found.notes, str(found)))}"])
    points = [tuples(part.tolist()) for part in found.points]
    mass = _mass_section(found.mass, np.zeros(3))
    if len(points) == 1:
        differs = shapes.differs_in_mass(*shapes.placed_hull(found.points[0]), found.mass)
        own = {"shape": "hull", "points": points[0], "mass_properties": mass if differs else None}
        return with_points(row.model_copy(update=whole | own), ".")
    whole_parts = max(16, *map(len, points))  # simplified, they would not be flush where they were cut
    parts = tuple(Part(shape="hull", points=each, max_corners=whole_parts) for each in points)
    return row.model_copy(
        update=whole | {"shape": "compound", "part": parts, "mass_properties": mass, "joint_tolerance": shapes.JOINT}
    )


def piece_arrays(scene: Scene, goods: Goods, table: MaterialTable | None = None) -> Pieces:
    """Arrays of the pieces, in numpy or of traced values. table: materials of the scene, if known. Raises SceneError."""
    table = table or material_table(scene)
    row = rows_of_pieces(table, goods.materials)
    distinct, index = distinct_shapes(goods.shapes)
    each = lambda value: np.array([value(shape) for shape in distinct])[index]  # noqa: E731
    mass = masses_of(goods, table)
    return Pieces(
        mass=host(mass),
        inertia=host(mass[None] * each(lambda s: s.gyration).T),
        size=host(each(lambda s: shapes.size_length(s, scene.material.stiffness_size))),
        curvature=host(2 / each(shapes.SIZE_LENGTHS["equivalent-diameter"])),
        material=host(row),
        bounding_radius=host(each(lambda s: s.bounding_radius)),
        width=host(each(_width)),
    )


def size_of_piece(scene: Scene, law: str) -> float:
    """The size L (m) of the first piece, from which a contact law takes its stiffness. Raises SceneError."""
    convention = "equivalent-diameter" if law in HERTZIAN else scene.material.stiffness_size  # as of ``Pieces``
    return shapes.size_length(goods_of(scene).shapes[0], convention)


def _width(shape: shapes.Shape) -> float:
    """Smallest width (m): least extent along the normal of a face; of several parts that of the narrowest."""
    if shape.radius > 0:
        return 2 * shape.radius
    if shape.parts:
        return min(_width(part.shape) for part in shape.parts)
    heights = shape.vertices @ shape.normals.T
    return float((heights.max(0) - heights.min(0)).min())


def alike(goods: Goods) -> tuple[str, ...]:
    """System.alike."""
    if any(shape.parts for shape in goods.shapes):
        return ()
    both = list(zip(goods.shapes, goods.materials, strict=True))
    of_kind: dict[str, set[object]] = {
        "hulls": {id(shape) for shape, _ in both if shape.radius == 0},
        "spheres": {(id(shape), name) for shape, name in both if shape.radius > 0},
    }
    return tuple(kind for kind, different in of_kind.items() if len(different) == 1)


def tuples(points: Sequence[Sequence[float]]) -> tuple[tuple[float, float, float], ...]:
    """Points as tuples."""
    return tuple((x, y, z) for x, y, z in points)
