"""Runs made up by hand, for tests of what is shown of stored runs: nothing is simulated."""

import numpy as np

from dem_jax.io.run_files import Frames, Run, RunHeader
from dem_jax.scene import load_scene

G = 9.81
PIECES = [
    {
        "shape": "tube",
        "outer_radius": 0.01,
        "inner_radius": 0.006,
        "height": 0.02,
        "sides": 8,
        "position": [0.0, 0.0, 0.1],
    },
    {"shape": "sphere", "radius": 0.01, "position": [0.05, 0.0, 0.1]},
]
SCENE = load_scene("plate-drop").replace(piece=PIECES, name="two")


def stored(peaks=(2.0,), frames=20, at_rest=0.1, scene=SCENE):
    """A tube and a ball on a plate: half a sine of 2 ms from 20 ms on, of a peak (kg) for each run;
    then 3 g, all that weighs, settled from ``at_rest`` (s) on. One peak: a single run.
    """
    runs = None if len(peaks) == 1 else len(peaks)
    pick = (lambda a: a[0]) if runs is None else (lambda a: a)
    time = 1e-4 * np.arange(1, 3001)
    pulse = np.where((time > 0.02) & (time < 0.022), np.sin(np.pi * (time - 0.02) / 0.002), 0.0)
    kg = np.array(peaks)[:, None] * pulse + 3e-3 * (time > 0.022)
    force = {"plate": pick(kg[..., None] * (0.0, 0.0, -G))}
    mass = {"plate": pick(np.broadcast_to(3e-3 * (time > at_rest), kg.shape))}
    seed = 7 if runs is None else tuple(range(runs))
    header = RunHeader(
        scene.to_toml(),
        seed,
        5e-6,
        "f32",
        "0.1.0",
        1e-4,
        (0.0, 0.0, -G),
        ("plate",),
        ("plate",),
        2,
        runs,
    )
    series = {"force": force, "mean_force": force, "settled_mass": mass}
    return Run(header, time, series, poses(runs, frames) if frames else None)


def poses(runs, frames):
    """Both fall by 90 mm at 1 m/s, the tube turning about z."""
    time = np.linspace(0.0, 0.09, frames)
    position = np.array([[(0.0, 0.0, 0.1 - t), (0.05, 0.0, 0.1 - t)] for t in time])
    still = np.tile((1.0, 0.0, 0.0, 0.0), (frames, 1))
    turn = np.stack([np.cos(20 * time), 0 * time, 0 * time, np.sin(20 * time)], axis=-1)
    orientation = np.stack([turn, still], axis=1)
    velocity = np.tile((0.0, 0.0, -1.0), (frames, 2, 1))
    of_run = lambda a: a if runs is None else np.stack([a] * runs)
    return Frames(time, *map(of_run, (position, orientation, velocity, 0 * velocity)))
