"""Drives of limited torque that swing flaps, and their limit on the time step."""

from collections.abc import Sequence

import numpy as np

from dem_jax.assembly.time_step import PossibleContact, largest_stiffness
from dem_jax.contact_laws import ContactLaw
from dem_jax.errors import SceneError
from dem_jax.scene import Motion
from dem_jax.scene.array_namespace import as_float_array
from dem_jax.scene.bucket_geometry import Panel
from dem_jax.types import FlapDrives, as_array
from dem_jax.walls.motion import Hinge, Table
from dem_jax.walls.motion.section_arrays import unit_axis


def build_flap_drives(motions: Sequence[Motion], groups: Sequence[str]) -> FlapDrives | None:
    """The drives of the G groups, in numpy; None without drives. Raises SceneError for a drive
    without a swing.
    """
    rows = {row.group: row for row in motions if row.drive is not None}
    if not rows:
        return None
    for row in motions:
        if row.group not in rows:
            continue
        key = f"motion.drive (group {row.group!r})"
        if row.drive is not None and not Hinge.is_requested(row):
            raise SceneError(
                f"{key}: with opening_angle_deg = 0; allowed: only for a flap that swings about a hinge"
            )
        if Table.is_requested(row) and row.angles_deg is not None:
            raise SceneError(
                f"{key}: beside a table of angles; allowed: only for a flap without other rotations"
            )
    found = [rows[name].drive if name in rows else None for name in groups]
    each = [
        (d.torque, d.inertia, d.natural_frequency, d.damping_ratio) if d else (0.0, 1.0, 0.0, 0.0)
        for d in found
    ]
    torque, inertia, frequency, ratio = (as_float_array([row[k] for row in each]) for k in range(4))
    rate = 2 * np.pi * frequency
    axes = [unit_axis(rows[name]) if name in rows else np.zeros(3) for name in groups]
    return FlapDrives(
        groups=as_array(np.array([d is not None for d in found], float)),
        axis=as_array(np.array(axes).T),
        torque=as_array(torque),
        inertia=as_array(inertia),
        stiffness=as_array(inertia * rate * rate),
        damping=as_array(2 * ratio * rate * inertia),
    )


def bound_drive_frequency(
    motions: Sequence[Motion],
    panels: Sequence[Panel],
    law: ContactLaw,
    contacts: Sequence[PossibleContact],
    pieces: int,
) -> float:
    """Bound (1/s2) on the amount by which drives raise the largest squared frequency, compared with
    prescribed wall motion; 0 without drives.

    As for a load cell the bound is (k + n K r2) / I, with K the stiffness of the stiffest contact,
    n the number of pieces and r the lever arm of the furthest corner.
    """
    most = 0.0
    for row, drive in ((row, row.drive) for row in motions if row.drive is not None):
        corners = np.concatenate(
            [np.asarray(c, float) for group, c, _ in panels if group == row.group]
        ) - np.array(row.pivot)
        arm = np.linalg.norm(np.cross(corners, unit_axis(row)), axis=1).max()
        own = (2 * np.pi * drive.natural_frequency) ** 2
        most += own + pieces * largest_stiffness(law, contacts) * arm * arm / drive.inertia
    return float(most)
