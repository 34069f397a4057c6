"""Shapes and arrays of the pieces."""

from pathlib import Path

import numpy as np

from dem_jax import shapes
from dem_jax.build.law import PIECE
from dem_jax.errors import SceneError
from dem_jax.scene import SHAPE_KEYS, PieceShape, Scene, arrange
from dem_jax.types import Pieces


def make_shape(row: PieceShape, folder=".") -> shapes.Shape:
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


def pieces_of(scene: Scene):
    """The shape of each piece; one object where pieces are alike."""
    if scene.piece:
        cache: dict = {}
        out = []
        for n, row in enumerate(scene.piece):
            key = row.model_dump_json(include=set(PieceShape.model_fields))
            if key not in cache:
                cache[key] = named(f"piece.{n}", make_shape, row, scene.folder)
            out.append(cache[key])
        return out
    shape = named("portion", make_shape, scene.portion, scene.folder)
    return [shape] * sum(counts(scene, shape))


def counts(scene: Scene, shape):
    """Pieces of the portion, and on the feeder."""
    number = scene.portion.count or arrange.count(scene.portion.target_weight, scene.material.density * shape.volume)
    return number, (scene.feeder.count or number) if scene.feeder else 0


def named(key, function, *arguments):
    """The function's value; an error names the key of the section that it is about."""
    try:
        return function(*arguments)
    except SceneError as error:
        raise SceneError(f"{key}.{error}") from error


def distinct_shapes(made):
    distinct = list({id(m): m for m in made}.values())
    place = {id(m): k for k, m in enumerate(distinct)}
    return distinct, [place[id(m)] for m in made]


def with_points(row: PieceShape, folder):
    """The row of a hull with the corners of its STL; others as they are."""
    if row.shape != "hull" or row.stl is None or row.points is not None:
        return row
    corners = shapes.hull_of_stl(Path(folder) / row.stl, row.unit).vertices
    return row.model_copy(update={"stl": None, "unit": 1.0, "points": tuples(corners.tolist())})


def piece_arrays(scene: Scene, made) -> Pieces:
    """Arrays of the pieces, in numpy."""
    m = scene.material
    distinct, index = distinct_shapes(made)
    each = lambda value: np.array([value(shape) for shape in distinct])[index]  # noqa: E731
    mass = m.density * each(lambda s: s.volume)
    none = np.zeros(0, int)
    return Pieces(
        mass=mass,
        inertia=mass * each(lambda s: s.gyration).T,
        size=each(lambda s: shapes.size_length(s, m.stiffness_size)),
        curvature=2 / each(shapes.SIZE_LENGTHS["equivalent-diameter"]),
        material=np.full(len(made), PIECE),
        radius=each(lambda s: s.radius),
        bounding_radius=each(lambda s: s.bounding_radius),
        width=each(_width),
        polytopes=none,
        spheres=none,
    )


def _width(shape):
    """Smallest width (m): twice the smallest distance of a face from the centre's opposite side."""
    if shape.radius > 0:
        return 2 * shape.radius
    heights = shape.vertices @ shape.normals.T
    return float((heights.max(0) - heights.min(0)).min())


def alike(made):
    """System.alike."""
    of_kind = {"hulls": {id(m) for m in made if m.radius == 0}, "spheres": {id(m) for m in made if m.radius > 0}}
    return tuple(kind for kind, different in of_kind.items() if len(different) == 1)


def tuples(points):
    return tuple(tuple(p) for p in points)
