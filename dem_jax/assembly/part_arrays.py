"""The convex parts of the pieces: their arrays, and the table of hulls of parts and panels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dem_jax.assembly import hull_table
from dem_jax.assembly.panel_surfaces import NO_SEAMS, PanelSeams
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import Continuation, Shape, find_continuations, list_parts
from dem_jax.types import Hulls, Parts, as_array


@dataclass(frozen=True, eq=False)
class PiecePart:
    """A convex part of a kind of piece."""

    shape: Shape  # about its own centre; its principal frame is that of the piece
    centre: np.ndarray  # [3] (m): in that frame
    label: int  # of its surface; -1 for a part without shared surface
    continued: Continuation | None


def list_piece_parts(made: Sequence[Shape]) -> list[list[PiecePart]]:
    """The parts of each piece; identical pieces share the same objects."""
    known: dict[int, list[PiecePart]] = {}
    for shape in made:
        if id(shape) not in known:
            known[id(shape)] = _split_shape(shape)
    return [known[id(shape)] for shape in made]


def _split_shape(shape: Shape) -> list[PiecePart]:
    if len(list_parts(shape)) == 1:
        return [PiecePart(shape, np.zeros(3), -1, None)]
    turn = quaternion_to_matrix(shape.principal)
    rows = zip(shape.parts, shape.joint_labels, find_continuations(shape), strict=True)
    framed = lambda s: replace(s, principal=shape.principal)
    return [
        PiecePart(
            framed(part.shape),
            part.centre @ turn,
            -1 if more is None else int(label),
            None if more is None else replace(more, extended=framed(more.extended)),
        )
        for part, label, more in rows
    ]


def build_part_arrays(solids: list[list[PiecePart]]) -> Parts:
    """Arrays of the parts of all pieces, in numpy."""
    every = [solid for row in solids for solid in row]
    radius = np.array([solid.shape.radius for solid in every])
    owner = surface = centre = None
    if len(every) > len(solids):
        owner = as_array(np.repeat(np.arange(len(solids)), [len(row) for row in solids]))
        centre = as_array(np.array([solid.centre for solid in every]).T)
        names = [(n, solid.label) for n, row in enumerate(solids) for solid in row]
        number = {
            name: k for k, name in enumerate(dict.fromkeys(name for name in names if name[1] >= 0))
        }
        surface = as_array(np.array([number.get(name, -1) for name in names])) if number else None
    return Parts(
        owner=owner,
        surface=surface,
        centre=centre,
        radius=as_array(radius),
        bounding_radius=as_array(np.array([solid.shape.bounding_radius for solid in every])),
        polytopes=as_array(np.flatnonzero(radius == 0)),
        spheres=as_array(np.flatnonzero(radius > 0)),
    )


def build_body_hulls(
    solids: list[list[PiecePart]],
    plates: list[Shape],
    seams: list[PanelSeams] | None,
    rounded: bool = False,
) -> tuple[Hulls | None, np.ndarray]:
    """The hull table of parts and panels (None if all parts are spheres), and the table row of each
    body.

    seams: of each panel, as ``hull_table.build_hull_table`` takes them, as rounded.
    """
    rows: dict[int, int] = {}
    distinct: list[PiecePart] = []
    index = []
    for solid in (solid for row in solids for solid in row):
        if solid.shape.radius == 0 and id(solid) not in rows:
            rows[id(solid)] = len(distinct)
            distinct.append(solid)
        index.append(rows.get(id(solid), 0))
    index += [len(distinct) + k for k in range(len(plates))]
    if not distinct:
        return None, np.zeros(len(index), int)
    every = [*[solid.shape for solid in distinct], *plates]
    if seams:
        seams = [NO_SEAMS] * len(distinct) + seams
    more = [*[solid.continued for solid in distinct], *[None] * len(plates)]
    return hull_table.build_hull_table(
        every, np.float64, seams, more if any(more) else None, rounded
    ), np.array(index, int)
