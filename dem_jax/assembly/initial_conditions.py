"""Initial conditions of the pieces, and the first state."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from dem_jax import program_store
from dem_jax.assembly import exchange_plan
from dem_jax.assembly.dtype_cast import put_array
from dem_jax.broad_phase import neighbour_list
from dem_jax.contacts import collision_statistics, ledger
from dem_jax.errors import SceneError
from dem_jax.math import quaternions
from dem_jax.scene import Piece, Scene, placement
from dem_jax.scene.array_namespace import as_float_array, is_traced, sqrt
from dem_jax.shapes import Shape, box_corners
from dem_jax.types import (
    FlapDriveMotion,
    LoadCellMotion,
    PieceMotion,
    State,
    System,
    WallLoads,
    as_array,
)

Box = tuple[ArrayLike, ArrayLike]  # lowest and highest corner [3] (m)


@dataclass(frozen=True)
class InitialConditions:
    """Initial poses and velocities of the pieces, in the user's body frames."""

    position: np.ndarray  # [N, 3] (m)
    orientation: np.ndarray  # [N, 4]
    velocity: np.ndarray  # [N, 3] (m/s)
    spin: np.ndarray  # [N, 3] (rad/s), world frame


def place_pieces(
    scene: Scene,
    made: Sequence[Shape],
    numbers: tuple[int, ...],
    regions: Sequence[Box],
    random: np.random.Generator,
) -> InitialConditions:
    """Initial conditions of the pieces: as listed, or scattered in the regions, ``numbers[k]`` in
    region k (``PieceSet.numbers``). Pieces that differ are shuffled. Raises SceneError.
    """
    if scene.piece:
        return read_listed_pieces(scene.piece)
    portion = scene.portion
    assert portion is not None  # as a Scene makes sure
    low, high = portion.region_low, portion.region_high
    if (low is None) != (high is None):
        raise SceneError(
            f"portion: region_{'low' if low is None else 'high'}: missing; allowed: both corners, or none"
        )
    if (low is None or high is None) and not regions:
        raise SceneError(
            "portion: region_low, region_high: missing; a scene without a feed bucket needs both"
        )
    own = regions[0] if low is None or high is None else (low, high)
    radius = max(m.bounding_radius for m in made)
    is_mixed = portion.product or portion.size_spread > 0 or portion.piece_weight_spread > 0
    placed: list[tuple[np.ndarray, np.ndarray]] = []
    on_grid, first = [], 0
    for number, box in zip(numbers, [own, *regions[1:]], strict=False):
        group, first = made[first : first + number], first + number
        start = None
        if portion.arrangement == "settled":
            start = _stack_pieces(group, radius, portion.spacing, box, random)
        if start is None:
            on_grid.append(len(placed))
            start = placement.scatter_pieces(number, radius, portion.spacing, *box, random)
        placed.append(start)
    for k in on_grid if is_mixed else ():  # pieces are ordered by product and size
        position, turn = placed[k]
        placed[k] = position[random.permutation(len(position))], turn
    position, orientation = (np.concatenate(rows) for rows in zip(*placed, strict=True))
    rest = np.zeros_like(position)
    return InitialConditions(position, orientation, rest, rest)


def _stack_pieces(
    made: Sequence[Shape], radius: float, spacing: float, box: Box, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions and orientations of pieces as ``placement.stack_pieces`` has them; None where a grid
    is low enough, or lower than the stack, as of balls. radius, spacing: of the grid.
    """
    height = placement.find_grid_height(len(made), radius, spacing, *box)
    if height <= placement.TALLEST_GRID or len(made) > placement.MOST_STACKED:
        return None
    tries = (len(made), placement.STACK_TRIES)
    turn = placement.draw_orientations(tries[0] * tries[1], random).reshape(*tries, 4)
    corners = np.stack([box_corners(shape, q) for shape, q in zip(made, turn, strict=True)])
    gap = 2 * (spacing - 1) * radius
    position, chosen = placement.stack_pieces(corners, gap, *box, random)
    if np.max(position[:, 2]) - np.asarray(box[0])[2] > height:
        return None
    return position, turn[np.arange(len(made)), chosen]


def read_listed_pieces(rows: Sequence[Piece]) -> InitialConditions:
    """Initial conditions of pieces that are listed one by one. Raises SceneError."""
    q = as_float_array([p.orientation for p in rows])
    size = sqrt((q * q).sum(axis=1, keepdims=True))
    if not is_traced(q) and (size < 1e-6).any():
        k = int(np.argmin(size))
        raise SceneError(
            f"piece.{k}.orientation = {rows[k].orientation}: allowed: a quaternion that is not zero"
        )
    position, velocity, spin = (
        as_float_array([getattr(p, key) for p in rows])
        for key in ("position", "velocity", "angular_velocity")
    )
    return InitialConditions(position, q / size, velocity, spin)


def count_settling_samples(scene: Scene) -> int:
    """Number of sample intervals before time zero."""
    if scene.piece or scene.portion is None or scene.portion.arrangement == "scattered":
        return 0
    return max(1, round(scene.portion.settling_time / scene.run.sample_interval))


def build_initial_motion(
    system: System, start: InitialConditions, frames: np.ndarray
) -> PieceMotion:
    """Convert poses and velocities from the user's body frames to principal frames, in numpy;
    frames: ``AssembledSystem.frames``.
    """
    dtype = system.dt.dtype
    position = start.position.T
    high = position.astype(dtype)
    q = as_float_array(
        list(quaternions.hamilton_product(tuple(start.orientation.T), tuple(np.asarray(frames).T)))
    )
    turn = q.astype(dtype)
    inertia = system.pieces.inertia
    inertia = inertia if isinstance(inertia, jax.core.Tracer) else as_array(np.asarray(inertia))
    momentum = quaternions.angular_momentum(
        tuple(turn), tuple(start.spin.T.astype(dtype)), tuple(inertia)
    )
    none = np.zeros(high.shape, dtype)
    return PieceMotion(
        position=as_array(high),
        position_rest=as_array((position - high.astype(position.dtype)).astype(dtype)),
        orientation=as_array(turn),
        orientation_rest=as_array((q - turn.astype(q.dtype)).astype(dtype)),
        velocity=as_array(start.velocity.T.astype(dtype)),
        velocity_rest=as_array(none),
        angular_momentum=as_array(as_float_array(list(momentum)).astype(dtype)),
        force=as_array(none),
        torque=as_array(none),
    )


def build_initial_state(
    system: System, start: InitialConditions, frames: np.ndarray, step: int, waiting: int = 0
) -> State:
    """The state at a step, without contacts. start, frames: see ``build_initial_motion``; waiting:
    number of last pieces that are outside the scene.
    """
    dtype, n = system.dt.dtype, len(start.position)
    groups, runs = len(system.walls.groups), system.runs
    columns = 2 * sum(room for *_, room in system.capacity)  # of loads
    empty: Any = None  # until the shapes of the arrays of a rebuild are known
    cell = None
    if system.walls.load_cell is not None:
        cell = LoadCellMotion(
            as_array(np.zeros((runs,), dtype)), as_array(np.zeros((runs,), dtype))
        )
    drive = None
    if system.walls.drive is not None:
        drive = FlapDriveMotion(
            as_array(np.zeros((groups, runs), dtype)), as_array(np.zeros((groups, runs), dtype))
        )
    state = State(
        step=as_array(np.int32(step)),
        motion=build_initial_motion(system, start, frames),
        walls=WallLoads(
            as_array(np.zeros((3, groups, runs), dtype)),
            as_array(np.zeros((3, groups, runs), dtype)),
        ),
        cell=cell,
        drive=drive,
        collisions=collision_statistics.init_collisions(system, dtype),
        exchange=exchange_plan.init_exchange(system, waiting, step, dtype)
        if system.exchanges
        else None,
        contacts=neighbour_list.init_contact_tables(system),
        incidence=as_array(np.full((system.touching, n), columns, np.int32)),
        ledger=ledger.empty_ledger(system, dtype),
        guard=neighbour_list.empty_overflow_report(system, dtype),
        scratch=empty,
    )
    form = program_store.recall(
        "scratch",
        (system.replace(quantities=()), state),
        lambda: jax.eval_shape(neighbour_list.rebuild_neighbour_list, system, state).scratch,
    )
    scratch = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), form)
    return jax.tree.map(put_array, state.replace(scratch=scratch))  # in numpy: each operation of
    # jax.numpy would be compiled
