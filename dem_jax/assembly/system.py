"""Assembly of a scene into a system and its first state: shape tables, stiffnesses, wall panels and
contact slots.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.assembly import flap_drive_setup
from dem_jax.assembly.arrays import Layout, ParameterArrays, find_arrays
from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.capacities import (
    estimate_capacities,
    estimate_contacts_per_piece,
    estimate_partition,
    estimate_row_capacity,
    has_slender_pieces,
)
from dem_jax.assembly.contact_law import extend_to_class
from dem_jax.assembly.dtype_cast import cast_array, cast_tree, put_array, reuse_array
from dem_jax.assembly.ensemble_capacity import (
    EnsembleCapacity,
    pad_initial_conditions,
    pad_pieces,
    pad_polytopes,
)
from dem_jax.assembly.exchange_plan import (
    ExchangePlan,
    extend_domain,
    find_waiting_places,
    list_start_boxes,
    plan_exchange,
)
from dem_jax.assembly.finiteness_check import MOST_STEPS, check_finite, check_steps
from dem_jax.assembly.initial_conditions import (
    Box,
    InitialConditions,
    build_initial_motion,
    build_initial_state,
    count_settling_samples,
    place_pieces,
)
from dem_jax.assembly.load_cell_setup import bound_load_cell_frequency
from dem_jax.assembly.panel_surfaces import PanelSeams
from dem_jax.assembly.part_arrays import build_body_hulls, build_part_arrays, list_piece_parts
from dem_jax.assembly.piece_arrays import (
    PieceSet,
    call_with_key,
    find_alike_kinds,
    inline_shape_points,
    reuse_piece_set,
)
from dem_jax.assembly.sampling_check import shortest_contact_time
from dem_jax.assembly.statistics_setup import build_collision_bins
from dem_jax.assembly.time_step import (
    PossibleContact,
    TimeStep,
    block_steps,
    choose_step,
    largest_interaction_range,
    list_possible_contacts,
)
from dem_jax.assembly.wall_panels import (
    build_panel_arrays,
    inline_buckets,
    inline_wall_panels,
    lay_out_walls,
)
from dem_jax.contact_laws import ContactLaw
from dem_jax.contacts.smooth_surfaces import largest_fillet
from dem_jax.deprecation import accept_former_methods
from dem_jax.dynamics import standard_quantities
from dem_jax.errors import SceneError
from dem_jax.scene import Motion, Scene
from dem_jax.scene.bucket_geometry import Panel
from dem_jax.scene.material_properties import MaterialTable, build_material_table, find_group_rows
from dem_jax.shapes import Shape
from dem_jax.types import Array, Hulls, Parts, State, System, Walls, float_dtype
from dem_jax.walls import motion

WALL_SECTIONS = ("weigh_bucket", "feed_bucket", "feeder", "drop", "cycle")  # sections of a scene
# that define walls
SKIN_FRACTION = 0.03  # of the width of the narrowest piece: see broad_phase.neighbour_list


@dataclass(frozen=True)
class AssembledSystem:
    """A system with its first state and the additional data that the host needs."""

    system: System
    state: State
    step: TimeStep
    shortest_contact_time: float  # s: approximate duration of the shortest possible contact
    shapes: tuple[Shape, ...]  # of each piece, scaled, body frame of the user
    frames: np.ndarray  # [N, 4]: principal frame to body frame, of each piece
    settling_steps: int  # steps before time zero
    samples: int  # to be run
    frame_every: int  # samples between stored frames; 0: none
    regions: list[Box]  # boxes in which pieces are scattered: in the feed bucket, on the feeder,
    # and the waiting box of an inlet
    numbers: tuple[int, ...]  # pieces in each of these boxes; () for pieces listed one by one
    piece_set: PieceSet  # the pieces before placement, without the padding of an ensemble
    exchange_plan: ExchangePlan | None  # of pieces that enter and leave
    waiting_places: np.ndarray | None  # [n, 3] (m): places outside the scene of the padding of an
    # ensemble; None without padding
    layout: Layout
    start: InitialConditions  # of the pieces without padding


def assemble_system(
    scene: Scene,
    seed: int = 0,
    law: ContactLaw | None = None,
    reuse: AssemblyCache | None = None,
    room: EnsembleCapacity | None = None,
    slot_block: int = 0,
) -> AssembledSystem:
    """Assemble the system and first state of a scene.

    Args:
        scene: the scene.
        seed: of the random placement.
        law: used instead of the scene's contact law.
        reuse: cache of earlier scenes.
        room: capacity of an ensemble whose runs have different numbers of pieces.
        slot_block: ``System.slot_block``.

    Raises:
        SceneError: the scene cannot be used.
    """
    reuse = reuse or AssemblyCache()
    table = reuse.get_for("materials", scene, build_material_table)
    placed = _place_scene(scene, seed, table, reuse)
    if law is not None:
        accept_former_methods(law)
    layout = Layout(placed.goods, placed.fixed, tuple(placed.blocks), scene.drop.height, law)
    arrays = find_arrays(scene, layout, placed.motions, placed.start, table, reuse=reuse)
    law = arrays.law
    contacts = list_possible_contacts(law, arrays.materials, placed.shapes, arrays.pieces, reuse)
    step = _choose_step(scene, law, contacts, placed.motions, placed.panels, len(placed.shapes))
    settling, samples, frame_every = _find_run_lengths(scene, step)
    bodies, arrays = _build_bodies(scene, placed, arrays, room, reuse)
    reach = largest_interaction_range(law, contacts)
    system = _build_system(scene, placed, bodies, arrays, step, reach, room, slot_block, reuse)
    state = _reuse_initial_state(
        system, bodies.start, bodies.frames, -settling, placed.waiting, reuse
    )
    check_finite(scene, system, state, reuse)
    return AssembledSystem(
        system=system,
        state=state,
        step=step,
        shortest_contact_time=shortest_contact_time(law, contacts),
        shapes=tuple(bodies.shapes),
        frames=bodies.frames,
        settling_steps=settling,
        samples=samples,
        frame_every=frame_every,
        regions=placed.regions,
        numbers=placed.goods.numbers,
        piece_set=placed.goods,
        exchange_plan=placed.plan,
        waiting_places=bodies.waiting_places,
        layout=layout,
        start=placed.start,
    )


class _PlacedScene(NamedTuple):
    """Pieces and walls of a scene where they begin.

    shapes: of the pieces. waiting: number of last pieces that are outside the scene. blocks: boxes
    that come in and go out. regions: see ``AssembledSystem``. fixed, plates, seams: see
    ``build_panel_arrays``. largest: (m) bounding radius of a piece. domain: see ``_find_domain``.
    """

    goods: PieceSet
    shapes: list[Shape]
    panels: Sequence[Panel]
    motions: Sequence[Motion]
    blocks: Sequence[Any]
    regions: list[Box]
    plan: ExchangePlan | None
    waiting: int
    start: InitialConditions
    fixed: Walls
    plates: list[Shape]
    seams: list[PanelSeams] | None
    largest: float
    domain: tuple[np.ndarray, np.ndarray]


def _place_scene(
    scene: Scene, seed: int, table: MaterialTable, reuse: AssemblyCache
) -> _PlacedScene:
    """Build pieces and walls, and place the pieces. Raises SceneError."""
    goods = reuse_piece_set(scene, table, reuse)
    shapes = reuse.get("made", lambda: list(goods.shapes), (), goods.shapes)  # reused where only
    # weights differ
    of_walls = (
        scene.wall,
        scene.motion,
        scene.region,
        *(getattr(scene, name) for name in WALL_SECTIONS),
        scene.folder,
    )
    panels, motions, joint, blocks, regions = reuse.get(
        "walls", lambda: lay_out_walls(scene), of_walls
    )
    plan = plan_exchange(scene, panels, regions, shapes)
    waiting = goods.numbers[-1] if scene.inlet else 0
    regions = list_start_boxes(scene, panels, regions, goods.numbers, shapes)
    boxes = np.asarray(regions, float).tobytes()
    start = reuse.get(
        "start",
        lambda: place_pieces(scene, shapes, goods.numbers, regions, np.random.default_rng(seed)),
        (scene.piece, scene.portion, scene.inlet, goods.numbers, seed, boxes),
        (shapes,),
    )
    largest = max(shape.bounding_radius for shape in shapes)
    dtype = float_dtype(scene.run.precision)
    fixed, plates, seams = reuse.get(
        "panels",
        lambda: build_panel_arrays(scene, panels, joint, dtype, largest),
        _describe_panels(scene, table, panels, joint, largest),
    )
    inside = start.position[: len(shapes) - waiting]
    return _PlacedScene(
        goods=goods,
        shapes=shapes,
        panels=panels,
        motions=motions,
        blocks=blocks,
        regions=regions,
        plan=plan,
        waiting=waiting,
        start=start,
        fixed=fixed,
        plates=plates,
        seams=seams,
        largest=largest,
        domain=_find_domain(scene, panels, inside, shapes, plan),
    )


def _describe_panels(
    scene: Scene,
    table: MaterialTable,
    panels: Sequence[Panel],
    joint: dict[str, str],
    largest: float,
) -> tuple[Any, ...]:
    """All that ``build_panel_arrays`` depends on, to be compared by value: walls that only move
    otherwise are the same ones.
    """
    materials = find_group_rows(table, scene, list(dict.fromkeys(group for group, _, _ in panels)))
    outlines = [
        (group, np.asarray(corners, float).tobytes(), thickness)
        for group, corners, thickness in panels
    ]
    return outlines, materials.tolist(), joint, scene.contact, scene.run.precision, largest


class _Bodies(NamedTuple):
    """Pieces as a System has them, with the padding of an ensemble.

    shapes, frames, waiting_places: see ``AssembledSystem``. start: with the padding. parts, convex,
    hulls, rows: see ``_build_hulls``. has_hulls: whether any piece is no sphere.
    """

    shapes: list[Shape]
    frames: np.ndarray
    waiting_places: np.ndarray | None
    start: InitialConditions
    parts: Parts
    convex: list[Shape]
    hulls: Hulls | None
    rows: Array
    has_hulls: bool


def _build_bodies(
    scene: Scene,
    placed: _PlacedScene,
    arrays: ParameterArrays,
    room: EnsembleCapacity | None,
    reuse: AssemblyCache,
) -> tuple[_Bodies, ParameterArrays]:
    """The pieces, padded to the capacity of an ensemble, and the arrays with the padding. Raises
    SceneError.
    """
    shapes, lot, start = placed.shapes, None, placed.start
    if room is not None:
        padding = room.pieces - len(shapes)
        lot = find_waiting_places(placed.panels, placed.regions, placed.largest, padding)
        shapes, pieces, start = pad_pieces(scene, placed.goods, start, lot, room, reuse)
        arrays = replace(arrays, pieces=pieces)
    dtype = float_dtype(scene.run.precision)
    parts, convex, hulls, rows = reuse.get(
        "hulls",
        lambda: _build_hulls(shapes, placed.plates, placed.seams, dtype, room),
        (scene.run.precision, room),
        (shapes, placed.plates, placed.seams),
    )
    frames = np.array([shape.principal for shape in shapes])
    has_hulls = any(shape.radius == 0 for shape in shapes)
    if room is not None and room.rounded:
        law, materials = extend_to_class(scene, arrays.law, arrays.materials, has_hulls)
        arrays = replace(arrays, law=law, materials=materials)
    return _Bodies(shapes, frames, lot, start, parts, convex, hulls, rows, has_hulls), arrays


def _build_system(
    scene: Scene,
    placed: _PlacedScene,
    bodies: _Bodies,
    arrays: ParameterArrays,
    step: TimeStep,
    reach: float,
    room: EnsembleCapacity | None,
    slot_block: int,
    reuse: AssemblyCache,
) -> System:
    """The system of pieces and walls. reach: (m) largest distance at which bodies interact. Raises
    SceneError.
    """
    kept, dtype = partial(reuse_array, reuse), float_dtype(scene.run.precision)
    panels, plan, domain = placed.panels, placed.plan, placed.domain
    skin = SKIN_FRACTION * arrays.pieces.width.min() + largest_fillet(arrays.walls, bodies.parts)
    return System(
        parts=bodies.parts,
        hulls=bodies.hulls,
        shape=bodies.rows,
        reach=kept("reach", reach, dtype),
        dt=kept("dt", step.dt, dtype),
        resolved=kept("resolved", step.resolved, dtype),
        substeps=kept("substeps", step.substeps // step.parts, np.int32),
        skin=kept("skin", skin, dtype),
        domain_low=kept("domain_low", domain[0], dtype),
        domain_high=kept("domain_high", domain[1], dtype),
        **_estimate_room(scene, bodies, len(panels), domain),
        has_hulls=bodies.has_hulls,
        alike=find_alike_kinds(placed.goods) if room is None else room.alike,
        present=None
        if room is None
        else kept("present", np.arange(len(bodies.shapes)) < len(placed.shapes), bool),
        escape_stops=scene.run.on_escape == "stop",
        has_rotation=bodies.has_hulls or _turns(arrays),
        may_tie=len(scene.piece) > 1,
        ledger=scene.run.track_energy,
        statistics=build_collision_bins(scene, len(panels), dtype),
        sample_parts=step.parts,
        block_steps=block_steps(scene),
        slot_block=slot_block,
        exchanges=plan is not None,
        runs=1,
        blocks=tuple(b.name for b in placed.blocks),
        quantities=reuse.get(
            "quantities",
            lambda: standard_quantities.select_quantities(
                arrays.walls, scene.statistics is not None, plan is not None
            ),
            (),
            (arrays.walls, plan),
        ),
        **arrays.system_fields(reuse),
    )


def _estimate_room(
    scene: Scene, bodies: _Bodies, panels: int, domain: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """The static sizes of a System: of its tables of contacts and neighbours. panels: number."""
    parts, search = bodies.parts, scene.run.broad_phase
    is_general = bodies.hulls is not None and bodies.hulls.features is not None
    slender = has_slender_pieces(bodies.shapes)
    return {
        "capacity": estimate_capacities(
            len(parts.polytopes),
            len(parts.spheres),
            panels,
            is_general,
            parts.owner is not None,
            slender,
        ),
        "touching": estimate_contacts_per_piece(parts, panels, is_general, slender),
        "neighbours": search,
        "row_capacity": estimate_row_capacity(bodies.convex, search),
        "partition": estimate_partition(bodies.convex, search, domain),
    }


def _turns(arrays: ParameterArrays) -> bool:
    """Whether spheres of these materials may rotate."""
    materials = arrays.materials
    return (
        materials.friction is not None
        or materials.rolling is not None
        or bool(np.any(arrays.start.spin))
    )


def _choose_step(
    scene: Scene,
    law: ContactLaw,
    contacts: list[PossibleContact],
    motions: Sequence[Motion],
    panels: Sequence[Panel],
    pieces: int,
) -> TimeStep:
    """The time step for a number of pieces, including the load cell and the drives. Raises
    SceneError.
    """
    if not contacts:
        raise SceneError(
            f"{scene.name}: a single piece and no wall: nothing can touch; allowed: another piece, or a [[wall]]"
        )
    together = 1 if pieces == len(panels) == 1 else 2
    more = bound_load_cell_frequency(
        scene, law, contacts, pieces
    ) + flap_drive_setup.bound_drive_frequency(motions, panels, law, contacts, pieces)
    return choose_step(scene, law, contacts, together, more)


def _find_run_lengths(scene: Scene, step: TimeStep) -> tuple[int, int, int]:
    """Steps before time zero, number of samples, and samples between stored frames (0: none).
    Raises SceneError.
    """
    settling = count_settling_samples(scene) * step.substeps
    samples = max(1, round(scene.run.duration / scene.run.sample_interval))
    check_steps(scene, settling, samples, step.substeps, step.dt)
    frame_every = (
        min(max(1, round(scene.run.frame_interval / scene.run.sample_interval)), MOST_STEPS)
        if scene.run.frame_interval
        else 0
    )
    return settling, samples, frame_every


def _build_hulls(
    made: Sequence[Shape],
    plates: list[Shape],
    seams: list[PanelSeams] | None,
    dtype: DTypeLike,
    room: EnsembleCapacity | None = None,
) -> tuple[Parts, list[Shape], Hulls | None, Array]:
    """Arrays of the parts of the pieces, their shapes, the hull table of parts and panels (None if
    all parts are spheres), and the table row of each body.
    """
    solids = list_piece_parts(made)
    more = pad_polytopes(solids, room, made) if room else []
    table, rows = build_body_hulls(
        [*solids, more], plates, seams, room is not None and room.rounded
    )
    count = sum(map(len, solids))
    rows = np.concatenate([rows[:count], rows[count + len(more) :]])
    convex = [solid.shape for row in solids for solid in row]
    return (
        cast_tree(build_part_arrays(solids), dtype),
        convex,
        cast_tree(table, dtype) if table else None,
        cast_array(rows, np.int32),
    )


def _reuse_initial_state(
    system: System,
    start: InitialConditions,
    frames: np.ndarray,
    step: int,
    waiting: int,
    reuse: AssemblyCache,
) -> State:
    """The first state; if a system of the same form was assembled before, its state with the new
    step and motion.
    """
    if system.exchanges:  # exchanges are counted from the first step
        return build_initial_state(system, start, frames, step, waiting)
    leaves, structure = jax.tree.flatten(system)
    form = structure, [leaf.shape for leaf in leaves], system.dt.dtype
    state = reuse.get(
        "first state", lambda: build_initial_state(system, start, frames, step, waiting), form
    )
    moved = lambda: jax.tree.map(put_array, build_initial_motion(system, start, frames))
    motion = reuse.get("first motion", moved, (), (start, system.pieces))
    first = reuse.get("first step", lambda: put_array(np.int32(step)), (step,))
    return state.replace(step=first, motion=motion)


def inline_files(scene: Scene) -> Scene:
    """The scene with the STL and CSV files that it names replaced by their contents. Raises
    SceneError.
    """
    whole = inline_buckets(inline_pieces(scene))
    walls = [
        panel
        for n, wall in enumerate(scene.wall)
        for panel in call_with_key(f"wall.{n}", inline_wall_panels, wall, scene.folder)
    ]
    motions = tuple(motion.load_table_rows(row, scene.folder) for row in scene.motion)
    return whole.model_copy(update={"wall": tuple(walls), "motion": motions, "folder": "."})


def inline_pieces(scene: Scene) -> Scene:
    """The scene with the STL files of its pieces replaced by their contents. Raises SceneError."""
    rows = [
        call_with_key(f"piece.{n}", inline_shape_points, row, scene.folder)
        for n, row in enumerate(scene.piece)
    ]
    portion = scene.portion and call_with_key(
        "portion", inline_shape_points, scene.portion, scene.folder
    )
    if portion and portion.product:
        products = [
            call_with_key(f"portion.product.{n}", inline_shape_points, row, scene.folder)
            for n, row in enumerate(portion.product)
        ]
        portion = portion.model_copy(update={"product": tuple(products)})
    return scene.model_copy(update={"piece": tuple(rows), "portion": portion})


def _find_domain(
    scene: Scene,
    panels: Sequence[Panel],
    position: np.ndarray,
    made: Sequence[Shape],
    plan: ExchangePlan | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [3] (m) of the domain. position: [n, 3] (m), of the pieces that are
    present at first.
    """
    points = np.concatenate([position, *[corners for _, corners, _ in panels]])
    margin = 0.1 + 2 * max(m.bounding_radius for m in made)
    low, high = points.min(0) - margin, points.max(0) + margin
    if plan is not None:
        low, high = extend_domain(plan, low, high, scene.run.gravity)
    if scene.run.domain_low is not None:
        low = np.array(scene.run.domain_low)
    if scene.run.domain_high is not None:
        high = np.array(scene.run.domain_high)
    if (low >= high).any():
        raise SceneError(
            f"run.domain_low = {low.tolist()}: allowed: below run.domain_high = {high.tolist()}"
        )
    out = (position < low) | (position > high)
    if out.any():
        k = int(np.argmax(out.any(1)))
        where = f"outside the domain {low.tolist()} to {high.tolist()}"
        raise SceneError(f"piece.{k}.position = {position[k].tolist()}: {where}")
    return low, high


def build_seeded_state(scene: Scene, built: AssembledSystem, seed: int) -> State:
    """The first state of the same scene with another seed, for an assembled system. Raises
    SceneError.
    """
    start = place_pieces(
        scene, built.shapes, built.numbers, built.regions, np.random.default_rng(seed)
    )
    return replace_initial_motion(
        built,
        start
        if built.waiting_places is None
        else pad_initial_conditions(start, built.waiting_places),
    )


def replace_initial_motion(built: AssembledSystem, start: InitialConditions) -> State:
    """The first state with other poses and velocities, which are in numpy."""
    return built.state.replace(motion=build_initial_motion(built.system, start, built.frames))
