"""What stays the same in a slot between two rebuilds: shapes of its two bodies, and what the contact law makes of them."""

import jax
import jax.numpy as jnp

from dem_jax.contact import hulls
from dem_jax.contact.law import Couple
from dem_jax.contact.law.springs import series
from dem_jax.contact.materials import couple
from dem_jax.maths.compaction import EMPTY
from dem_jax.types import Array, Hulls, Patch, Slots, System


def constants(system: System, kind: str, a: Array, b: Array) -> Slots:
    """Slots of the pairs (a, b) [P] of a kind; a is EMPTY where there is none."""
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    of = {"spheres": _between_spheres, "plates": _on_plates}.get(kind, _with_polytopes)
    return of(system, kind, live, a, b)


def _with_polytopes(system: System, kind: str, live: Array, a: Array, b: Array) -> Slots:
    pieces, parts, table = system.pieces, system.parts, system.hulls
    assert table is not None
    number = parts.count
    wall, own, panel = a >= number, jnp.minimum(a, number - 1), jnp.maximum(a - number, 0)
    piece_a, piece_b = parts.piece(own), parts.piece(b)
    by_tables = table.features is None  # else a contact of polytopes looks up what it needs
    patch = Patch() if kind == "hulls" and system.materials.friction is not None else None
    return Slots(
        live=live,
        a=a,
        b=b,
        hull_a=hulls.gather(table, system.shape[a], kind == "mixed") if kind == "mixed" or by_tables else None,
        hull_b=_hull_of_piece(system, table, b) if kind == "hulls" and by_tables else None,
        radius_a=parts.radius[own],
        radius_b=parts.radius[b],
        width=jnp.where(wall, pieces.width[piece_b], jnp.minimum(pieces.width[piece_a], pieces.width[piece_b])),
        surface_a=_surface(system, kind, wall, own, panel, live),
        surface_b=None if parts.surface is None else parts.surface[b],
        patch=patch,
        pair=system.law.pair(_couple(system, wall, piece_a, panel, piece_b)._replace(patch=patch)),
    )


def _surface(system: System, kind: str, wall: Array, part: Array, panel: Array, live: Array) -> Array | None:
    """Slots.surface_a: planes of walls are numbered before surfaces of pieces, of which there are fewer than panels."""
    plane, surface = system.walls.plane if kind == "hulls" else None, system.parts.surface
    if surface is None:
        return None if plane is None else jnp.where(wall & live, plane[panel], EMPTY)
    panels = system.walls.group.shape[0]
    own = jnp.where(surface[part] >= 0, surface[part] + panels, EMPTY)
    return jnp.where(wall, EMPTY if plane is None else plane[panel], own)


def _couple(system: System, wall: Array, own: Array, panel: Array, b: Array) -> Couple:
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


def _between_spheres(system: System, _: str, live: Array, a: Array, b: Array) -> Slots:
    """Slots of pairs of spheres. Where all are alike one value of each constant broadcasts, which saves reading it."""
    pieces, parts = system.pieces, system.parts
    one = (parts.spheres[:1],) * 2 if "spheres" in system.alike else (a, b)
    first, second = (parts.piece(part) for part in one)
    of = lambda rows: (rows[first], rows[second])  # noqa: E731
    mass = series(*of(pieces.mass))
    pair = couple(system.materials, of(pieces.material), of(pieces.size), of(pieces.curvature), mass)
    return Slots(
        live=live,
        a=a,
        b=b,
        radius_a=parts.radius[one[0]],
        radius_b=parts.radius[one[1]],
        width=jnp.minimum(*of(pieces.width)),
        pair=system.law.pair(pair),
    )


def _on_plates(system: System, _: str, live: Array, a: Array, b: Array) -> Slots:
    """Slots of panels a and spheres b."""
    pieces, parts, walls = system.pieces, system.parts, system.walls
    panel, piece = jnp.maximum(a - parts.count, 0), parts.piece(b)
    materials, size = (walls.material[panel], pieces.material[piece]), pieces.size[piece]
    curvature = pieces.curvature[piece]
    pair = couple(system.materials, materials, (size, size), (jnp.zeros_like(curvature), curvature), pieces.mass[piece])
    plane = walls.plane
    return Slots(
        live=live,
        a=a,
        b=b,
        plate_a=jax.tree.map(lambda rows: rows[..., panel], walls.plates),
        radius_a=jnp.zeros((1,), size.dtype),
        radius_b=parts.radius[b],
        width=pieces.width[piece],
        surface_a=None if plane is None else jnp.where(live, plane[panel], EMPTY),
        surface_b=None if plane is None or parts.surface is None else parts.surface[b],
        pair=system.law.pair(pair),
    )


def _hull_of_piece(system: System, table: Hulls, b: Array) -> Hulls:
    """Hulls of pieces: one row that broadcasts where all polytopes are alike, which saves gathering it."""
    if "hulls" in system.alike:
        return hulls.gather(table, jnp.zeros((1,), jnp.int32), False)
    return hulls.gather(table, system.shape[b], False)
