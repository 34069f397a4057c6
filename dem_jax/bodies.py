"""Pieces and panels as one list of bodies, pieces first, so that a contact need not know which it has.

Everything a contact needs of a body is a column of one array, gathered once per side.
"""

from typing import NamedTuple

import jax.numpy as jnp

from dem_jax import boundary, rotation, vector
from dem_jax.types import State, System


class Body(NamedTuple):
    """Bodies of P slots."""

    centre: tuple  # [P] x 3 (m)
    rest: tuple  # [P] x 3 (m): low-order part of the centre
    rotation: tuple  # rows of [P]: body frame to world
    velocity: tuple  # [P] x 3 (m/s), of the centre
    spin: tuple  # [P] x 3 (rad/s)


def stack(system: System, state: State, omega, panels: boundary.Panels):
    """All bodies, [21, N + W]: the rows of ``Body`` one below the other. omega: [3, N] (rad/s)."""
    pieces = jnp.concatenate(
        [state.position, state.position_rest, _matrix_rows(state.orientation), state.velocity, omega]
    )
    return jnp.concatenate([pieces, panels.rows], axis=1)


def _matrix_rows(orientation):
    return jnp.stack([c for row in rotation.matrix(tuple(orientation)) for c in row])


def take(stacked, index) -> Body:
    """The bodies of slots, by index [P]."""
    c = stacked.at[:, index].get(mode="promise_in_bounds")
    three = lambda i: (c[i], c[i + 1], c[i + 2])  # noqa: E731
    return Body(three(0), three(3), (three(6), three(9), three(12)), three(15), three(18))


def offset(a: Body, b: Body):
    """Centre of b minus centre of a, [P] x 3 (m), with what rounding left over of both."""
    return vector.add(vector.sub(b.centre, a.centre), vector.sub(b.rest, a.rest))
