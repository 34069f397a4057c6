"""Parts of pieces and panels of walls as one list of bodies, parts first, so that a contact need not know which it has.

Everything a contact needs of a body is a column of one array, gathered once per side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.contact import boundary
from dem_jax.maths import rotation, vector
from dem_jax.maths.table import columns
from dem_jax.maths.vector import Matrix, Vector
from dem_jax.types import Array, State, System


class Body(NamedTuple):
    """Bodies of P slots."""

    centre: Vector  # [P] x 3 (m)
    velocity: Vector  # [P] x 3 (m/s), of the centre of the piece
    spin: Vector  # [P] x 3 (rad/s)
    rest: Vector | None  # [P] x 3 (m): low-order part of the centre; None in double precision
    rotation: Matrix | None  # rows of [P]: body frame to world; None where all are spheres
    arm: Vector | None  # [P] x 3 (m): from the centre of the piece to that of its part; None where each piece is its only part


def stack(system: System, state: State, omega: Array, panels: boundary.Panels) -> Array:
    """All bodies, [rows, M + W]: of ``Body``, one below the other, what any contact of the system needs. omega: [3, N]
    (rad/s)."""
    pieces, walls = [state.position, state.velocity, omega], [panels.rows[:9]]
    if _has_rest(state.position):
        rest = jnp.zeros_like(panels.rows[:3]) if panels.rest is None else panels.rest
        pieces, walls = [*pieces, state.motion.position_rest], [*walls, rest]
    if system.parts.owner is not None:
        return jnp.concatenate([_of_parts(system, state, jnp.concatenate(pieces)), _with_arms(panels, walls)], axis=1)
    if any(kind != "spheres" for kind, *_ in system.capacity):
        rows = _matrix_rows(state.orientation) if system.has_hulls else jnp.zeros((9, omega.shape[1]), omega.dtype)
        pieces, walls = [*pieces, rows], [*walls, panels.rows[9:]]
    return jnp.concatenate([jnp.concatenate(pieces), jnp.concatenate(walls)], axis=1)


def _of_parts(system: System, state: State, pieces: Array) -> Array:
    """The rows of parts, from those of their pieces: the centre is that of the part."""
    parts = system.parts
    assert parts.centre is not None  # where parts have owners
    c = pieces[:, parts.owner]
    frame = rotation.matrix(tuple(state.orientation[:, parts.owner]))
    arm = jnp.stack(vector.rotate(frame, vector.unpack(parts.centre)))
    centre = c[:3] + arm
    rows = [centre, c[3:9]]
    if _has_rest(pieces):  # rounding residual of the sum
        part = centre - c[:3]
        rows.append(c[9:12] + ((c[:3] - (centre - part)) + (arm - part)))
    return jnp.concatenate([*rows, jnp.stack([x for row in frame for x in row]), arm])


def _with_arms(panels: boundary.Panels, rows: Sequence[Array]) -> Array:
    return jnp.concatenate([*rows, panels.rows[9:], jnp.zeros_like(panels.rows[:3])])


def _has_rest(stacked: Array) -> bool:
    return stacked.dtype != jnp.float64


def _matrix_rows(orientation: Array) -> Array:
    return jnp.stack([c for row in rotation.matrix(tuple(orientation)) for c in row])


def take(stacked: Array, index: Array) -> Body:
    """Gather the bodies of slots by index [P], row by row: half the time on a CPU, and unused rows cost nothing."""
    return _body(stacked, [columns(row, index) for row in stacked])


def every(stacked: Array) -> Body:
    """All bodies, P = M + W."""
    return _body(stacked, stacked)


def take_at_once(stacked: Array, index: Array) -> Body:
    """``take`` as a single operation, which compiles faster, for infrequent use."""
    return _body(stacked, columns(stacked, index))


def _body(stacked: Array, c: Sequence[Array] | Array) -> Body:
    three = lambda i: (c[i], c[i + 1], c[i + 2])  # noqa: E731
    frame = 12 if _has_rest(stacked) else 9
    rest = three(9) if _has_rest(stacked) else None
    turn = (three(frame), three(frame + 3), three(frame + 6)) if len(c) > frame else None
    return Body(three(0), three(3), three(6), rest, turn, three(frame + 9) if len(c) > frame + 9 else None)


def offset(a: Body, b: Body) -> Vector:
    """Centre of b minus centre of a, [P] x 3 (m), including the rounding residuals of both."""
    offset = vector.sub(b.centre, a.centre)
    return offset if a.rest is None or b.rest is None else vector.add(offset, vector.sub(b.rest, a.rest))
