"""Pieces of several convex parts: one body with one contact where its surface is one, several where
it is not.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, validation, xla_flags
from dem_jax.broad_phase import neighbour_list, overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.math import quaternions
from dem_jax.runner.interface import ensemble, resume, simulate
from dem_jax.scene import Scene, load_scene
from dem_jax.validation import EccentricImpact

SAMPLES = 1024  # capacity of a chunk
SIZE = (0.06, 0.03, 0.02)  # m, of a cuboid
WHOLE = {"shape": "cuboid", "size": SIZE}
TURNED = {"flat": (1, 0, 0, 0.2), "edge": (1, 0.3, 0, 0.1), "corner": (1, 0.3, 0.4, 0.1)}


def blocks(*counts):
    """The cuboid cut into so many blocks along each axis."""
    each = np.array(SIZE) / counts
    places = [
        each * (np.array(index) + 0.5) - 0.5 * np.array(SIZE) for index in np.ndindex(*counts)
    ]
    return compound(
        {"shape": "cuboid", "size": tuple(each.tolist()), "position": tuple(p.tolist())}
        for p in places
    )


def compound(parts):
    return {"shape": "compound", "part": list(parts)}


def box(size, position):
    return {"shape": "cuboid", "size": size, "position": position}


BALLS = compound(
    {"shape": "sphere", "radius": 0.01, "position": (x, 0.0, 0.0)} for x in (-0.01, 0.01)
)
ENDS = [box((0.02, 0.02, 0.02), (x, 0.0, 0.0)) for x in (-0.03, 0.03)]
DUMB_BELL = compound([*ENDS, box((0.04, 0.008, 0.008), (0.0, 0.0, 0.0))])
ANGLE = compound(
    [box((0.04, 0.01, 0.01), (0.02, 0.005, 0.005)), box((0.01, 0.01, 0.02), (0.005, 0.005, 0.02))]
)
TUBE = {"shape": "tube", "outer_radius": 0.012, "inner_radius": 0.009, "height": 0.03, "sides": 6}


def started(piece, **run):
    settings = {"precision": "f64", "sample_interval": 2e-5, "frame_interval": 0.0} | run
    return assembly.assemble_system(
        load_scene("plate-drop").replace(piece=[piece], run=settings), 0
    )


def run(made, samples):
    """The last state and the samples, numpy."""
    state, recorded, _ = stepping.run_compiled_chunk(
        made.system, made.state, np.int32(samples), np.int32(1), samples=SAMPLES, frames=0
    )
    assert not overflow_recovery.describe_overflow(made.system, jax.device_get(state.guard))
    return state, jax.tree.map(lambda x: np.asarray(x)[:samples], recorded)


@cache
def landed(turned, counts):
    """A cuboid, whole or cut, that hits a plate: mean force of each sample, velocity and angular
    momentum after it.
    """
    q = np.array(TURNED[turned], float) / np.linalg.norm(TURNED[turned])
    corners = 0.5 * np.array(SIZE) * np.array(list(np.ndindex(2, 2, 2)))
    low = Rotation.from_quat(np.roll(q, -1)).apply(2 * corners - 0.5 * np.array(SIZE))[:, 2].min()
    pose = {
        "position": (0.001, 0.002, 1e-5 - low),
        "orientation": tuple(q.tolist()),
        "velocity": (0.1, 0.05, -0.5),
    }
    state, samples = run(started((blocks(*counts) if counts else WHOLE) | pose), 100)
    return (
        samples.mean_force[:, 2, 0],
        np.asarray(state.velocity[:, 0]),
        np.asarray(state.angular_momentum[:, 0]),
        samples,
    )


@pytest.mark.parametrize(
    "turned", ["corner", *(pytest.param(way, marks=pytest.mark.long) for way in ("flat", "edge"))]
)
@pytest.mark.parametrize(
    "counts", [pytest.param((2, 1, 1), marks=pytest.mark.long), (2, 2, 1)], ids=str
)
def test_a_cuboid_of_blocks_lands_as_a_whole_one(turned, counts):
    """Force, velocity (so restitution) and spin, to rounding: the same edges of the same faces are
    added up.
    """
    force, velocity, spin, _ = landed(turned, None)
    parts = landed(turned, counts)
    assert np.abs(force).max() > 1.0
    np.testing.assert_allclose(parts[0], force, rtol=0, atol=1e-10 * np.abs(force).max())
    np.testing.assert_allclose(parts[1], velocity, rtol=0, atol=1e-12)
    np.testing.assert_allclose(parts[2], spin, rtol=0, atol=1e-10 * np.abs(spin).max())


DEEP = 5e-7  # m


def pressed(piece, height):
    """Vertical force (N) of a plate on a piece that moves into it, DEEP after one step, by the
    loading line alone; height: (m) of its centre at touch.
    """
    pose = {"position": (0.0, 0.0, height + DEEP), "velocity": (0.0, 0.0, -1.0)}
    made = started(piece | pose, gravity=(0.0, 0.0, 0.0))
    system = made.system.replace(
        dt=jnp.full_like(made.system.dt, 2 * DEEP), resolved=jnp.zeros_like(made.system.resolved)
    )
    state = jax.jit(
        lambda s: stepping.advance_step(system, neighbour_list.rebuild_neighbour_list(system, s))
    )(made.state)
    return made, state, float(state.motion.force[2, 0])


def test_a_dumb_bell_on_both_ends_has_two_contacts():
    made, state, force = pressed(DUMB_BELL, 0.01)
    stiffness = float(validation.wall_stiffness(made.system)[0])
    assert force == pytest.approx(2 * stiffness * DEEP, rel=1e-7)
    np.testing.assert_allclose(state.motion.torque[:, 0], 0, atol=1e-12)


FLAT, BENT = (
    pytest.param(*case, marks=pytest.mark.long) for case in ((blocks(3, 2, 1), 0.01), (ANGLE, None))
)


@pytest.mark.parametrize(
    "piece, height", [(TUBE, 0.015), FLAT, BENT], ids=["tube", "blocks", "angle"]
)
def test_one_surface_on_a_plate_is_one_contact(piece, height):
    """However many parts touch; the force acts at the middle of the surface."""
    if height is None:
        height = -float(started(piece | {"position": (0, 0, 1)}).shapes[0].vertices[:, 2].min())
    made, _, force = pressed(piece, height)
    assert made.system.parts.count > 1
    assert force == pytest.approx(float(validation.wall_stiffness(made.system)[0]) * DEEP, rel=1e-7)


def test_an_eccentric_impact_on_one_ball_of_two():
    """The closed form of a stiff contact: two touching balls as one body, tilted, hit with the
    lower one.
    """
    angle = 0.6
    q = np.array([np.cos(angle / 2), 0, np.sin(angle / 2), 0])
    low = -0.01 - 0.01 * np.sin(angle)
    piece = BALLS | {
        "position": (0, 0, 1e-7 - low),
        "orientation": tuple(q.tolist()),
        "velocity": (0, 0, -1.0),
    }
    scene = validation.plate_scene(
        piece,
        numerical_softening=100.0,
        restitution=0.5,
        separation_slope_ratio=0.0,
        friction_wall=0.0,
    )
    made = assembly.assemble_system(scene)
    assert made.system.has_rotation and made.system.has_hulls and made.system.hulls is None
    system = validation.with_permanent_pairs(made.system)
    turn = Rotation.from_quat(np.roll(np.asarray(made.state.orientation[:, 0]), -1)).as_matrix()
    inertia = turn @ np.diag(np.asarray(system.pieces.inertia[:, 0])) @ turn.T
    arm = Rotation.from_rotvec([0, angle, 0]).apply([0.01, 0, 0]) - [0, 0, 0.01]
    exact = EccentricImpact(
        mass=float(system.pieces.mass[0]),
        inertia=inertia,
        arm=arm,
        normal=np.array([0, 0, 1.0]),
        velocity=np.array([0, 0, -1.0]),
        spin=np.zeros(3),
        stiffness=float(validation.wall_stiffness(system)[0]),
        restitution=0.5,
    )
    steps = int(2 * exact.duration / float(system.dt)) + 20
    state, seen = jax.jit(
        lambda s: validation.trace_motion(system, s, steps, validation.read_motion)
    )(made.state)
    omega = quaternions.angular_velocity(
        tuple(state.orientation), tuple(state.angular_momentum), tuple(system.pieces.inertia)
    )
    # 1 %: ten steps to a quarter period of unloading
    assert np.max(seen["force"]) == pytest.approx(exact.peak_force, rel=1e-2)
    np.testing.assert_allclose(np.asarray(state.velocity[:, 0]), exact.velocity_after, atol=1e-2)
    np.testing.assert_allclose(
        np.stack(omega)[:, 0], exact.spin_after, atol=1e-2 * np.abs(exact.spin_after).max()
    )


WALLS = [
    [(-0.06, -0.06, 0), (0.06, -0.06, 0), (0.06, 0.06, 0), (-0.06, 0.06, 0)],
    [(-0.06, -0.06, 0), (-0.06, 0.06, 0), (-0.06, 0.06, 0.2), (-0.06, -0.06, 0.2)],
    [(0.06, 0.06, 0), (0.06, -0.06, 0), (0.06, -0.06, 0.2), (0.06, 0.06, 0.2)],
    [(0.06, -0.06, 0), (-0.06, -0.06, 0), (-0.06, -0.06, 0.2), (0.06, -0.06, 0.2)],
    [(-0.06, 0.06, 0), (0.06, 0.06, 0), (0.06, 0.06, 0.2), (-0.06, 0.06, 0.2)],
]


def boxed(pieces, **settings):
    run = {
        "precision": "f64",
        "duration": 0.05,
        "sample_interval": 1e-4,
        "frame_interval": 0.01,
        "track_energy": True,
    }
    return Scene(
        piece=pieces, wall=[{"group": "box", "corners": c} for c in WALLS], run=run | settings
    )


MIXED = [
    TUBE | {"position": (-0.02, -0.03, 0.03), "orientation": (1.0, 0.4, 0.1, 0.0)},
    DUMB_BELL
    | {
        "position": (0.0, 0.02, 0.03),
        "velocity": (0.0, -0.3, 0.0),
        "orientation": (1.0, 0.1, 0.0, 0.3),
    },
    ANGLE
    | {
        "position": (0.0, 0.0, 0.06),
        "velocity": (0.0, 0.0, -1.0),
        "orientation": (1.0, 0.2, 0.3, 0.0),
    },
    BALLS | {"position": (-0.03, 0.03, 0.07), "velocity": (0.0, 0.0, -1.0)},
]


@pytest.fixture(scope="module")
def mixed():
    return simulate(boxed(MIXED))


def test_momentum_and_energy_balance_in_a_box(mixed):
    """The walls' impulse and gravity make the momentum, to rounding. What the sum of energies is
    off by is the error of the steps, of second order: 7.6e-5 of the largest kinetic energy, and
    4.00 times less with each half of the step.
    """
    mass = np.asarray(assembly.assemble_system(boxed(MIXED)).system.pieces.mass)
    gravity = 9.81 * mass.sum()
    p = np.asarray(mixed.momentum)
    impulse = np.cumsum(-np.asarray(mixed.mean_force["box"])[:, 2] - gravity) * 1e-4
    assert np.abs(np.asarray(mixed.mean_force["box"])).max() > 20 * gravity
    np.testing.assert_allclose(
        p[:, 2] - p[0, 2], impulse - impulse[0], rtol=0, atol=1e-9 * mass.sum()
    )
    energy = np.asarray(mixed.energy["total"])
    np.testing.assert_allclose(
        energy, energy[0], rtol=0, atol=3e-4 * np.ptp(mixed.energy["kinetic"])
    )


def test_a_restart_goes_on_bit_for_bit(mixed, tmp_path):
    simulate(boxed(MIXED, duration=0.02), out=tmp_path / "run.h5")
    rest = resume(tmp_path / "run.h5", duration=0.05)
    np.testing.assert_array_equal(rest.force["box"], mixed.force["box"])


@pytest.mark.long
def test_runs_side_by_side_are_those_alone():
    scene = load_scene("quick-release").replace(
        portion={
            "shape": "compound",
            "part": DUMB_BELL["part"],
            "count": 3,
            "arrangement": "scattered",
        },
        run={"precision": "f64", "duration": 0.02, "frame_interval": 0.0},
    )
    many = ensemble(scene, runs=16, seed=3)
    alone = simulate(scene, seed=3 + 5)
    for name, force in alone.mean_force.items():
        np.testing.assert_allclose(
            many.mean_force[name][5], force, rtol=0, atol=1e-8 * max(1e-3, np.abs(force).max())
        )


def test_parts_of_a_piece_never_touch_each_other():
    """Overlapping parts in free flight: no candidates, no force."""
    cross = compound([box((0.05, 0.01, 0.01), (0, 0, 0)), box((0.01, 0.05, 0.01), (0, 0, 0))])
    made = started(cross | {"position": (0, 0, 0.2)})
    state = jax.jit(
        lambda state: neighbour_list.rebuild_neighbour_list(
            validation.with_permanent_pairs(made.system), state
        )
    )(made.state)
    table = state.contacts["hulls"]
    live = np.asarray(table.a) >= 0
    # with the plate only
    assert live.any() and (np.asarray(table.a)[live] >= made.system.parts.count).all()
    assert not np.any(
        jax.jit(lambda state: stepping.advance_step(made.system, state))(state).motion.force
    )


UPRIGHT = pytest.param(TUBE, 0.0150, marks=pytest.mark.long)


@pytest.mark.parametrize("piece, height", [UPRIGHT, (DUMB_BELL, 0.01)], ids=["tube", "dumb-bell"])
def test_the_force_on_a_plate_is_the_weight(piece, height):
    """Of a piece that has come to rest; the law rings, the mean over 20 ms does not (1 %)."""
    made = started(piece | {"position": (0, 0, height)}, sample_interval=1e-4)
    _, samples = run(made, 1000)
    weight = 9.81 * float(made.system.pieces.mass[0])
    assert -samples.mean_force[-200:, 2, 0].mean() == pytest.approx(weight, rel=1e-2)


@pytest.mark.long
def test_derivatives_are_finite():
    made = started(
        blocks(2, 1, 1)
        | {"position": (0, 0, 0.0101), "orientation": (1, 0.02, 0.03, 0), "velocity": (0, 0, -0.5)}
    )

    def height(speed):
        state = made.state.replace_motion(velocity=made.state.velocity.at[2].set(speed))
        return stepping.rollout(made.system, state, 20, 4)[0].velocity[2, 0]

    # Few steps: all the time goes into compiling, which is quickest where LLVM does not optimise.
    options = xla_flags.supported_options("cpu") | {"xla_backend_optimization_level": 0}
    derivative = jax.jit(
        lambda speed: jax.jvp(height, (speed,), (jnp.ones(()),)), compiler_options=options
    )
    value, slope = derivative(jnp.float64(-0.5))
    assert np.isfinite(value) and np.isfinite(slope) and float(slope) != 0
