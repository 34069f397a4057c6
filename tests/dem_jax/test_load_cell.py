"""The weigh bucket on its load cell: closed forms of the cell alone and of a sphere on it, second
order, momentum, and runs.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly, validation
from dem_jax.assembly.load_cell_setup import bound_load_cell_frequency
from dem_jax.assembly.time_step import list_possible_contacts
from dem_jax.dynamics import integrator, interleaved_batch
from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.types import LoadCellMotion
from dem_jax.validation import CellImpact
from dem_jax.visualization.summary import summarize_run
from dem_jax.walls import kinematics

SLOPE = np.radians(55.0)  # of the flaps
RADIUS, GRAVITY = 0.02, 9.81
CELL = {"mass": 0.05, "stiffness": 2e4, "damping_ratio": 0.1}  # 101 Hz; near the sphere's own mass
# and spring, so that both move
TOUCH = RADIUS / np.cos(SLOPE)  # m: height of a sphere that touches both flaps
STEPS = 200


def scene(cell=CELL, height=TOUCH, speed=0.0, run=None, bucket=None, **material):
    """A sphere in the middle of the closed bucket."""
    piece = {
        "shape": "sphere",
        "radius": RADIUS,
        "position": (0.0, 0.0, height),
        "velocity": (0.0, 0.0, -speed),
    }
    smooth = {"restitution": 1.0, "friction_wall": 0.0, "friction_piece": 0.0} | material
    settings = {
        "precision": "f64",
        "frame_interval": 0.0,
        "duration": 0.1,
        "sample_interval": 1e-4,
    } | (run or {})
    weigh_bucket = {"opening_angle_deg": 0.0, "load_cell": cell} | (bucket or {})
    return Scene(piece=[piece], weigh_bucket=weigh_bucket, run=settings, material=smooth)


@cache
def made():
    """With every pair a candidate for good."""
    built = assembly.assemble_system(scene())
    return validation.with_permanent_pairs(built.system), built.state


def problem(damping=True):
    """Both flaps push along their normals, by how far the sphere is in them: 2 K cos^2 of the
    slope, vertically.
    """
    system, _ = made()
    cell = system.walls.load_cell
    contact = 2 * float(validation.wall_stiffness(system)[0]) * np.cos(SLOPE) ** 2
    c = float(cell.damping) if damping else 0.0
    return CellImpact(
        float(system.pieces.mass[0]), contact, float(cell.mass), float(cell.stiffness), c, GRAVITY
    )


def read(_, state):
    cell = state.cell
    return jnp.stack(
        [TOUCH - state.position[2, 0], cell.deflection[0], -state.velocity[2, 0], cell.velocity[0]]
    )


@jax.jit
def ran(system, state):
    """State after STEPS steps, and u, x, u', x' after each."""
    return validation.trace_motion(system, state, STEPS, read)


def traced(start, dt, parts=1, damping=True):
    """u, x, u', x', [4, steps], from such a start; parts times STEPS steps."""
    system, state = made()
    u, x, v, w = start
    walls = system.walls
    if not damping:
        walls = walls.replace(
            load_cell=walls.load_cell.replace(damping=0 * walls.load_cell.damping)
        )
    system = system.replace(dt=jnp.asarray(np.float64(dt)), walls=walls)
    cell = LoadCellMotion(jnp.array([x]), jnp.array([w]))
    up = lambda z: jnp.array([[0.0], [0.0], [z]])
    state = state.replace_motion(position=up(TOUCH - u), velocity=up(-v)).replace(cell=cell)
    rows = []
    for _ in range(parts):
        state, found = ran(system, state)
        rows.append(found)
    return np.concatenate(rows).T


def orders(errors):
    """Of errors at steps that are halved each time."""
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def test_the_cell_alone_swings_as_the_closed_form_at_second_order():
    case, start = problem(), (1e-4, 0.02)
    period = 2 * np.pi * np.sqrt(case.suspended / case.stiffness)
    errors = []
    for parts in (1, 2, 4):
        dt = period / STEPS / parts
        time = dt * np.arange(1, parts * STEPS + 1)
        found = traced((-0.1, start[0], 0.0, start[1]), dt, parts)[[1, 3]]  # the sphere falls from
        # far above
        errors.append(
            np.abs(found - case.free_motion(start, time)).max(1)
            / case.free_motion(start, time).max(1)
        )
    assert (errors[0] < 2e-3).all()  # the period is off by (omega dt)^2 / 24 = 4e-5, the phase 2 pi
    # times that
    assert (np.abs(orders(errors) - 2) < 0.02).all(), orders(errors)


def test_a_sphere_dropped_on_the_bucket_is_two_masses_on_springs_at_second_order():
    case = problem()
    start = (0.0, 0.0, 0.8, 0.0)
    pulse = np.pi * np.sqrt(
        case.mass * case.suspended / (case.mass + case.suspended) / case.contact
    )
    dts, errors = [0.8 * pulse / STEPS / parts for parts in (1, 2, 4)], []
    for parts, dt in zip((1, 2, 4), dts, strict=True):
        exact = case.contact_motion(start, dt * np.arange(1, parts * STEPS + 1))
        assert (exact[0] > exact[1]).all()  # they touch throughout
        errors.append(np.abs(traced(start, dt, parts) - exact).max(1) / np.abs(exact).max(1))
    assert np.abs(exact[1]).max() > 0.2 * exact[0].max()  # the bucket gives way as much as the
    # contact does
    assert (errors[0] < 1e-4).all(), errors[0]
    assert (np.abs(orders(errors) - 2) < 0.05).all(), orders(errors)


def test_a_weight_put_down_at_once_swings_beyond_its_rest_as_the_closed_form():
    case = problem()
    _, x = case.at_rest
    assert case.stiffness * x / GRAVITY == pytest.approx(case.mass, rel=1e-12)
    half = np.pi * np.sqrt((case.mass + case.suspended) / case.stiffness)  # about: the contact is
    # 1e1 times as stiff
    dt = half / STEPS / 8
    exact = case.contact_motion((0.0, 0.0, 0.0, 0.0), dt * np.arange(1, 8 * STEPS + 1))
    together = exact[0] > exact[1]
    last = len(together) if together.all() else int(np.argmin(together))
    assert exact[1, :last].max() > 1.2 * x  # put down at once it swings beyond its rest
    np.testing.assert_allclose(
        traced((0.0, 0.0, 0.0, 0.0), dt, 8)[:2, :last], exact[:2, :last], atol=2e-3 * x
    )


def test_momentum_of_piece_and_bucket_changes_by_weight_and_spring_alone():
    case, dt = problem(damping=False), 1e-5
    start = (-1e-3, 2e-5, 0.5, 0.01)
    u, x, v, w = np.column_stack([start, traced(start, dt, 4, damping=False)])
    assert (u - x).min() < 0 < (u - x).max()  # before and in the impact
    push = case.mass * case.gravity - case.stiffness * x
    gained = np.append(0, np.cumsum(0.5 * dt * (push[1:] + push[:-1])))
    momentum = case.mass * v + case.suspended * w
    np.testing.assert_allclose(momentum - momentum[0], gained, atol=1e-13)


def test_free_flight_in_one_jump_is_that_of_single_steps():
    system, state = made()
    system = system.replace(dt=jnp.asarray(np.float64(1e-5)))
    above = state.position + np.array([[0.0], [0.0], [0.05]])
    state = state.replace_motion(position=above).replace(
        cell=LoadCellMotion(jnp.array([1e-4]), jnp.array([0.01]))
    )
    jumped, stepped = (
        jax.jit(integrator.ballistic_step)(system, state, jnp.int32(STEPS)),
        ran(system, state)[0],
    )
    for name in ("deflection", "velocity"):
        np.testing.assert_allclose(
            getattr(jumped.cell, name), getattr(stepped.cell, name), rtol=1e-11
        )


def test_walls_and_flaps_go_down_with_the_cell():
    """Also while they swing, and by far less than what single precision keeps of a height."""
    floor = {"group": "floor", "corners": [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)]}
    swinging = scene(bucket={"opening_angle_deg": 65.0}, run={"precision": "f32"}).replace(
        wall=[floor]
    )
    built = assembly.assemble_system(swinging)
    system = built.system
    held = jax.jit(kinematics.wall_state_at_rebuild)(system, jnp.int32(4000))
    cell = LoadCellMotion(*(jnp.asarray([x], system.dt.dtype) for x in (1.5e-9, 0.25)))
    moved = jax.jit(kinematics.apply_compliance)(system, built.state.replace(cell=cell), held)
    floor = system.walls.groups.index("floor")
    on_it = np.asarray(system.walls.group) != floor
    sunk = (np.asarray(held.rows[2], float) - np.asarray(moved.rows[2], float)) - np.asarray(
        moved.residual[2], float
    )
    np.testing.assert_allclose(sunk, 1.5e-9 * on_it, rtol=1e-6)
    np.testing.assert_allclose(held.rows[5] - moved.rows[5], 0.25 * on_it, rtol=1e-5)
    np.testing.assert_allclose(
        held.groups[5] - moved.groups[5], 0.25 * (np.arange(4) != floor), rtol=1e-5
    )
    np.testing.assert_array_equal(np.delete(held.rows, (2, 5), 0), np.delete(moved.rows, (2, 5), 0))


LANDING = {
    "height": TOUCH + 0.01,
    "restitution": 0.3,
    "rest_damping": 0.2,
    "cell": CELL | {"damping_ratio": 0.5},
}


@cache
def landing(duration):
    return dem_jax.simulate(scene(**LANDING, run={"duration": duration}))


def test_what_lies_in_the_bucket_is_weighed():
    run = landing(0.2)
    mass = 300 * 4 / 3 * np.pi * RADIUS**3
    cell = run.load_cell
    assert (cell["signal"][:100] == 0).all()  # nothing has landed: not the least force
    assert cell["signal"].max() > 10 * mass * GRAVITY
    assert cell["weight"][-1] == pytest.approx(mass, rel=1e-12)  # all has come to rest
    assert cell["deflection"][-1] == pytest.approx(mass * GRAVITY / CELL["stiffness"], rel=1e-12)
    c = 2 * 0.5 * np.sqrt(CELL["mass"] * CELL["stiffness"])
    np.testing.assert_allclose(
        cell["signal"], CELL["stiffness"] * cell["deflection"] + c * cell["velocity"], atol=1e-12
    )
    # the impulse of the pieces goes into momentum of the bucket and through the spring
    force = -(run.mean_force["wb_flaps"] + run.mean_force["wb_walls"])[:, 2]
    through = 1e-4 * np.cumsum(0.5 * (cell["signal"][1:] + cell["signal"][:-1]))
    gained = 1e-4 * np.cumsum(force)[1:] - CELL["mass"] * cell["velocity"][1:]
    np.testing.assert_allclose(through, gained, atol=3e-3 * gained.max())  # the signal by samples
    # of 0.1 ms


def test_the_summary_says_what_is_read_and_whether_the_cell_is_overloaded():
    run = landing(0.2)
    mass, most = run.load_cell["weight"][-1], np.abs(run.load_cell["weight"]).max()
    words = f"load cell: {1e3 * mass:.4g} g at the end, at most {most:.3g} kg of the rated "
    assert words + "5 kg" in summarize_run(run)
    weak = dem_jax.simulate(
        scene(**(LANDING | {"cell": LANDING["cell"] | {"rated_load": 0.1}}), run={"duration": 0.2})
    )
    assert words + "0.1 kg: beyond the rated load" in summarize_run(weak)
    assert not [line for line in summarize_run(weak) if "load cell" in line and words not in line]


def test_files_hold_the_readings_with_their_units_and_go_on_from_them(tmp_path):
    import h5py

    path = tmp_path / "run.h5"
    dem_jax.simulate(scene(**LANDING, run={"duration": 0.06}), out=path)  # the sphere rings on it
    with h5py.File(path) as file:
        units = {name: file[f"load_cell/{name}"].attrs["units"] for name in file["load_cell"]}
    assert units == {"deflection": "m", "velocity": "m/s", "signal": "N", "weight": "kg"}
    resumed = dem_jax.resume(path, duration=0.2)
    for name, array in landing(0.2).load_cell.items():
        np.testing.assert_array_equal(resumed.load_cell[name], array, err_msg=name)


def test_runs_of_an_ensemble_have_a_cell_each():
    two = dem_jax.ensemble(scene(**LANDING, run={"duration": 0.2}), runs=2)
    np.testing.assert_array_equal(two.load_cell["signal"][1], landing(0.2).load_cell["signal"])
    system = assembly.assemble_system(scene()).system
    assert not interleaved_batch.is_batch_worthwhile(system.replace(slot_block=64), 64)
    held = system.walls.replace(load_cell=None)
    assert interleaved_batch.is_batch_worthwhile(system.replace(slot_block=64, walls=held), 64)


def test_a_held_bucket_has_nothing_of_a_cell():
    held = assembly.assemble_system(scene(cell=None))
    assert held.state.cell is None and held.system.walls.load_cell is None
    assert "load_cell" not in {quantity.name for quantity in held.system.quantities}


def test_the_step_is_stable_with_a_bucket_that_weighs_next_to_nothing():
    """The largest eigenvalue of many pieces at once on the bucket, exactly, is below what the bound
    says.
    """
    light = scene(cell=CELL | {"mass": 1e-3})
    goods = assembly.piece_arrays.build_piece_set(light)
    law, materials = (
        assembly.contact_law.build_contact_law(light),
        assembly.contact_law.build_materials(light),
    )
    contacts = list_possible_contacts(
        law, materials, list(goods.shapes), assembly.piece_arrays.build_piece_arrays(light, goods)
    )
    held = 4 / min(float(np.min(law.stable_step(c.pair, c.mass))) for c in contacts) ** 2
    case, M, n = problem(), 1e-3, 7
    stiffness = held * case.mass
    matrix = np.diag([(CELL["stiffness"] + n * stiffness) / M] + n * [held])
    matrix[0, 1:] = matrix[1:, 0] = -stiffness / np.sqrt(M * case.mass)
    assert np.linalg.eigvalsh(matrix)[-1] < held + bound_load_cell_frequency(
        light, law, contacts, n
    )
    assert (
        assembly.assemble_system(light).step.stable
        < 0.5 * assembly.assemble_system(scene(cell=None)).step.stable
    )


def test_natural_frequency_and_defaults():
    cell = assembly.assemble_system(
        scene(cell={"mass": 2.0, "natural_frequency": 40.0})
    ).system.walls.load_cell
    assert float(np.sqrt(cell.stiffness / cell.mass)) == pytest.approx(2 * np.pi * 40)
    cell = assembly.assemble_system(scene(cell={})).system.walls.load_cell
    assert float(cell.stiffness) == pytest.approx(5.0 * 9.81 / 0.5e-3)
    assert float(cell.damping) == pytest.approx(2 * 0.02 * np.sqrt(float(cell.stiffness)))


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ({"stiffness": 1e5, "natural_frequency": 50.0}, "one of the two"),
        ({"mass": 0.0}, "mass"),
        ({"damping_ratio": -0.1}, "damping_ratio"),
        ({"spring": 1.0}, "spring"),
    ],
)
def test_what_is_no_load_cell_is_said(cell, words):
    plain = scene(cell=None)
    with pytest.raises(SceneError, match=words):
        plain.replace({"weigh_bucket.load_cell": cell})


def test_a_feed_bucket_hangs_on_no_cell():
    with pytest.raises(SceneError, match=r"feed_bucket\.load_cell"):
        dem_jax.load_scene("weigh-bucket").replace({"feed_bucket.load_cell": {}})
