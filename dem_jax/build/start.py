"""Where the pieces begin, and the first state."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dem_jax.contact import forces
from dem_jax.errors import SceneError
from dem_jax.maths import rotation
from dem_jax.pairs import neighbours
from dem_jax.scene import Scene, arrange
from dem_jax.shapes import Shape
from dem_jax.types import State, System

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
        rows = scene.piece
        q = np.array([p.orientation for p in rows], float)
        size = np.linalg.norm(q, axis=1, keepdims=True)
        if (size < 1e-6).any():
            k = int(np.argmin(size))
            raise SceneError(f"piece.{k}.orientation = {rows[k].orientation}: allowed: a quaternion that is not zero")
        return Start(
            np.array([p.position for p in rows], float),
            q / size,
            np.array([p.velocity for p in rows], float),
            np.array([p.angular_velocity for p in rows], float),
        )
    portion = scene.portion
    assert portion is not None  # as a Scene makes sure
    low, high = portion.region_low, portion.region_high
    if (low is None or high is None) and not regions:
        raise SceneError("portion: region_low, region_high: missing; a scene without a feed bucket needs both")
    own = regions[0] if low is None or high is None else (low, high)
    radius = max(m.bounding_radius for m in made)
    boxes = [own, *regions[1:]]
    groups = zip(numbers, boxes, strict=False)
    placed = [arrange.scatter(number, radius, portion.spacing, *box, random) for number, box in groups]
    if portion.product or portion.size_spread > 0:  # they come one product after the other, in order of size
        placed = [(position[random.permutation(len(position))], turn) for position, turn in placed]
    position, orientation = (np.concatenate(rows) for rows in zip(*placed, strict=True))
    rest = np.zeros_like(position)
    return Start(position, orientation, rest, rest)


def settling_samples(scene: Scene) -> int:
    """Sample intervals before time zero."""
    if scene.piece or scene.portion is None or scene.portion.arrangement == "scattered":
        return 0
    return max(1, round(scene.portion.settling_time / scene.run.sample))


def motion_of_start(system: System, start: Start, frames: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of State that follow from poses and velocities in the user's body frames, in numpy; frames: Built.frames."""
    dtype = system.dt.dtype
    position = start.position.T.astype(np.float64)
    high = position.astype(dtype)
    q = np.stack(rotation.multiply(tuple(start.orientation.T), tuple(np.asarray(frames).T))).astype(dtype)
    inertia = np.asarray(system.pieces.inertia)
    momentum = rotation.angular_momentum(tuple(q), tuple(start.spin.T.astype(dtype)), tuple(inertia))
    return {
        "position": high,
        "position_rest": (position - high).astype(dtype),
        "orientation": q,
        "velocity": start.velocity.T.astype(dtype),
        "angular_momentum": np.stack(momentum),
    }


def first_state(system: System, start: Start, frames: np.ndarray, step: int) -> State:
    """The state at a step, without any contact; start, frames: as of ``motion_of_start``."""
    dtype = system.dt.dtype
    groups = len(system.walls.groups)
    zero = lambda *shape: np.zeros(shape, dtype)  # noqa: E731
    n = len(start.position)
    contacts = {
        kind: neighbours.empty_table(slots, dtype) for kind, _, slots in system.capacity
    }
    columns = 2 * sum(slots for *_, slots in system.capacity)  # of loads
    state = State(
        **motion_of_start(system, start, frames),
        step=np.int32(step),
        velocity_rest=zero(3, n),
        force=zero(3, n),
        torque=zero(3, n),
        wall_force=zero(3, groups),
        wall_torque=zero(3, groups),
        contacts=contacts,
        slots=_unfilled_slots(system, contacts),
        filled={kind: np.int32(0) for kind in contacts},
        busiest=np.int32(0),
        walled=None,
        most_walled=None,
        incidence=np.full((system.touching, n), columns, np.int32),
        loads=zero(6, columns + 1),
        ledger=forces.empty_ledger(system, dtype),
        anchor=zero(7, n),
        since=np.int32(step),
        lead=zero(),
        guard=neighbours.empty_guard(system, dtype),
    )
    return jax.tree.map(jnp.asarray, state)  # made in numpy: each operation of jax.numpy would be compiled


def _unfilled_slots(system: System, contacts: dict) -> dict:
    """Slots of the right form, which the first rebuild fills."""
    find = lambda: {k: neighbours.constants(system, k, jnp.asarray(t.a), jnp.asarray(t.b)) for k, t in contacts.items()}  # noqa: E731
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(find))
