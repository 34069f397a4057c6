"""The load cell of a scene's weigh bucket, and its limit on the time step."""

from collections.abc import Sequence

import numpy as np

from dem_jax.build.time_step import PossibleContact, stiffest
from dem_jax.contact.law import ContactLaw
from dem_jax.scene import LoadCell, Scene, buckets
from dem_jax.scene.numbers import array
from dem_jax.types import LoadCell as Cell
from dem_jax.types import host


def section_of(scene: Scene) -> LoadCell | None:
    """The section of the scene's load cell, or None without one."""
    return scene.weigh_bucket.load_cell if scene.weigh_bucket else None


def load_cell_of(scene: Scene, groups: Sequence[str], group: np.ndarray) -> Cell | None:
    """The load cell, in numpy; None: the scene has none. groups: names of the G wall groups; group: [W], that of each panel."""
    section = section_of(scene)
    if section is None or scene.weigh_bucket is None:
        return None
    carried = buckets.groups(scene.weigh_bucket, "wb")
    carries = np.array([name in carried for name in groups], float)
    return Cell(
        mass=host(array(section.mass)),
        stiffness=host(array(section.spring())),
        damping=host(array(section.damper())),
        groups=host(carries),
        panels=host(carries[group]),
    )


def added_rate(scene: Scene, law: ContactLaw, contacts: Sequence[PossibleContact], pieces: int) -> float:
    """By how much (1/s2) a load cell raises the largest squared frequency of pieces on held walls, at most; 0: there is none.

    Of the matrix of stiffness over mass, the bucket's own row is all that is new: at most (k + n K) / M, K being the stiffest
    contact and n the number of pieces that may lie on it at once; by Weyl's inequality the largest eigenvalue is no more than
    that and the one of the pieces added up.
    """
    section = section_of(scene)
    if section is None:
        return 0.0
    return (section.spring() + pieces * stiffest(law, contacts)) / section.mass
