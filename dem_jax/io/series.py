"""Conversion of the arrays of a chunk to the series and poses of a file, in the user's names and
body frames.
"""

from typing import Any

import numpy as np

from dem_jax.dynamics.presence import find_present
from dem_jax.dynamics.quantity import Quantity
from dem_jax.io.header import StoredQuantity
from dem_jax.math import quaternions
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.types import Sample, State, System


def declare_quantities(system: System) -> tuple[StoredQuantity, ...]:
    """Metadata of the quantities in a file of the system's runs."""
    found = []
    for quantity in list_stored_quantities(system):
        rows = quantity.named_rows(system)
        labels = None if rows is None else tuple(name for name, _ in rows)
        found.append(
            StoredQuantity(quantity.name, quantity.unit, quantity.axis_names, quantity.help, labels)
        )
    return tuple(found)


def series_from_samples(system: System, samples: Sample, time: np.ndarray) -> dict[str, Any]:
    """The series of io.run_data.Run of samples [.., T]; time: [T] (s)."""
    return {"time": time} | {
        q.name: q.to_datasets(system, np.asarray(samples.values[q.name]))
        for q in list_stored_quantities(system)
    }


def list_stored_quantities(system: System) -> list[Quantity]:
    """The quantities that are written."""
    return [quantity for quantity in system.quantities if quantity.kept]


def frames_from_poses(
    poses: np.ndarray, frames: np.ndarray, time: np.ndarray
) -> dict[str, np.ndarray]:
    """The fields of io.run_data.Frames of poses [.., F, 13, N]; frames: AssembledSystem.frames,
    [.., N, 4]; time: [F] (s).
    """
    poses = np.moveaxis(poses, -2, -1)
    back = quaternions.conjugate(
        tuple(np.moveaxis(frames.astype(poses.dtype), -1, 0)[..., None, :])
    )
    q = np.stack(
        quaternions.hamilton_product(tuple(np.moveaxis(poses[..., 3:7], -1, 0)), back), axis=-1
    )
    return {
        "time": time,
        "position": poses[..., :3],
        "orientation": q,
        "velocity": poses[..., 7:10],
        "angular_velocity": poses[..., 10:13],
    }


def stack_pose(system: System, state: State) -> np.ndarray:
    """Position, orientation, velocity and angular velocity (rad/s), [.., 13, N], in numpy."""
    q, momentum = np.asarray(state.orientation), np.asarray(state.angular_momentum)
    spin = np.zeros_like(momentum)
    if system.has_rotation:
        turn = quaternion_to_matrix(np.moveaxis(q, -2, -1))  # [.., N, 3, 3]
        p = np.moveaxis(momentum, -2, -1)[..., None]
        local = (
            np.swapaxes(turn, -1, -2)
            @ p
            / np.asarray(system.pieces.inertia, np.float64).T[..., None]
        )
        spin = np.moveaxis((turn @ local)[..., 0], -1, -2).astype(momentum.dtype)
    position, present = np.asarray(state.position), find_present(system, state)
    if present is not None:
        position = np.where(np.asarray(present)[..., None, :], position, np.nan)
    return np.concatenate([position, q, np.asarray(state.velocity), spin], axis=-2)
