"""Arrays of a system that follow from the parameters of its scene, in numpy or of values that JAX traces: of a single run, of each
run of an ensemble and under differentiation alike."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dem_jax.build.law import law_of, materials_of
from dem_jax.build.pieces import Goods, material_inputs, piece_arrays
from dem_jax.build.reuse import Reuse
from dem_jax.build.start import Start
from dem_jax.build.typed import kept_tree, typed
from dem_jax.build.walls import moving_arrays
from dem_jax.contact.law import ContactLaw
from dem_jax.scene import Block, Motion, Scene, buckets
from dem_jax.scene.materials import MaterialTable, material_table
from dem_jax.scene.numbers import array, is_zero
from dem_jax.types import Materials, Pieces, Walls


@dataclass(frozen=True, eq=False)
class Layout:
    """Pieces before they are anywhere and walls at rest: the parameters of a scene do not change them."""

    goods: Goods
    walls: Walls  # without motions, load cell and drives, in the precision of the run
    blocks: tuple[Block, ...]
    drop_height: float  # (m) at which walls and blocks are placed
    law: ContactLaw | None  # instead of the scene's


@dataclass(frozen=True)
class ParameterArrays:
    """Fields of a System that follow from parameters, in double precision except for the walls, and where the pieces start."""

    pieces: Pieces
    materials: Materials
    law: Any
    walls: Walls
    gravity: Any  # [3] (m/s2)
    block_low: Any  # [3, B] (m)
    block_high: Any  # [3, B] (m)
    start: Start

    def system_fields(self, reuse: Reuse | None = None) -> dict[str, Any]:
        """The fields of a System, in the precision of the walls. reuse: arrays of scenes before."""
        reuse, dtype = reuse or Reuse(), self.walls.centre.dtype
        names = ("pieces", "materials", "law", "gravity", "block_low", "block_high")
        return {name: kept_tree(reuse, f"typed {name}", getattr(self, name), dtype) for name in names} | {"walls": self.walls}


def find_arrays(
    scene: Scene,
    layout: Layout,
    motions: Sequence[Motion],
    start: Start,
    table: MaterialTable | None = None,
    form: Materials | None = None,
    reuse: Reuse | None = None,
) -> ParameterArrays:
    """The arrays of a scene whose parameters may be traced.

    Args:
        scene: that of the layout, but for its parameters.
        layout: pieces and walls.
        motions: sections of all motions of walls, see ``walls_of``; hinges at the drop height of the layout.
        start: poses and velocities of the pieces, at the drop height of the layout unless they are listed one by one.
        table: materials of the scene, if they are known already.
        form: as of ``materials_of``.
        reuse: arrays of scenes before; None where numbers are traced.

    Raises:
        SceneError: the scene cannot be used.
    """
    table, fixed = table or material_table(scene), layout.walls
    inputs = () if reuse is None else (material_inputs(scene, table),)
    reuse = reuse or Reuse()
    materials = materials_of(scene, table, form)
    move = lambda: fixed.replace(**typed(moving_arrays(scene, motions, fixed), fixed.centre.dtype))  # noqa: E731
    walls = reuse.get("moving walls", move, (), (fixed, motions))
    corners = {key: np.reshape([getattr(block, key) for block in layout.blocks], (-1, 3)).T for key in ("low", "high")}
    arrays = ParameterArrays(
        pieces=reuse.get("pieces", lambda: piece_arrays(scene, layout.goods, table), inputs, (layout.goods,)),
        materials=materials,
        law=layout.law or law_of(scene, materials),
        walls=walls,
        gravity=array(scene.run.gravity),
        block_low=corners["low"],
        block_high=corners["high"],
        start=start,
    )
    lift = scene.drop.height - layout.drop_height
    return arrays if is_zero(lift) else _raise_feed(scene, layout, arrays, lift)


def _raise_feed(scene: Scene, layout: Layout, arrays: ParameterArrays, lift: Any) -> ParameterArrays:
    """The arrays with feed bucket, feeder and the pieces in them raised by a height (m)."""
    walls, start = arrays.walls, arrays.start
    if scene.feed_bucket is None:
        return arrays
    parts = buckets.parts(scene.feed_bucket, "fb", 0.0)
    hung, hinged = {group for group, *_ in parts.panels} | {buckets.FEEDER}, {row.group for row in parts.motions}
    higher, turned = (typed(_upwards(lift, [g in names for g in walls.groups]), walls.centre.dtype) for names in (hung, hinged))
    walls = walls.replace(centre=walls.centre + higher[:, np.asarray(walls.group)], pivot=walls.pivot + turned)
    blocks = _upwards(lift, [block.name in ("fb", buckets.FEEDER) for block in layout.blocks])
    if not scene.piece:
        # Those of a portion in a region of its own stay there.
        own = 0 if scene.portion is None or scene.portion.region_low is None else layout.goods.numbers[0]
        start = replace(start, position=start.position + _upwards(lift, [n >= own for n in range(len(start.position))]).T)
    low, high = arrays.block_low + blocks, arrays.block_high + blocks
    return replace(arrays, walls=walls, block_low=low, block_high=high, start=start)


def _upwards(height: Any, which: list[bool]) -> Any:
    """A height (m) along z for those for which it holds, [3, n]."""
    return array([[0.0] * len(which), [0.0] * len(which), [height if one else 0.0 for one in which]])
