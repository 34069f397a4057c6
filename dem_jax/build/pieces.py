"""Shapes and arrays of the pieces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax import shapes
from dem_jax.build import portion
from dem_jax.errors import SceneError
from dem_jax.scene import SHAPE_KEYS, PieceShape, Portion, Scene, arrange
from dem_jax.scene.materials import material_table, rows_of_pieces
from dem_jax.types import Pieces


def make_shape(row: PieceShape, folder: str | Path = ".") -> shapes.Shape:
    """The shape that a scene names, scaled. Raises SceneError."""
    given = {k for k in ("size", "chamfer", "radius", "height", "sides", "points", "stl") if getattr(row, k) is not None}
    stray = sorted(given - SHAPE_KEYS[row.shape])
    if stray:
        allowed = ", ".join(sorted(SHAPE_KEYS[row.shape]))
        raise SceneError(f"{stray[0]} = {getattr(row, stray[0])}: not a key of shape {row.shape!r}; allowed: {allowed}")
    if row.shape == "hull":
        if (row.points is None) == (row.stl is None):
            raise SceneError("shape 'hull': points, stl: exactly one of the two must be given")
        if row.stl is not None:
            return shapes.scaled(shapes.hull_of_stl(Path(folder) / row.stl, row.unit), row.scale_factor)
        return shapes.scaled(shapes.hull(np.array(row.points) * row.unit), row.scale_factor)
    required = {"sphere": ["radius"], "cuboid": ["size"], "prism": ["sides", "radius", "height"]}
    for key in required.get(row.shape, ["radius", "height"] if row.shape == "cylinder" else []):
        if getattr(row, key) is None:
            raise SceneError(f"{key}: missing; shape {row.shape!r} needs it")
    maker = getattr(shapes, row.shape.replace("-", "_"))
    return shapes.scaled(maker(**{k: getattr(row, k) for k in given}), row.scale_factor)


@dataclass(frozen=True)
class Goods:
    """The N pieces of a scene before they are anywhere."""

    shapes: tuple[shapes.Shape, ...]  # of each piece, scaled; one object where pieces are alike
    materials: tuple[str | None, ...]  # name of the material of each, None: [material] itself
    numbers: tuple[int, ...]  # pieces of the portion and, with a feeder, on it; () of pieces listed one by one


def goods_of(scene: Scene) -> Goods:
    """The pieces of a scene: as listed, or of a portion product by product, then those on the feeder. Raises SceneError."""
    if scene.piece:
        listed = _shapes_of_rows(scene.piece, "piece.{}", scene.folder)
        return Goods(tuple(listed), tuple(row.material for row in scene.piece), ())
    assert scene.portion is not None  # as a Scene makes sure
    rows = scene.portion.rows
    made = _shapes_of_rows(rows, "portion.product.{}" if scene.portion.product else "portion", scene.folder)
    resized = cache(shapes.scaled)
    found: list[shapes.Shape] = []
    names: list[str | None] = []
    numbers: list[int] = []
    for counts in counts_of(scene, scene.portion, made):
        for shape, row, number in zip(made, rows, counts, strict=True):
            each = portion.sizes(number, row.size_spread)
            found += [shape if size == 1.0 else resized(shape, float(size)) for size in each]
            names += [row.material] * number
        numbers.append(sum(counts))
    return Goods(tuple(found), tuple(names), tuple(numbers))


def pieces_of(scene: Scene) -> list[shapes.Shape]:
    """The shape of each piece; one object where pieces are alike. Raises SceneError."""
    return list(goods_of(scene).shapes)


def _shapes_of_rows(rows: Sequence[PieceShape], key: str, folder: str) -> list[shapes.Shape]:
    made: dict[str, shapes.Shape] = {}
    out = []
    for n, row in enumerate(rows):
        text = row.model_dump_json(include=set(PieceShape.model_fields))
        if text not in made:
            made[text] = named(key.format(n), make_shape, row, folder)
        out.append(made[text])
    return out


def counts_of(scene: Scene, of: Portion, made: Sequence[shapes.Shape]) -> list[tuple[int, ...]]:
    """Pieces of each product (shapes ``made``): of the portion, and on the feeder if there is one (by default as many)."""
    table = material_table(scene)
    density = table.density[rows_of_pieces(table, [row.material for row in of.rows])]
    mass = density * np.array([shape.volume for shape in made])
    spread = np.array([row.size_spread for row in of.rows])
    mix = portion.Mix(mass, np.array([row.share for row in of.product] or [1.0]), spread, of.share_by)
    if of.count:
        own = portion.numbers_of_count(mix, of.count)
    elif of.product or spread.any():
        own = portion.numbers_of_weight(mix, of.target_weight)
    else:
        own = (arrange.count(of.target_weight, float(mass[0])),)
    if scene.feeder is None:
        return [own]
    return [own, own if scene.feeder.count is None else portion.apportioned(np.array(own), scene.feeder.count)]


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
    """The row of a hull with the corners of its STL; others as they are."""
    if row.shape != "hull" or row.stl is None or row.points is not None:
        return row
    corners = shapes.hull_of_stl(Path(folder) / row.stl, row.unit).vertices
    return row.model_copy(update={"stl": None, "unit": 1.0, "points": tuples(corners.tolist())})


def piece_arrays(scene: Scene, goods: Goods) -> Pieces:
    """Arrays of the pieces, in numpy. Raises SceneError."""
    table = material_table(scene)
    row = rows_of_pieces(table, goods.materials)
    distinct, index = distinct_shapes(goods.shapes)
    each = lambda value: np.array([value(shape) for shape in distinct])[index]  # noqa: E731
    mass = table.density[row] * each(lambda s: s.volume)
    none = np.zeros(0, int)
    return Pieces(
        mass=mass,
        inertia=mass * each(lambda s: s.gyration).T,
        size=each(lambda s: shapes.size_length(s, scene.material.stiffness_size)),
        curvature=2 / each(shapes.SIZE_LENGTHS["equivalent-diameter"]),
        material=row,
        radius=each(lambda s: s.radius),
        bounding_radius=each(lambda s: s.bounding_radius),
        width=each(_width),
        polytopes=none,
        spheres=none,
    )


def _width(shape: shapes.Shape) -> float:
    """Smallest width (m): twice the smallest distance of a face from the centre's opposite side."""
    if shape.radius > 0:
        return 2 * shape.radius
    heights = shape.vertices @ shape.normals.T
    return float((heights.max(0) - heights.min(0)).min())


def alike(goods: Goods) -> tuple[str, ...]:
    """System.alike."""
    both = list(zip(goods.shapes, goods.materials, strict=True))
    of_kind = {
        "hulls": {id(shape) for shape, _ in both if shape.radius == 0},
        "spheres": {(id(shape), name) for shape, name in both if shape.radius > 0},
    }
    return tuple(kind for kind, different in of_kind.items() if len(different) == 1)


def tuples(points: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    """Points as tuples."""
    return tuple(tuple(p) for p in points)
