"""Runs with different numbers of pieces in one program: each is padded to the largest number with
pieces outside the scene.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.initial_conditions import InitialConditions
from dem_jax.assembly.part_arrays import PiecePart
from dem_jax.assembly.piece_arrays import (
    PieceSet,
    build_piece_arrays,
    find_distinct_shapes,
    reuse_piece_set,
)
from dem_jax.scene import Scene
from dem_jax.scene.material_properties import build_material_table
from dem_jax.shapes import Shape, list_parts
from dem_jax.types import Pieces


class EnsembleCapacity(NamedTuple):
    """Capacity of each run of an ensemble. pieces: number of pieces. polytopes: number of distinct
    convex polytopes among their parts.
    """

    pieces: int
    polytopes: int


def find_ensemble_capacity(
    scenes: Sequence[Scene], reuse: AssemblyCache
) -> EnsembleCapacity | None:
    """The capacity that the run with most pieces needs; None if all runs have equal numbers, or if
    pieces come and go. Raises SceneError.
    """
    if any(scene.inlet or scene.outlet for scene in scenes):
        return None
    goods = [reuse_piece_set(scene, build_material_table(scene), reuse) for scene in scenes]
    counts = [len(each.shapes) for each in goods]
    if len(set(counts)) == 1:
        return None
    return EnsembleCapacity(max(counts), max(_count_polytopes(each.shapes) for each in goods))


def pad_pieces(
    scene: Scene,
    goods: PieceSet,
    start: InitialConditions,
    lot: np.ndarray,
    room: EnsembleCapacity,
    reuse: AssemblyCache,
) -> tuple[list[Shape], Pieces, InitialConditions]:
    """Shapes, arrays and initial conditions of the pieces and of the padding, which rests at lot
    [n, 3] (m) outside.
    """
    padded = reuse.get("padded", lambda: _pad_piece_set(goods, room), (room,), (goods,))
    made = reuse.get("padded shapes", lambda: list(padded.shapes), (), padded.shapes)
    return made, build_piece_arrays(scene, padded), pad_initial_conditions(start, lot)


def _pad_piece_set(goods: PieceSet, room: EnsembleCapacity) -> PieceSet:
    """The pieces, padded to the capacity by copies of the last one."""
    more = room.pieces - len(goods.shapes)
    return replace(
        goods,
        shapes=goods.shapes + goods.shapes[-1:] * more,
        materials=goods.materials + goods.materials[-1:] * more,
        densities=goods.densities + goods.densities[-1:] * more,
    )


def pad_initial_conditions(start: InitialConditions, lot: np.ndarray) -> InitialConditions:
    """The initial conditions, padded by pieces at rest at lot [n, 3] (m) outside."""
    none = np.zeros_like(lot)
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(lot), 1))
    more = InitialConditions(lot, turn, none, none)
    return InitialConditions(
        *(
            np.concatenate([getattr(each, name) for each in (start, more)])
            for name in InitialConditions.__dataclass_fields__
        )
    )


def pad_polytopes(
    solids: list[list[PiecePart]], room: EnsembleCapacity, made: Sequence[Shape]
) -> list[PiecePart]:
    """Copies of a polytope that pad the number of distinct ones to the capacity."""
    some = [solid for row in solids for solid in row if solid.shape.radius == 0][:1]
    return [
        replace(solid) for solid in some for _ in range(room.polytopes - _count_polytopes(made))
    ]


def _count_polytopes(shapes: Sequence[Shape]) -> int:
    """Number of distinct polytopes among the parts of pieces."""
    return sum(
        part.shape.radius == 0
        for shape in find_distinct_shapes(shapes)[0]
        for part in list_parts(shape)
    )
