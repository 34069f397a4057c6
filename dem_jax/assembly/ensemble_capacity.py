"""Runs with different numbers of pieces in one program: each is padded to the largest number, or to
that of a size class, with pieces outside the scene.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.hull_table import is_small_zonotope
from dem_jax.assembly.initial_conditions import InitialConditions
from dem_jax.assembly.part_arrays import PiecePart
from dem_jax.assembly.piece_arrays import (
    PieceSet,
    build_piece_arrays,
    find_alike_kinds,
    find_distinct_shapes,
    reuse_piece_set,
)
from dem_jax.broad_phase.candidate_search import choose_search
from dem_jax.scene import Scene
from dem_jax.scene.material_properties import build_material_table
from dem_jax.shapes import Shape, list_parts
from dem_jax.types import Pieces

PIECE_CLASSES = (16, 32, 64, 128, 256, 640)  # numbers of pieces to which a portion is filled up:
# fewer than those for which cells replace all pairs. Measured: of nine marshmallows a step with 16
# pieces takes 0.94 of that with exact sizes, with 64 pieces 1.57.
COARSE_CLASSES = (16, 64, 256, 640)  # the same for general polytopes and pieces of several parts,
# whose contacts take several times as long
SHAPE_CLASS = 16  # distinct polytopes, unless there is one: as many as a product has sizes


class EnsembleCapacity(NamedTuple):
    """Capacity of each run of an ensemble, or of a size class.

    pieces: number of pieces. polytopes: number of distinct convex polytopes among their parts.
    alike: ``System.alike`` of all runs. rounded: whether numbers of faces, corners and edges are
    rounded up to those of a class.
    """

    pieces: int
    polytopes: int
    alike: tuple[str, ...]
    rounded: bool


def find_ensemble_capacity(
    scenes: Sequence[Scene], reuse: AssemblyCache
) -> EnsembleCapacity | None:
    """The capacity that the run with most pieces needs; None if all runs have equal numbers, or if
    pieces come and go. Raises SceneError.
    """
    found = _measure_scenes(scenes, reuse)
    return None if found is None or len(found.counts) == 1 else found.capacity


def find_size_class(scenes: Sequence[Scene], reuse: AssemblyCache) -> EnsembleCapacity | None:
    """The size class of scenes that share a program: ``find_ensemble_capacity``, rounded up. Only
    for portions of at most ``PIECE_CLASSES[-1]`` pieces, and unless a scene asks for exact sizes.
    Raises SceneError.
    """
    found = _measure_scenes(scenes, reuse)
    if found is None:
        return None
    most = found.capacity.pieces
    has_class = most <= PIECE_CLASSES[-1] and all(
        scene.run.sizes == "classes"
        and not scene.piece
        and choose_search(scene.run.broad_phase, most) == "all-pairs"
        for scene in scenes
    )
    if not has_class:
        return None if len(found.counts) == 1 else found.capacity
    shapes, alike = found.capacity.polytopes, found.capacity.alike
    if shapes and not (shapes == 1 and found.are_zonotopes):
        shapes, alike = -(-shapes // SHAPE_CLASS) * SHAPE_CLASS, tuple({*alike} - {"hulls"})
    classes = PIECE_CLASSES if found.are_zonotopes else COARSE_CLASSES
    return EnsembleCapacity(
        pieces=next(size for size in classes if size >= most),
        polytopes=shapes,
        alike=alike,
        rounded=True,
    )


class _MeasuredScenes(NamedTuple):
    """Numbers of pieces of some scenes, each once, and the capacity for all of them."""

    counts: frozenset[int]
    capacity: EnsembleCapacity
    are_zonotopes: bool  # all polytopes, if any, see ``hull_table.is_small_zonotope``


def _measure_scenes(scenes: Sequence[Scene], reuse: AssemblyCache) -> _MeasuredScenes | None:
    """Measures of scenes; None if pieces come and go."""
    if any(scene.inlet or scene.outlet for scene in scenes):
        return None
    tables = [reuse.get_for("materials", scene, build_material_table) for scene in scenes]
    goods = [reuse_piece_set(*row, reuse) for row in zip(scenes, tables, strict=True)]
    counts = [len(each.shapes) for each in goods]
    shapes = max(_count_polytopes(each.shapes) for each in goods)
    alike = set.intersection(*(set(find_alike_kinds(each)) for each in goods))
    own = EnsembleCapacity(max(counts), shapes, tuple(sorted(alike)), False)
    distinct = {id(shape): shape for each in goods for shape in each.shapes if shape.radius == 0}
    zonotopes = all(is_small_zonotope(shape) for shape in distinct.values())
    return _MeasuredScenes(frozenset(counts), own, zonotopes)


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
