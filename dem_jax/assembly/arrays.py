"""Arrays of a system that follow from the parameters of its scene.

The parameters are numpy values or values that JAX traces, so that the same functions serve single
runs, the runs of an ensemble and differentiation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.contact_law import build_contact_law, build_materials
from dem_jax.assembly.dtype_cast import cast_tree, reuse_tree
from dem_jax.assembly.initial_conditions import InitialConditions
from dem_jax.assembly.piece_arrays import PieceSet, build_piece_arrays, material_inputs
from dem_jax.assembly.wall_panels import build_motion_arrays
from dem_jax.contact_laws import ContactLaw
from dem_jax.scene import Motion, Region, Scene, bucket_geometry
from dem_jax.scene.array_namespace import as_float_array, is_zero
from dem_jax.scene.material_properties import MaterialTable, build_material_table
from dem_jax.types import Materials, Pieces, Walls


@dataclass(frozen=True, eq=False)
class Layout:
    """Pieces before placement and walls at rest, which do not depend on the parameters of the
    scene.
    """

    goods: PieceSet
    walls: Walls  # without motions, load cell and drives, in the precision of the run
    blocks: tuple[Region, ...]
    drop_height: float  # (m) at which walls and blocks are placed
    law: ContactLaw | None  # instead of the scene's


@dataclass(frozen=True)
class ParameterArrays:
    """Fields of a System that follow from parameters, and the initial conditions of the pieces.

    All arrays are in double precision except those of the walls.
    """

    pieces: Pieces
    materials: Materials
    law: Any
    walls: Walls
    gravity: Any  # [3] (m/s2)
    block_low: Any  # [3, B] (m)
    block_high: Any  # [3, B] (m)
    start: InitialConditions

    def system_fields(self, reuse: AssemblyCache | None = None) -> dict[str, Any]:
        """The fields of a System, in the precision of the walls. reuse: arrays of earlier
        scenes.
        """
        reuse, dtype = reuse or AssemblyCache(), self.walls.centre.dtype
        names = ("pieces", "materials", "law", "gravity", "block_low", "block_high")
        return {
            name: reuse_tree(reuse, f"typed {name}", getattr(self, name), dtype) for name in names
        } | {"walls": self.walls}


def find_arrays(
    scene: Scene,
    layout: Layout,
    motions: Sequence[Motion],
    start: InitialConditions,
    table: MaterialTable | None = None,
    form: Materials | None = None,
    reuse: AssemblyCache | None = None,
) -> ParameterArrays:
    """Compute the arrays of a scene, whose parameters may be traced.

    Args:
        scene: the scene of the layout; only its parameters may differ.
        layout: pieces and walls.
        motions: sections of all wall motions, see ``lay_out_walls``; hinges at the drop height of
            the layout.
        start: poses and velocities of the pieces, at the drop height of the layout unless they are
            listed one by one.
        table: materials of the scene, if already known.
        form: see ``build_materials``.
        reuse: arrays of earlier scenes; None where numbers are traced.

    Raises:
        SceneError: the scene cannot be used.
    """
    table, fixed = table or build_material_table(scene), layout.walls
    inputs = () if reuse is None else (material_inputs(scene, table),)
    reuse = reuse or AssemblyCache()
    materials = build_materials(scene, table, form)
    move = lambda: fixed.replace(
        **cast_tree(build_motion_arrays(scene, motions, fixed), fixed.centre.dtype)
    )
    walls = reuse.get("moving walls", move, (), (fixed, motions))
    corners = {
        key: np.reshape([getattr(block, key) for block in layout.blocks], (-1, 3)).T
        for key in ("low", "high")
    }
    arrays = ParameterArrays(
        pieces=reuse.get(
            "pieces",
            lambda: build_piece_arrays(scene, layout.goods, table),
            inputs,
            (layout.goods,),
        ),
        materials=materials,
        law=layout.law or build_contact_law(scene, materials),
        walls=walls,
        gravity=as_float_array(scene.run.gravity),
        block_low=corners["low"],
        block_high=corners["high"],
        start=start,
    )
    lift = scene.drop.height - layout.drop_height
    return arrays if is_zero(lift) else _raise_feed(scene, layout, arrays, lift)


def _raise_feed(
    scene: Scene, layout: Layout, arrays: ParameterArrays, lift: Any
) -> ParameterArrays:
    """Raise the feed bucket, the feeder and the pieces in them by a height (m)."""
    walls, start = arrays.walls, arrays.start
    if scene.feed_bucket is None:
        return arrays
    parts = bucket_geometry.build_bucket_parts(scene.feed_bucket, "fb", 0.0)
    hung, hinged = (
        {group for group, *_ in parts.panels} | {bucket_geometry.FEEDER_GROUP},
        {row.group for row in parts.motions},
    )
    higher, turned = (
        cast_tree(_upwards(lift, [g in names for g in walls.groups]), walls.centre.dtype)
        for names in (hung, hinged)
    )
    walls = walls.replace(
        centre=walls.centre + higher[:, np.asarray(walls.group)], pivot=walls.pivot + turned
    )
    blocks = _upwards(
        lift, [block.name in ("fb", bucket_geometry.FEEDER_GROUP) for block in layout.blocks]
    )
    if not scene.piece:
        # Pieces of a portion with its own region stay there.
        own = (
            0
            if scene.portion is None or scene.portion.region_low is None
            else layout.goods.numbers[0]
        )
        start = replace(
            start,
            position=start.position
            + _upwards(lift, [n >= own for n in range(len(start.position))]).T,
        )
    low, high = arrays.block_low + blocks, arrays.block_high + blocks
    return replace(arrays, walls=walls, block_low=low, block_high=high, start=start)


def _upwards(height: Any, which: list[bool]) -> Any:
    """A displacement [3, n] (m): the height along z where the flag is set, else zero."""
    return as_float_array(
        [[0.0] * len(which), [0.0] * len(which), [height if one else 0.0 for one in which]]
    )
