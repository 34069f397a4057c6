"""The contact law of a scene, and the materials that it acts between. In numpy, double precision."""

import numpy as np

from dem_jax.contact.law import ContactLaw
from dem_jax.contact.law.walton_braun import WaltonBraun
from dem_jax.scene import Scene
from dem_jax.types import Materials

PIECE, WALL = 0, 1  # rows of Materials


def law_of(scene: Scene) -> ContactLaw:
    """The law that a scene asks for."""
    m = scene.material
    damping = np.float64(m.unloading_damping) if m.unloading_damping else None
    return WaltonBraun(np.float64(m.separation), np.float64(m.tangential_stiffness), damping)


def materials_of(scene: Scene) -> Materials:
    """The table of materials."""
    m = scene.material
    friction = np.array([[m.friction_piece, m.friction_wall], [m.friction_wall, m.friction_wall]])
    return Materials(
        youngs_modulus=m.softening * np.array([m.youngs_modulus, m.wall_youngs_modulus]),
        poisson_ratio=np.array([0.3, 0.3]),
        restitution=_in_short(np.full((2, 2), m.restitution)),
        friction=_in_short(friction) if friction.any() else None,
        pull_off=None,
    )


def _in_short(table):
    """A table of pairs; [1, 1] if all have the same."""
    return table[:1, :1] if (table == table[0, 0]).all() else table
