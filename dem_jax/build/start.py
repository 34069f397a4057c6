"""Where the pieces begin, and the first state."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dem_jax.build import exchange
from dem_jax.contact import collisions, ledger
from dem_jax.errors import SceneError
from dem_jax.maths import rotation
from dem_jax.pairs import neighbours
from dem_jax.scene import Piece, Scene, arrange
from dem_jax.scene.numbers import array, is_traced, sqrt
from dem_jax.shapes import Shape
from dem_jax.types import CellMotion, DriveMotion, Motion, State, System, WallLoads, host

REBUILD = jax.jit(neighbours.rebuild)  # traced once for all systems of a form
Box = tuple[ArrayLike, ArrayLike]  # lowest and highest corner [3] (m)


@dataclass(frozen=True)
class Start:
    """Poses and velocities of the pieces at the start, in the user's body frames."""

    position: np.ndarray  # [N, 3] (m)
    orientation: np.ndarray  # [N, 4]
    velocity: np.ndarray  # [N, 3] (m/s)
    spin: np.ndarray  # [N, 3] (rad/s), world frame


def placed(
    scene: Scene, made: Sequence[Shape], numbers: tuple[int, ...], regions: Sequence[Box], random: np.random.Generator
) -> Start:
    """Where the pieces begin: as listed, or scattered in the regions, so many in each (Goods.numbers). Pieces that differ
    are mixed at random. Raises SceneError."""
    if scene.piece:
        return listed(scene.piece)
    portion = scene.portion
    assert portion is not None  # as a Scene makes sure
    low, high = portion.region_low, portion.region_high
    if (low is None) != (high is None):
        raise SceneError(f"portion: region_{'low' if low is None else 'high'}: missing; allowed: both corners, or none")
    if (low is None or high is None) and not regions:
        raise SceneError("portion: region_low, region_high: missing; a scene without a feed bucket needs both")
    own = regions[0] if low is None or high is None else (low, high)
    radius = max(m.bounding_radius for m in made)
    boxes = [own, *regions[1:]]
    groups = zip(numbers, boxes, strict=False)
    placed = [arrange.scatter(number, radius, portion.spacing, *box, random) for number, box in groups]
    if portion.product or portion.size_spread > 0 or portion.piece_weight_spread > 0:  # they come by product, in order of size
        placed = [(position[random.permutation(len(position))], turn) for position, turn in placed]
    position, orientation = (np.concatenate(rows) for rows in zip(*placed, strict=True))
    rest = np.zeros_like(position)
    return Start(position, orientation, rest, rest)


def listed(rows: Sequence[Piece]) -> Start:
    """Where pieces begin that are listed one by one. Raises SceneError."""
    q = array([p.orientation for p in rows])
    size = sqrt((q * q).sum(axis=1, keepdims=True))
    if not is_traced(q) and (size < 1e-6).any():
        k = int(np.argmin(size))
        raise SceneError(f"piece.{k}.orientation = {rows[k].orientation}: allowed: a quaternion that is not zero")
    position, velocity, spin = (array([getattr(p, key) for p in rows]) for key in ("position", "velocity", "angular_velocity"))
    return Start(position, q / size, velocity, spin)


def settling_samples(scene: Scene) -> int:
    """Sample intervals before time zero."""
    if scene.piece or scene.portion is None or scene.portion.arrangement == "scattered":
        return 0
    return max(1, round(scene.portion.settling_time / scene.run.sample))


def motion_of_start(system: System, start: Start, frames: np.ndarray) -> Motion:
    """Poses and velocities in the user's body frames as those of principal frames, in numpy; frames: Built.frames."""
    dtype = system.dt.dtype
    position = start.position.T
    high = position.astype(dtype)
    q = array(list(rotation.multiply(tuple(start.orientation.T), tuple(np.asarray(frames).T))))
    turn = q.astype(dtype)
    inertia = system.pieces.inertia
    inertia = inertia if isinstance(inertia, jax.core.Tracer) else host(np.asarray(inertia))
    momentum = rotation.angular_momentum(tuple(turn), tuple(start.spin.T.astype(dtype)), tuple(inertia))
    none = np.zeros(high.shape, dtype)
    return Motion(
        position=host(high),
        position_rest=host((position - high.astype(position.dtype)).astype(dtype)),
        orientation=host(turn),
        orientation_rest=host((q - turn.astype(q.dtype)).astype(dtype)),
        velocity=host(start.velocity.T.astype(dtype)),
        velocity_rest=host(none),
        angular_momentum=host(array(list(momentum)).astype(dtype)),
        force=host(none),
        torque=host(none),
    )


def first_state(system: System, start: Start, frames: np.ndarray, step: int, waiting: int = 0) -> State:
    """The state at a step, without any contact; start, frames: as of ``motion_of_start``; waiting: last pieces, outside."""
    dtype, n = system.dt.dtype, len(start.position)
    groups, runs = len(system.walls.groups), system.runs
    columns = 2 * sum(room for *_, room in system.capacity)  # of loads
    empty: Any = None  # until it is known what a rebuild fills
    cell = None
    if system.walls.load_cell is not None:
        cell = CellMotion(host(np.zeros((runs,), dtype)), host(np.zeros((runs,), dtype)))
    drive = None
    if system.walls.drive is not None:
        drive = DriveMotion(host(np.zeros((groups, runs), dtype)), host(np.zeros((groups, runs), dtype)))
    state = State(
        step=host(np.int32(step)),
        motion=motion_of_start(system, start, frames),
        walls=WallLoads(host(np.zeros((3, groups, runs), dtype)), host(np.zeros((3, groups, runs), dtype))),
        cell=cell,
        drive=drive,
        collisions=collisions.none_yet(system, dtype),
        exchange=exchange.at_first(system, waiting, step, dtype) if system.exchanges else None,
        contacts=neighbours.no_contacts(system),
        incidence=host(np.full((system.touching, n), columns, np.int32)),
        ledger=ledger.empty_ledger(system, dtype),
        guard=neighbours.empty_guard(system, dtype),
        scratch=empty,
    )
    form = REBUILD.eval_shape(system, state).scratch
    scratch = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), form)
    return jax.tree.map(jnp.asarray, state.replace(scratch=scratch))  # in numpy: each operation of jax.numpy would be compiled
