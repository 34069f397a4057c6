"""Rows of spheres that transfer momentum."""

from typing import Any

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.validation.problem import ComparedValues, Problem, create_scene

COUNT, RADIUS, SPEED = 5, 0.01, 1.0  # , m, m/s
DENSITY, MODULUS, SOFT = 300.0, 1e8, 0.01  # kg/m3, Pa,
HAIR = 2.0  # gap over the largest overlap of an impact: each is over before the next begins
GAPS = (HAIR, HAIR, 0.0, 0.0)
FIRST = (1, 2, 1, 2)  # how many spheres come along


def contact_stiffness() -> float:
    """K_nl (N/m) between two spheres, eqs 5 to 8 with the diameter for L."""
    return 0.5 * SOFT * MODULUS * 2 * RADIUS


def sphere_mass() -> float:
    """Mass of a sphere (kg)."""
    return DENSITY * 4 / 3 * np.pi * RADIUS**3


def cradle_problem() -> Problem:
    """Newton's cradle without gravity, elastic: one or two spheres arrive and as many leave; also a
    touching row, in which no sphere is alone when it transfers its momentum.
    """
    overlap = SPEED * np.sqrt(0.5 * sphere_mass() / contact_stiffness())
    quarter = 0.5 * np.pi * np.sqrt(0.5 * sphere_mass() / contact_stiffness())
    gaps, x, speeds = _initial_states(overlap)
    keys: dict[str, list[Any]] = {
        f"piece.{k}.position": [[float(row[k]), 0.0, 0.0] for row in x] for k in range(COUNT)
    }
    keys |= {
        f"piece.{k}.velocity": [[float(row[k]), 0.0, 0.0] for row in speeds] for k in range(COUNT)
    }
    pieces = [
        {"shape": "sphere", "radius": RADIUS, "position": keys[f"piece.{k}.position"][0]}
        for k in range(COUNT)
    ]
    duration = 30 * quarter
    scene = create_scene(
        piece=pieces,
        material={
            "density": DENSITY,
            "youngs_modulus": MODULUS,
            "numerical_softening": SOFT,
            "restitution": 1.0,
            "friction_piece": 0.0,
            "friction_wall": 0.0,
        },
        run={
            "duration": duration,
            "sample_interval": duration / 50,
            "frame_interval": duration,
            "gravity": (0.0, 0.0, 0.0),
            "track_energy": False,
        },
    )
    return Problem(
        name="Newton's cradle",
        source="elastic impacts of two, apart; touching: the linear chain, its equations solved by DOP853",
        scene=scene,
        parameters=keys,
        measure=_read_speeds,
        exact=lambda: {
            "speed_bins": np.array(
                [_exact_speeds(*row, duration) for row in zip(gaps, x, speeds, FIRST, strict=True)]
            )
        },
        bounds={"speed_bins": 0.01},
    )


def _initial_states(overlap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gaps (m) of the rows, and places (m) and speeds (m/s), [runs, COUNT]."""
    gaps = overlap * np.array(GAPS)
    x, speeds = np.zeros((len(GAPS), COUNT)), np.zeros((len(GAPS), COUNT))
    for run, (gap, first) in enumerate(zip(gaps, FIRST, strict=True)):
        between = np.full(COUNT - 1, 2 * RADIUS + gap)
        between[first - 1] = 2 * RADIUS + overlap
        x[run, 1:] = np.cumsum(between)
        speeds[run, :first] = SPEED
    return gaps, x, speeds


def _exact_speeds(
    gap: float, x: np.ndarray, speeds: np.ndarray, first: int, duration: float
) -> np.ndarray:
    """Exact speeds (m/s), [COUNT]."""
    if gap:
        return SPEED * (np.arange(COUNT) >= COUNT - first)
    from scipy.integrate import solve_ivp

    def state_rates(_: float, y: np.ndarray) -> np.ndarray:
        push = contact_stiffness() * np.maximum(2 * RADIUS - np.diff(y[:COUNT]), 0)
        return np.concatenate(
            [y[COUNT:], np.diff(np.concatenate([[0.0], -push, [0.0]])) / sphere_mass()]
        )

    # the force has kinks where spheres part: the longest step keeps them small
    done = solve_ivp(
        state_rates,
        (0, duration),
        np.concatenate([x, speeds]),
        "DOP853",
        rtol=1e-11,
        atol=1e-14,
        max_step=duration / 2000,
    )
    return done.y[COUNT:, -1]


def _read_speeds(run: Run) -> ComparedValues:
    assert run.pieces is not None
    return {"speed_bins": np.asarray(run.pieces.velocity[:, -1, :, 0], float)}
