"""Quantities of a contact slot that are constant between two rebuilds: shapes of its two bodies and
constants of the contact law.
"""

import jax
import jax.numpy as jnp

from dem_jax.contact_laws import MaterialPair
from dem_jax.contact_laws.material_pairs import make_material_pair
from dem_jax.contact_laws.springs import combine_in_series
from dem_jax.math.compaction import EMPTY
from dem_jax.narrow_phase import hull_lookup
from dem_jax.types import Array, Hulls, PairConstants, PatchMarker, System


def compute_pair_constants(system: System, kind: str, a: Array, b: Array) -> PairConstants:
    """Constants of the pairs (a, b) [P] of a kind; a is EMPTY in free slots."""
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    of = {"spheres": _sphere_constants, "plates": _plate_constants}.get(kind, _polytope_constants)
    return of(system, kind, live, a, b)


def _polytope_constants(
    system: System, kind: str, live: Array, a: Array, b: Array
) -> PairConstants:
    pieces, parts, table = system.pieces, system.parts, system.hulls
    assert table is not None
    number = parts.count
    wall, own, panel = a >= number, jnp.minimum(a, number - 1), jnp.maximum(a - number, 0)
    piece_a, piece_b = parts.owning_piece(own), parts.owning_piece(b)
    by_tables = table.features is None  # else contacts of polytopes look up their features
    patch = PatchMarker() if kind == "hulls" and system.materials.friction is not None else None
    return PairConstants(
        live=live,
        a=a,
        b=b,
        hull_a=hull_lookup.gather_hulls(table, system.shape[a], kind == "mixed")
        if kind == "mixed" or by_tables
        else None,
        hull_b=_gather_piece_hulls(system, table, b) if kind == "hulls" and by_tables else None,
        radius_a=parts.radius[own],
        radius_b=parts.radius[b],
        width=jnp.where(
            wall, pieces.width[piece_b], jnp.minimum(pieces.width[piece_a], pieces.width[piece_b])
        ),
        surface_a=_surface_labels(system, kind, wall, own, panel, live),
        surface_b=None if parts.surface is None else parts.surface[b],
        patch=patch,
        pair=system.law.pair_parameters(
            _combine_materials(system, wall, piece_a, panel, piece_b)._replace(patch=patch)
        ),
    )


def _surface_labels(
    system: System, kind: str, wall: Array, part: Array, panel: Array, live: Array
) -> Array | None:
    """``PairConstants.surface_a``: planes of walls are numbered before surfaces of pieces; there
    are fewer planes than panels.
    """
    plane, surface = system.walls.plane if kind == "hulls" else None, system.parts.surface
    if surface is None:
        return None if plane is None else jnp.where(wall & live, plane[panel], EMPTY)
    panels = system.walls.group.shape[0]
    own = jnp.where(surface[part] >= 0, surface[part] + panels, EMPTY)
    return jnp.where(wall, EMPTY if plane is None else plane[panel], own)


def _combine_materials(
    system: System, wall: Array, own: Array, panel: Array, b: Array
) -> MaterialPair:
    """Material pairs of pieces b with panels where ``wall`` holds, else with pieces ``own``."""
    pieces, walls = system.pieces, system.walls
    material, curvature = pieces.material[own], pieces.curvature[own]
    if walls.material.shape[0]:
        material = jnp.where(wall, walls.material[panel], material)
    size = jnp.where(wall, pieces.size[b], pieces.size[own])
    mass = jnp.where(wall, pieces.mass[b], combine_in_series(pieces.mass[own], pieces.mass[b]))
    curvature = jnp.where(wall, 0, curvature)
    materials = material, pieces.material[b]
    return make_material_pair(
        system.materials, materials, (size, pieces.size[b]), (curvature, pieces.curvature[b]), mass
    )


def _sphere_constants(system: System, _: str, live: Array, a: Array, b: Array) -> PairConstants:
    """Constants of pairs of spheres. If all spheres are alike, one value of each constant
    broadcasts, which saves memory access.
    """
    pieces, parts = system.pieces, system.parts
    one = (parts.spheres[:1],) * 2 if "spheres" in system.alike else (a, b)
    first, second = (parts.owning_piece(part) for part in one)
    of = lambda rows: (rows[first], rows[second])
    mass = combine_in_series(*of(pieces.mass))
    pair = make_material_pair(
        system.materials, of(pieces.material), of(pieces.size), of(pieces.curvature), mass
    )
    return PairConstants(
        live=live,
        a=a,
        b=b,
        radius_a=parts.radius[one[0]],
        radius_b=parts.radius[one[1]],
        width=jnp.minimum(*of(pieces.width)),
        pair=system.law.pair_parameters(pair),
    )


def _plate_constants(system: System, _: str, live: Array, a: Array, b: Array) -> PairConstants:
    """Constants of pairs of panels a and spheres b."""
    pieces, parts, walls = system.pieces, system.parts, system.walls
    panel, piece = jnp.maximum(a - parts.count, 0), parts.owning_piece(b)
    materials, size = (walls.material[panel], pieces.material[piece]), pieces.size[piece]
    curvature = pieces.curvature[piece]
    pair = make_material_pair(
        system.materials,
        materials,
        (size, size),
        (jnp.zeros_like(curvature), curvature),
        pieces.mass[piece],
    )
    plane = walls.plane
    return PairConstants(
        live=live,
        a=a,
        b=b,
        plate_a=jax.tree.map(lambda rows: rows[..., panel], walls.plates),
        radius_a=jnp.zeros((1,), size.dtype),
        radius_b=parts.radius[b],
        width=pieces.width[piece],
        surface_a=None if plane is None else jnp.where(live, plane[panel], EMPTY),
        surface_b=None if plane is None or parts.surface is None else parts.surface[b],
        pair=system.law.pair_parameters(pair),
    )


def _gather_piece_hulls(system: System, table: Hulls, b: Array) -> Hulls:
    """Hulls of pieces; if all polytopes are alike, one row that broadcasts, which saves the
    gather.
    """
    if "hulls" in system.alike:
        return hull_lookup.gather_hulls(table, jnp.zeros((1,), jnp.int32), False)
    return hull_lookup.gather_hulls(table, system.shape[b], False)
