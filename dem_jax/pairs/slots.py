"""What stays the same in a slot between two rebuilds: shapes of its two bodies, and what the contact law makes of them."""

import jax.numpy as jnp

from dem_jax.contact import hulls
from dem_jax.contact.law import Couple
from dem_jax.contact.law.springs import series
from dem_jax.contact.materials import couple
from dem_jax.maths.compaction import EMPTY
from dem_jax.types import Array, Slots, System


def constants(system: System, kind: str, a: Array, b: Array) -> Slots:
    """Slots of the pairs (a, b) [P] of a kind; a is EMPTY where there is none."""
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    of = _between_spheres if kind == "spheres" else _with_polytopes
    return of(system, kind, live, a, b)


def _with_polytopes(system: System, kind, live, a, b) -> Slots:
    pieces = system.pieces
    number = pieces.mass.shape[0]
    wall, own, panel = a >= number, jnp.minimum(a, number - 1), jnp.maximum(a - number, 0)
    return Slots(
        live=live,
        a=a,
        b=b,
        hull_a=hulls.gather(system.hulls, system.shape[a], kind == "mixed"),
        hull_b=_hull_of_piece(system, b) if kind == "hulls" else None,
        radius_a=pieces.radius[own],
        radius_b=pieces.radius[b],
        width=jnp.where(wall, pieces.width[b], jnp.minimum(pieces.width[own], pieces.width[b])),
        plane=None if system.walls.plane is None else jnp.where(wall & live, system.walls.plane[panel], EMPTY),
        pair=system.law.pair(_couple(system, wall, own, panel, b)),
    )


def _couple(system: System, wall, own, panel, b) -> Couple:
    """The couples of pieces b and, as ``wall`` says, panels or pieces ``own``."""
    pieces, walls = system.pieces, system.walls
    material, curvature = pieces.material[own], pieces.curvature[own]
    if walls.material.shape[0]:
        material = jnp.where(wall, walls.material[panel], material)
    size = jnp.where(wall, pieces.size[b], pieces.size[own])
    mass = jnp.where(wall, pieces.mass[b], series(pieces.mass[own], pieces.mass[b]))
    curvature = jnp.where(wall, 0, curvature)
    materials = material, pieces.material[b]
    return couple(system.materials, materials, (size, pieces.size[b]), (curvature, pieces.curvature[b]), mass)


def _between_spheres(system: System, _, live, a, b) -> Slots:
    """Slots of pairs of spheres. Where all are alike one value of each constant broadcasts, which saves reading it."""
    pieces = system.pieces
    first, second = (pieces.spheres[:1],) * 2 if "spheres" in system.alike else (a, b)
    of = lambda rows: (rows[first], rows[second])  # noqa: E731
    mass = series(*of(pieces.mass))
    pair = couple(system.materials, of(pieces.material), of(pieces.size), of(pieces.curvature), mass)
    radius_a, radius_b = of(pieces.radius)
    width = jnp.minimum(*of(pieces.width))
    return Slots(live, a, b, None, None, radius_a, radius_b, width, None, system.law.pair(pair))


def _hull_of_piece(system: System, b: Array):
    """Hulls of pieces: one row that broadcasts where all polytopes are alike, which saves gathering it."""
    if "hulls" in system.alike:
        return hulls.gather(system.hulls, jnp.zeros((1,), jnp.int32), False)
    return hulls.gather(system.hulls, system.shape[b], False)
