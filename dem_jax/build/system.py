"""From a scene to a system and its first state: shapes to tables, materials to stiffness, walls to panels, slots."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.build import drive
from dem_jax.build.arrays import Layout, ParameterArrays, find_arrays
from dem_jax.build.exchange import Plan, boxes_of, domain_with, find_lot, plan_of
from dem_jax.build.finite import MOST_STEPS, check_finite, check_steps
from dem_jax.build.load_cell import added_rate
from dem_jax.build.parts import hull_table, part_arrays, solids_of
from dem_jax.build.pieces import Goods, alike, kept_goods, named, with_points
from dem_jax.build.reuse import Reuse
from dem_jax.build.room import capacity, partition, row_capacity, touching
from dem_jax.build.room_of_ensemble import Room, fill_room, pad_solids, pad_start
from dem_jax.build.sampling import shortest_contact
from dem_jax.build.start import Box, Start, first_state, motion_of_start, placed, settling_samples
from dem_jax.build.statistics import statistics_of
from dem_jax.build.surfaces import PanelSeams
from dem_jax.build.time_step import PossibleContact, TimeStep, block_steps, choose_step, longest_reach, possible_contacts
from dem_jax.build.typed import array, kept_array, typed
from dem_jax.build.walls import panel_arrays, walls_of, with_buckets_read, written_out
from dem_jax.contact import motion
from dem_jax.contact.law import ContactLaw
from dem_jax.contact.smooth_surfaces import largest_fillet
from dem_jax.errors import SceneError
from dem_jax.scene import Motion, Scene
from dem_jax.scene.buckets import Panel
from dem_jax.scene.materials import material_table
from dem_jax.shapes import Shape
from dem_jax.step import quantities
from dem_jax.types import Array, Hulls, Parts, State, System, float_dtype

PLACES = ("weigh_bucket", "feed_bucket", "feeder", "drop", "cycle")  # sections of a scene that walls are made of
SKIN = 0.03  # of the width of the narrowest piece: see pairs.neighbours


@dataclass(frozen=True)
class Built:
    """A system with its first state, and what a host needs beside them."""

    system: System
    state: State
    step: TimeStep
    shortest: float  # s: how long the shortest contact that it can have lasts, about
    shapes: tuple[Shape, ...]  # of each piece, scaled, body frame of the user
    frames: np.ndarray  # [N, 4]: principal frame to body frame, of each piece
    settling_steps: int  # steps before time zero
    samples: int  # to be run
    frame_every: int  # samples between stored frames; 0: none
    regions: list[Box]  # in which pieces are scattered: of the feed bucket, of the feeder, and where those of an inlet wait
    numbers: tuple[int, ...]  # pieces in each of these boxes; () of pieces listed one by one
    goods: Goods  # the pieces before they are anywhere, without those that only fill up the room of an ensemble
    exchange: Plan | None  # how pieces come in and leave
    lot: np.ndarray | None  # [n, 3] (m): where pieces are outside that fill up the room of an ensemble; None: it needs none
    layout: Layout
    start: Start  # of the pieces that are not of the lot


def build(
    scene: Scene, seed: int = 0, law: ContactLaw | None = None, reuse: Reuse | None = None, room: Room | None = None
) -> Built:
    """Everything that a run of the scene needs. law: instead of the scene's; reuse: of scenes that were built before; room: of
    an ensemble whose runs have different numbers of pieces. Raises SceneError."""
    reuse = reuse or Reuse()
    dtype = float_dtype(scene.run.precision)
    table = material_table(scene)
    of_walls = (scene.wall, scene.motion, scene.block, *(getattr(scene, name) for name in PLACES), scene.folder)
    goods = kept_goods(scene, table, reuse)
    own = reuse.get("made", lambda: list(goods.shapes), (), goods.shapes)  # not anew where only weights differ
    laid = reuse.get("walls", lambda: walls_of(scene), of_walls)
    panels, motions, joint, blocks, regions = laid
    plan, waiting = plan_of(scene, panels, regions, own), goods.numbers[-1] if scene.inlet else 0
    regions = boxes_of(scene, panels, regions, goods.numbers, own)
    where = (scene.piece, scene.portion, scene.inlet, goods.numbers, seed)
    start = reuse.get(
        "start", lambda: placed(scene, own, goods.numbers, regions, np.random.default_rng(seed)), where, (own, laid)
    )
    largest = max(shape.bounding_radius for shape in own)
    inputs = (table.names, table.is_wall.tolist(), scene.contact, scene.run.precision, largest)
    fixed, plates, seams = reuse.get("panels", lambda: panel_arrays(scene, panels, joint, dtype, largest), inputs, (laid,))
    layout = Layout(goods, fixed, tuple(blocks), scene.drop.height, law)
    arrays = find_arrays(scene, layout, motions, start, table, reuse=reuse)
    pieces, walls, law = arrays.pieces, arrays.walls, arrays.law
    contacts = possible_contacts(law, arrays.materials, own, pieces, reuse)
    step = _choose_step(scene, law, contacts, motions, panels, len(own))
    settling, samples, frame_every = _find_lengths(scene, step)
    domain = _domain(scene, panels, start.position[: len(own) - waiting], own, plan)
    made, lot, filled = own, None, start
    if room is not None:
        lot = find_lot(panels, regions, largest, room.pieces - len(own))
        made, pieces, filled = fill_room(scene, goods, start, lot, room, reuse)
        arrays = replace(arrays, pieces=pieces)
    parts, convex, hulls, shape_rows = reuse.get(
        "hulls", lambda: _hulls_of(made, plates, seams, dtype, room), (scene.run.precision, room), (made, plates, seams)
    )
    has_hulls = any(shape.radius == 0 for shape in made)
    is_general = hulls is not None and hulls.features is not None
    kept = partial(kept_array, reuse)
    system = System(
        parts=parts,
        hulls=hulls,
        shape=shape_rows,
        reach=kept("reach", longest_reach(law, contacts), dtype),
        dt=kept("dt", step.dt, dtype),
        resolved=kept("resolved", step.resolved, dtype),
        substeps=kept("substeps", step.substeps // step.parts, np.int32),
        skin=kept("skin", SKIN * pieces.width.min() + largest_fillet(walls, parts), dtype),
        domain_low=kept("domain_low", domain[0], dtype),
        domain_high=kept("domain_high", domain[1], dtype),
        capacity=capacity(len(parts.polytopes), len(parts.spheres), len(panels), is_general, parts.owner is not None),
        touching=touching(parts, len(panels), is_general),
        neighbours=scene.run.neighbours,
        row_capacity=row_capacity(convex, scene.run.neighbours),
        partition=partition(convex, scene.run.neighbours, domain),
        has_hulls=has_hulls,
        alike=alike(goods),
        present=None if room is None else kept("present", np.arange(len(made)) < len(own), bool),
        escape_stops=scene.run.escape == "stop",
        has_rotation=has_hulls or _turns(arrays),
        may_tie=len(scene.piece) > 1,
        ledger=scene.run.energy,
        statistics=statistics_of(scene, len(panels), dtype),
        sample_parts=step.parts,
        block_steps=block_steps(scene),
        slot_block=0,
        exchanges=plan is not None,
        runs=1,
        blocks=tuple(b.name for b in blocks),
        quantities=reuse.get(
            "quantities", lambda: quantities.sampled(walls, scene.statistics is not None, plan is not None), (), (walls, plan)
        ),
        **arrays.system_fields(reuse),
    )
    frames = np.array([m.principal for m in made])
    state = _first_state(system, filled, frames, -settling, waiting, reuse)
    check_finite(scene, system, state, reuse)
    return Built(
        system, state, step, shortest_contact(law, contacts), tuple(made), frames, settling, samples, frame_every,
        regions, goods.numbers, goods, plan, lot, layout, start,
    )  # fmt: skip


def _turns(arrays: ParameterArrays) -> bool:
    """Whether spheres of these materials may turn."""
    materials = arrays.materials
    return materials.friction is not None or materials.rolling is not None or bool(np.any(arrays.start.spin))


def _choose_step(
    scene: Scene,
    law: ContactLaw,
    contacts: list[PossibleContact],
    motions: Sequence[Motion],
    panels: Sequence[Panel],
    pieces: int,
) -> TimeStep:
    """The time step for a number of pieces, and all else that swings. Raises SceneError."""
    if not contacts:
        raise SceneError(f"{scene.name}: a single piece and no wall: nothing can touch; allowed: another piece, or a [[wall]]")
    together = 1 if pieces == len(panels) == 1 else 2
    more = added_rate(scene, law, contacts, pieces) + drive.added_rate(motions, panels, law, contacts, pieces)
    return choose_step(scene, law, contacts, together, more)


def _find_lengths(scene: Scene, step: TimeStep) -> tuple[int, int, int]:
    """Steps before time zero, samples to be run, and samples between stored frames (0: none). Raises SceneError."""
    settling = settling_samples(scene) * step.substeps
    samples = max(1, round(scene.run.duration / scene.run.sample))
    check_steps(scene, settling, samples, step.substeps, step.dt)
    frame_every = min(max(1, round(scene.run.frames / scene.run.sample)), MOST_STEPS) if scene.run.frames else 0
    return settling, samples, frame_every


def _hulls_of(
    made: Sequence[Shape], plates: list[Shape], seams: list[PanelSeams] | None, dtype: DTypeLike, room: Room | None = None
) -> tuple[Parts, list[Shape], Hulls | None, Array]:
    """Arrays of the parts of the pieces, their shapes, the table of hulls of parts and panels (None: all are spheres), and the row
    of each in it."""
    solids = solids_of(made)
    more = pad_solids(solids, room, made) if room else []
    table, rows = hull_table([*solids, more], plates, seams)
    count = sum(map(len, solids))
    rows = np.concatenate([rows[:count], rows[count + len(more) :]])
    convex = [solid.shape for row in solids for solid in row]
    return typed(part_arrays(solids), dtype), convex, typed(table, dtype) if table else None, array(rows, np.int32)


def _first_state(system: System, start: Start, frames: np.ndarray, step: int, waiting: int, reuse: Reuse) -> State:
    """The first state; where one of a system of the same form was made, that with this one's own step and motion."""
    if system.exchanges:  # which count from the first step
        return first_state(system, start, frames, step, waiting)
    leaves, structure = jax.tree.flatten(system)
    form = structure, [leaf.shape for leaf in leaves], system.dt.dtype
    state = reuse.get("first state", lambda: first_state(system, start, frames, step, waiting), form)
    moved = lambda: jax.tree.map(jnp.asarray, motion_of_start(system, start, frames))  # noqa: E731
    motion = reuse.get("first motion", moved, (), (start, system.pieces))
    return state.replace(step=jnp.asarray(np.int32(step)), motion=motion)


def self_contained(scene: Scene) -> Scene:
    """The scene with the contents of the STL and CSV files that it names in their place. Raises SceneError."""
    whole = with_buckets_read(with_pieces_read(scene))
    walls = [panel for n, wall in enumerate(scene.wall) for panel in named(f"wall.{n}", written_out, wall, scene.folder)]
    motions = tuple(motion.written_out(row, scene.folder) for row in scene.motion)
    return whole.model_copy(update={"wall": tuple(walls), "motion": motions, "folder": "."})


def with_pieces_read(scene: Scene) -> Scene:
    """The scene with the contents of the STL files of its pieces in their place. Raises SceneError."""
    rows = [named(f"piece.{n}", with_points, row, scene.folder) for n, row in enumerate(scene.piece)]
    portion = scene.portion and named("portion", with_points, scene.portion, scene.folder)
    if portion and portion.product:
        products = [named(f"portion.product.{n}", with_points, row, scene.folder) for n, row in enumerate(portion.product)]
        portion = portion.model_copy(update={"product": tuple(products)})
    return scene.model_copy(update={"piece": tuple(rows), "portion": portion})


def _domain(
    scene: Scene, panels: Sequence[Panel], position: np.ndarray, made: Sequence[Shape], plan: Plan | None
) -> tuple[np.ndarray, np.ndarray]:
    """position: [n, 3] (m), of the pieces that are there at first."""
    points = np.concatenate([position, *[corners for _, corners, _ in panels]])
    margin = 0.1 + 2 * max(m.bounding_radius for m in made)
    low, high = points.min(0) - margin, points.max(0) + margin
    if plan is not None:
        low, high = domain_with(plan, low, high, scene.run.gravity)
    if scene.run.domain_low is not None:
        low = np.array(scene.run.domain_low)
    if scene.run.domain_high is not None:
        high = np.array(scene.run.domain_high)
    if (low >= high).any():
        raise SceneError(f"run.domain_low = {low.tolist()}: allowed: below run.domain_high = {high.tolist()}")
    out = (position < low) | (position > high)
    if out.any():
        k = int(np.argmax(out.any(1)))
        where = f"outside the domain {low.tolist()} to {high.tolist()}"
        raise SceneError(f"piece.{k}.position = {position[k].tolist()}: {where}")
    return low, high


def state_of_seed(scene: Scene, built: Built, seed: int) -> State:
    """The first state of the same scene with another seed, for the system that was built. Raises SceneError."""
    start = placed(scene, built.shapes, built.numbers, built.regions, np.random.default_rng(seed))
    return started(built, start if built.lot is None else pad_start(start, built.lot))


def started(built: Built, start: Start) -> State:
    """The first state with other poses and velocities, those in numpy."""
    return built.state.replace(motion=motion_of_start(built.system, start, built.frames))
