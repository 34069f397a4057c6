"""From the arrays of a chunk to the series and poses of a file, in the user's names and body frames."""

import numpy as np

from dem_jax.contact import motion
from dem_jax.maths import rotation
from dem_jax.maths.pose import matrix_of_quaternion
from dem_jax.types import ENERGIES, Sample, State, System

WITHOUT_LEDGER = ENERGIES[:3]  # what is known where dissipation and work of walls are not added up


def moving_groups(system: System) -> dict[str, int]:
    """Name and index of each wall group that moves."""
    moves = motion.moves(system.walls)
    return {name: i for i, name in enumerate(system.walls.groups) if moves[i]}


def of_samples(system: System, blocks, samples: Sample, time) -> dict:
    """The series of record.Run of samples [.., T]; time: [T] (s); blocks: names."""
    add = lambda loads, members: loads[..., list(members)].sum(axis=-1)  # noqa: E731
    reports = system.walls.reports
    kinds = ENERGIES if system.ledger else WITHOUT_LEDGER
    return {
        "time": time,
        "force": {name: add(samples.force, members) for name, members in reports},
        "mean_force": {name: add(samples.mean_force, members) for name, members in reports},
        "torque": {name: samples.torque[..., i] for name, i in moving_groups(system).items()},
        "settled_mass": {name: samples.settled_mass[..., i] for i, name in enumerate(blocks)},
        "energy": {kind: samples.energy[..., ENERGIES.index(kind)] for kind in kinds},
        "momentum": samples.momentum,
        "overlap": samples.overlap,
    }


def of_poses(poses, frames, time) -> dict:
    """The fields of record.Frames of poses [.., F, 13, N]; frames: Built.frames, [N, 4]; time: [F] (s)."""
    poses = np.moveaxis(poses, -2, -1)
    back = rotation.conjugate(tuple(frames.T.astype(poses.dtype)))
    q = np.stack(rotation.multiply(tuple(np.moveaxis(poses[..., 3:7], -1, 0)), back), axis=-1)
    return {
        "time": time,
        "position": poses[..., :3],
        "orientation": q,
        "velocity": poses[..., 7:10],
        "angular_velocity": poses[..., 10:13],
    }


def pose_of(system: System, state: State):
    """Position, orientation, velocity and angular velocity (rad/s), [.., 13, N], as measure.frame, in numpy."""
    q, momentum = np.asarray(state.orientation), np.asarray(state.angular_momentum)
    spin = np.zeros_like(momentum)
    if system.has_rotation:
        turn = matrix_of_quaternion(np.moveaxis(q, -2, -1))  # [.., N, 3, 3]
        p = np.moveaxis(momentum, -2, -1)[..., None]
        local = np.swapaxes(turn, -1, -2) @ p / np.asarray(system.pieces.inertia, np.float64).T[..., None]
        spin = np.moveaxis((turn @ local)[..., 0], -1, -2).astype(momentum.dtype)
    return np.concatenate([np.asarray(state.position), q, np.asarray(state.velocity), spin], axis=-2)
