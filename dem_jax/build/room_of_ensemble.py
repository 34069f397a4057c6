"""Runs with different numbers of pieces in one program: all have as many as the one with most, the rest of them outside."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.build.parts import Solid
from dem_jax.build.pieces import Goods, distinct_shapes, kept_goods, piece_arrays
from dem_jax.build.reuse import Reuse
from dem_jax.build.start import Start
from dem_jax.scene import Scene
from dem_jax.scene.materials import material_table
from dem_jax.shapes import Shape, parts_of
from dem_jax.types import Pieces


class Room(NamedTuple):
    """What each run of an ensemble has room for. pieces: their number. polytopes: different convex ones among their parts."""

    pieces: int
    polytopes: int


def find_room(scenes: Sequence[Scene], reuse: Reuse) -> Room | None:
    """The room that the run with most pieces needs; None: all have as many, or pieces come and go. Raises SceneError."""
    if any(scene.inlet or scene.outlet for scene in scenes):
        return None
    goods = [kept_goods(scene, material_table(scene), reuse) for scene in scenes]
    counts = [len(each.shapes) for each in goods]
    if len(set(counts)) == 1:
        return None
    return Room(max(counts), max(_count_polytopes(each.shapes) for each in goods))


def fill_room(
    scene: Scene, goods: Goods, start: Start, lot: np.ndarray, room: Room, reuse: Reuse
) -> tuple[list[Shape], Pieces, Start]:
    """Shapes, arrays and start of the pieces and of those that fill up the room, which rest in a lot [n, 3] (m) outside."""
    padded = reuse.get("padded", lambda: _pad_goods(goods, room), (room,), (goods,))
    made = reuse.get("padded shapes", lambda: list(padded.shapes), (), padded.shapes)
    return made, piece_arrays(scene, padded), pad_start(start, lot)


def _pad_goods(goods: Goods, room: Room) -> Goods:
    """The pieces and copies of the last one, as many as there is room for."""
    more = room.pieces - len(goods.shapes)
    return replace(
        goods,
        shapes=goods.shapes + goods.shapes[-1:] * more,
        materials=goods.materials + goods.materials[-1:] * more,
        densities=goods.densities + goods.densities[-1:] * more,
    )


def pad_start(start: Start, lot: np.ndarray) -> Start:
    """The start with further pieces at rest in a lot [n, 3] (m) outside."""
    none = np.zeros_like(lot)
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(lot), 1))
    more = Start(lot, turn, none, none)
    return Start(*(np.concatenate([getattr(each, name) for each in (start, more)]) for name in Start.__dataclass_fields__))


def pad_solids(solids: list[list[Solid]], room: Room, made: Sequence[Shape]) -> list[Solid]:
    """Copies of a polytope, by which those of the pieces are as many different ones as there is room for."""
    some = [solid for row in solids for solid in row if solid.shape.radius == 0][:1]
    return [replace(solid) for solid in some for _ in range(room.polytopes - _count_polytopes(made))]


def _count_polytopes(shapes: Sequence[Shape]) -> int:
    """Number of different polytopes among the parts of pieces."""
    return sum(part.shape.radius == 0 for shape in distinct_shapes(shapes)[0] for part in parts_of(shape))
