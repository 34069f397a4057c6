"""The stress campaign: its fast share, and that its invariants see what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.stability import axes
from benchmarks.stability.trials import Trial, looked_at, tried
from dem_jax import simulate


@pytest.mark.parametrize(
    "name", ["restitution, softening, moduli", pytest.param("place", marks=pytest.mark.long)]
)
def test_fast_share_of_the_campaign(name):
    for trial in [*axes.AXES[name](True)][::3]:
        outcome = tried(trial)
        assert outcome.ended == "run" and not outcome.faults, (
            trial.name,
            outcome.faults,
            outcome.words,
        )


def test_what_cannot_be_is_refused_in_one_line():
    outcome = tried(next(trial for trial in axes.touches(True) if trial.refused))
    assert (
        outcome.ended == "one line"
        and not outcome.faults
        and "overlap at the start by 100 %" in outcome.words
    )


def test_the_invariants_see_what_is_wrong():
    scene = axes.landing()
    run, trial = simulate(scene), Trial("landing", lambda: scene)
    faults, figures = looked_at(run, scene, trial)
    assert not faults and figures["overlap"] > 0.01

    def found(**series):
        return looked_at(replace(run, series=run.series | series), scene, trial)[0]

    grown = run.energy | {"kinetic": run.energy["kinetic"] * np.linspace(1, 1.5, len(run.time))}
    assert any("energy from nothing" in fault for fault in found(energy=grown))
    assert any(
        "momentum off" in fault
        for fault in found(mean_force={k: 1.01 * f for k, f in run.mean_force.items()})
    )
    assert any(
        "overlap 0.6" in fault
        for fault in found(max_relative_overlap=0 * run.max_relative_overlap + 0.6)
    )
    assert any(
        "not finite: force/plate" in fault
        for fault in found(force={k: f * np.nan for k, f in run.force.items()})
    )
    refused = tried(Trial("accepted", lambda: scene, refused=True))
    assert refused.faults == ("accepted",)


REAL = {"allow_nan": False, "allow_infinity": False}


@settings(
    max_examples=20, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
@given(
    epsilon=st.floats(0.05, 1, **REAL),
    friction=st.just(0.0) | st.floats(1e-3, 1.5, **REAL),
    logarithm=st.floats(-3, 0, **REAL),
    density=st.floats(30, 8000, **REAL),
    size=st.floats(0.2, 3, **REAL),
    speed=st.floats(0.05, 2, **REAL),
    spin=st.floats(-50, 50, **REAL),
    turn=st.integers(0, 2**31),
)
def test_random_scenes_keep_their_invariants(
    epsilon, friction, logarithm, density, size, speed, spin, turn
):
    """Two marshmallows, one over the other, that land on the plate: any size, material, speed and
    pose.
    """
    poses = Rotation.random(2, random_state=turn).as_quat(scalar_first=True).tolist()
    reach = 0.0305 * size  # bounding radius
    rows = [
        {
            **axes.MARSHMALLOW,
            "scale_factor": size,
            "position": (0.0, 0.0, (1 + 2.05 * k) * reach),
            "orientation": pose,
            "velocity": (0.2 * speed, 0.0, -speed * (1 + k)),
            "angular_velocity": (spin, 0.5 * spin, -spin),
        }
        for k, pose in enumerate(poses)
    ]
    material = {
        "restitution": epsilon,
        "friction_wall": friction,
        "friction_piece": friction,
        "density": density,
    }
    # no softer than what bears the impact: the overlap is v sqrt(m / (NSF E L)), here at most a
    # fifth of the width
    least = density * (3 * speed / 0.2) ** 2 / 1e8 * 4
    softening = min(1.0, max(10**logarithm, least))
    scene = axes.pieces(rows, run__duration=0.03 * size / speed**0.5).replace(
        {f"material.{k}": v for k, v in {**material, "numerical_softening": softening}.items()}
    )
    dt = 6e-6 * size * (density / 300 / softening * 0.01) ** 0.5  # about the automatic step's
    scene = scene.replace({"run.sample_interval": 16 * dt, "run.duration": 16 * dt * 150})
    outcome = tried(Trial("random", lambda: scene))
    assert not outcome.faults, (outcome.faults, outcome.words)
