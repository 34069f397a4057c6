"""The load cell of a scene's weigh bucket, and its limit on the time step."""

from collections.abc import Sequence

import numpy as np

from dem_jax.assembly.time_step import PossibleContact, largest_stiffness
from dem_jax.contact_laws import ContactLaw
from dem_jax.scene import LoadCell, Scene, bucket_geometry
from dem_jax.scene.array_namespace import as_float_array
from dem_jax.types import LoadCellModel as Cell
from dem_jax.types import as_array


def find_load_cell(scene: Scene) -> LoadCell | None:
    """The section of the scene's load cell, or None without one."""
    return scene.weigh_bucket.load_cell if scene.weigh_bucket else None


def build_load_cell_model(scene: Scene, groups: Sequence[str], group: np.ndarray) -> Cell | None:
    """The load cell, in numpy; None without one. groups: names of the G wall groups; group: [W],
    the group of each panel.
    """
    section = find_load_cell(scene)
    if section is None or scene.weigh_bucket is None:
        return None
    carried = bucket_geometry.list_wall_groups(scene.weigh_bucket, "wb")
    carries = np.array([name in carried for name in groups], float)
    return Cell(
        mass=as_array(as_float_array(section.mass)),
        stiffness=as_array(as_float_array(section.spring_stiffness())),
        damping=as_array(as_float_array(section.damping_constant())),
        groups=as_array(carries),
        panels=as_array(carries[group]),
    )


def bound_load_cell_frequency(
    scene: Scene, law: ContactLaw, contacts: Sequence[PossibleContact], pieces: int
) -> float:
    """Bound (1/s2) on the amount by which a load cell raises the largest squared frequency of
    pieces on fixed walls; 0 without one.

    The cell adds one row to the matrix of stiffness over mass, that of the bucket: at most (k + n
    K) / M, with K the stiffness of the stiffest contact and n the number of pieces that may lie on
    the bucket at once. By Weyl's inequality the largest eigenvalue does not exceed the sum of this
    bound and the largest eigenvalue of the pieces.
    """
    section = find_load_cell(scene)
    if section is None:
        return 0.0
    return (section.spring_stiffness() + pieces * largest_stiffness(law, contacts)) / section.mass
