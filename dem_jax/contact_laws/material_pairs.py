"""Pairs of materials: the input of a contact law for two bodies, in numpy (time step) and in JAX
(slots).
"""

from typing import Any, overload

from dem_jax.types import PAIR_PROPERTIES, Array, MaterialPair, Materials

BodyValues = tuple[Array, Array]  # of bodies a and b


def make_material_pair(
    materials: Materials, material: BodyValues, size: BodyValues, curvature: BodyValues, mass: Array
) -> MaterialPair:
    """Material pair of bodies a and b.

    material: pair of rows of the table [P] int; size: pair of L [P] (m); curvature: pair [P] (1/m);
    mass: effective [P] (kg).
    """
    of = lambda table: (table[material[0]], table[material[1]])
    pairs: dict[str, Any] = {
        name: look_up_pair(getattr(materials, name), *material) for name in PAIR_PROPERTIES
    }
    return MaterialPair(
        youngs_modulus=of(materials.youngs_modulus),
        poisson_ratio=of(materials.poisson_ratio),
        size=size,
        curvature=curvature,
        mass=mass,
        **pairs,
    )


@overload
def look_up_pair(table: Array, a: Array, b: Array) -> Array: ...
@overload
def look_up_pair(table: None, a: Array, b: Array) -> None: ...
@overload
def look_up_pair(table: Array | None, a: Array, b: Array) -> Array | None: ...
def look_up_pair(table: Array | None, a: Array, b: Array) -> Array | None:
    """Value of pairs of table rows, [P]; [1] if all pairs have the same one (``Materials``); None
    without a table.
    """
    if table is None:
        return None
    return table[0] if table.shape == (1, 1) else table[a, b]
