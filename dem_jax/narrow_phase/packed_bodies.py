"""Parts of pieces and wall panels in one list of bodies, parts first, so that contacts treat both
alike.

All data that a contact needs of a body are a column of one array, gathered once per side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.math import quaternions, vector
from dem_jax.math.gather import take_columns
from dem_jax.math.vector import Matrix, Vector
from dem_jax.types import Array, State, System
from dem_jax.walls import kinematics


class BodyState(NamedTuple):
    """Bodies of P slots."""

    centre: Vector  # [P] x 3 (m)
    velocity: Vector  # [P] x 3 (m/s), of the centre of the piece
    spin: Vector  # [P] x 3 (rad/s)
    residual: Vector | None  # [P] x 3 (m): low-order part of the centre; None in double precision
    rotation: Matrix | None  # rows of [P]: body frame to world; None where all are spheres
    part_offset: Vector | None  # [P] x 3 (m): from the centre of the piece to that of its part;
    # None where each piece is its only part


def pack_bodies(system: System, state: State, omega: Array, panels: kinematics.WallState) -> Array:
    """All bodies, [rows, M + W]: the rows of ``BodyState`` that any contact of the system needs.
    omega: [3, N] (rad/s).
    """
    pieces, walls = [state.position, state.velocity, omega], [panels.rows[:9]]
    if _has_residual(state.position):
        rest = jnp.zeros_like(panels.rows[:3]) if panels.residual is None else panels.residual
        pieces, walls = [*pieces, state.motion.position_rest], [*walls, rest]
    if system.parts.owner is not None:
        return jnp.concatenate(
            [_pack_parts(system, state, jnp.concatenate(pieces)), _append_arms(panels, walls)],
            axis=1,
        )
    if any(kind != "spheres" for kind, *_ in system.capacity):
        rows = (
            _matrix_rows(state.orientation)
            if system.has_hulls
            else jnp.zeros((9, omega.shape[1]), omega.dtype)
        )
        pieces, walls = [*pieces, rows], [*walls, panels.rows[9:]]
    return jnp.concatenate([jnp.concatenate(pieces), jnp.concatenate(walls)], axis=1)


def _pack_parts(system: System, state: State, pieces: Array) -> Array:
    """Rows of parts from those of their pieces; the centre is that of the part."""
    parts = system.parts
    assert parts.centre is not None  # where parts have owners
    c = pieces[:, parts.owner]
    frame = quaternions.rotation_matrix(tuple(state.orientation[:, parts.owner]))
    arm = jnp.stack(vector.rotate(frame, vector.unstack_vector(parts.centre)))
    centre = c[:3] + arm
    rows = [centre, c[3:9]]
    if _has_residual(pieces):  # rounding residual of the sum
        part = centre - c[:3]
        rows.append(c[9:12] + ((c[:3] - (centre - part)) + (arm - part)))
    return jnp.concatenate([*rows, jnp.stack([x for row in frame for x in row]), arm])


def _append_arms(panels: kinematics.WallState, rows: Sequence[Array]) -> Array:
    return jnp.concatenate([*rows, panels.rows[9:], jnp.zeros_like(panels.rows[:3])])


def _has_residual(stacked: Array) -> bool:
    return stacked.dtype != jnp.float64


def _matrix_rows(orientation: Array) -> Array:
    return jnp.stack([c for row in quaternions.rotation_matrix(tuple(orientation)) for c in row])


def gather_bodies(stacked: Array, index: Array) -> BodyState:
    """Gather the bodies of slots by index [P], row by row: half the time on a CPU, and unused rows
    cost nothing.
    """
    return _make_body_state(stacked, [take_columns(row, index) for row in stacked])


def unpack_bodies(stacked: Array) -> BodyState:
    """All bodies, P = M + W."""
    return _make_body_state(stacked, stacked)


def gather_bodies_at_once(stacked: Array, index: Array) -> BodyState:
    """``gather_bodies`` as a single operation, which compiles faster, for infrequent use."""
    return _make_body_state(stacked, take_columns(stacked, index))


def _make_body_state(stacked: Array, c: Sequence[Array] | Array) -> BodyState:
    three = lambda i: (c[i], c[i + 1], c[i + 2])
    frame = 12 if _has_residual(stacked) else 9
    rest = three(9) if _has_residual(stacked) else None
    turn = (three(frame), three(frame + 3), three(frame + 6)) if len(c) > frame else None
    return BodyState(
        three(0), three(3), three(6), rest, turn, three(frame + 9) if len(c) > frame + 9 else None
    )


def centre_offset(a: BodyState, b: BodyState) -> Vector:
    """Centre of b minus centre of a, [P] x 3 (m), including the rounding residuals of both."""
    offset = vector.sub(b.centre, a.centre)
    return (
        offset
        if a.residual is None or b.residual is None
        else vector.add(offset, vector.sub(b.residual, a.residual))
    )
