"""Pairs of materials: what a contact law is told of two bodies. In numpy (time step) and in JAX (slots) alike."""

from dem_jax.contact.law import Couple
from dem_jax.types import Array, Materials


def couple(materials: Materials, material, size, curvature, mass) -> Couple:
    """The couple of bodies a and b.

    material: pair of rows of the table [P] int; size: pair of L [P] (m); curvature: pair [P] (1/m); mass: effective [P] (kg).
    """
    of = lambda table: tuple(table[rows] for rows in material)  # noqa: E731
    return Couple(
        youngs_modulus=of(materials.youngs_modulus),
        poisson_ratio=of(materials.poisson_ratio),
        size=size,
        curvature=curvature,
        mass=mass,
        restitution=of_pair(materials.restitution, *material),
        friction=of_pair(materials.friction, *material),
        pull_off=of_pair(materials.pull_off, *material),
    )


def of_pair(table: Array | None, a, b) -> Array | None:
    """The value of pairs of rows, [P]; [1] where all pairs have the same (``Materials``); None where there is none."""
    if table is None:
        return None
    return table[0] if table.shape == (1, 1) else table[a, b]
