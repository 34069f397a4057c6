"""A piece at rest on a plate: the law's ringing, the mean force, and the two kinds of damping that
end the ringing.
"""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import assembly, validation
from dem_jax.contact_laws import quasi_static_damping
from dem_jax.dynamics import observables
from dem_jax.errors import SceneError
from dem_jax.runner import undamped_rest
from dem_jax.scene import load_scene

G = 9.81  # m/s2
DROP = 2e-3  # m: 0.2 m/s, which at epsilon = 0.1 does not bounce off (threshold 0.743 m/s)


@partial(jax.jit, static_argnames="every")
def fall(system, state, damping, every):
    """400 readings, and the mean force of each interval between them."""
    system = validation.with_permanent_pairs(system).replace(
        law=system.law.replace(damping=damping)
    )

    def read(system, state):
        return validation.read_motion(system, state) | {"impulse": state.ledger.impulse[2, 0, 0]}

    return validation.trace_motion(system, state, 400, read, every)[1]


@pytest.mark.parametrize(("shape", "half"), [("sphere", 0.0166785), ("chamfered-cuboid", 0.008)])
def test_rest(shape, half):
    piece = {"shape": shape, "position": (0.0, 0.0, half + DROP)} | (
        {"radius": half} if shape == "sphere" else {}
    )
    made = assembly.assemble_system(
        validation.plate_scene(piece, (0.0, 0.0, -G), unloading_damping=0.2)
    )
    weight = float(made.system.pieces.mass[0]) * G
    every = round(5e-4 / made.step.dt)
    time = made.step.dt * every * np.arange(1, 401)
    late = time > 0.15
    for damping in (0.0, 0.2):
        found = fall(made.system, made.state, jnp.asarray(damping), every)
        force, speed = (
            np.asarray(found["force"])[late],
            np.abs(np.asarray(found["velocity"])[late, 2]),
        )
        # The impulse on the plate over 50 ms against m g t: what is missing is a change of
        # momentum, at most m v twice.
        pushed = -np.diff(np.asarray(found["impulse"])[late][[0, -1]])[0]
        length = time[late][-1] - time[late][0]
        assert abs(pushed / (weight * length) - 1) < 2 * speed.max() / (G * length) + 1e-9
        assert abs(pushed / (weight * length) - 1) < 0.005
        if damping:
            # Damped at a fifth of critical: e^(-0.2 omega_2 t) is nothing after a millisecond or
            # two of contact.
            assert np.abs(force / weight - 1).max() < 1e-6
            assert speed.max() < 1e-9
        else:
            # Rings for ever between hardly any force and twice the weight, at a speed far below the
            # 0.1 m/s of settled.
            assert np.ptp(force) > 0.5 * weight
            assert force.min() >= 0 and force.max() < 4 * weight
            assert 1e-5 < speed.max() < 2e-3


def test_damping_is_off_by_default():
    assert load_scene("plate-drop").material.unloading_damping == 0
    assert load_scene("weigh-bucket").material.unloading_damping == 0
    made = assembly.assemble_system(load_scene("weigh-bucket"))
    assert made.system.law.at_rest is None
    history = jax.tree.leaves([table.memory.law for table in made.state.contacts.values()])
    assert len(history) == 3 * len(made.state.contacts)  # normal force and way, tangential force,
    # nothing else


def test_damping_leaves_the_first_peak_alone():
    # It acts below the loading line only, which the first impact does not leave before its peak.
    piece = {"position": (0.0, 0.0, 0.008 + DROP)}
    made = assembly.assemble_system(
        validation.plate_scene(piece, (0.0, 0.0, -G), unloading_damping=0.2)
    )
    every = 10  # of 6 us: 24 ms, the fall takes 20
    peaks = [
        np.asarray(fall(made.system, made.state, jnp.asarray(d), every)["force"])
        for d in (0.0, 0.2)
    ]
    assert peaks[0].max() == peaks[1].max() > 1.0


# Damping at rest, contact.law.rest.
EVERY, READINGS = 5, 1500  # steps of 44 us: 0.33 s
TILTED = [(1.0, 0.0, 0.0, 0.0), (0.9, 0.3, 0.2, 0.1), (0.5, 0.7, -0.3, 0.2)]  # on a face, an edge,
# a corner


@jax.jit
def slow_motion(system, state):
    def read(system, state):
        found = validation.read_motion(system, state) | {
            "energy": observables.energy_terms(system, state)[:, 0]
        }
        return found | {"age": jnp.max(state.contacts["hulls"].memory.law.resting.age)}

    return validation.trace_motion(
        validation.with_permanent_pairs(system), state, READINGS, read, EVERY
    )[1]


@pytest.fixture(scope="module")
def damped():
    """A marshmallow on a plate that leans by 10 degrees."""
    angle = np.radians(10.0)
    gravity = (float(G * np.sin(angle)), 0.0, float(-G * np.cos(angle)))
    piece = {"position": (0.0, 0.0, 0.008 + 1e-4)}
    return assembly.assemble_system(
        validation.plate_scene(piece, gravity, restitution=0.7, rest_damping=0.2)
    )


def test_a_piece_on_a_slope_comes_to_rest(damped):
    found = jax.tree.map(np.asarray, slow_motion(damped.system, damped.state))
    assert found["age"][-1] > 1
    # Rings at 0.5 kHz and is damped at a fifth of critical: hardly anything is left after 0.1 s of
    # rest, nothing after 0.2 s.
    late = slice(2 * READINGS // 3, None)
    assert np.abs(found["velocity"][late]).max() < 1e-8
    assert np.abs(found["velocity"][-50:]).max() < 2e-12
    assert np.ptp(found["position"][late], axis=0).max() < 1e-11
    weight = float(damped.system.pieces.mass[0]) * -float(damped.system.gravity[2])
    assert np.abs(found["force"][late] / weight - 1).max() < 1e-6
    # The ledger has what the dashpots took: nothing appears, and the total stays to second order in
    # the time step.
    total, lost = found["energy"][:, 5], found["energy"][:, 3]
    fell = weight * 1e-4
    assert np.abs(total - total[0]).max() < 0.02 * fell
    assert fell < lost[-1] < 1.5 * fell  # it slides on a little


@pytest.mark.parametrize("restitution", [0.1, 0.5])
def test_what_rings_up_to_the_loading_line_in_each_period_comes_to_rest(restitution):
    piece = {"position": (0.0, 0.0, 0.008 + 1e-4)}
    made = assembly.assemble_system(
        validation.plate_scene(piece, (0.0, 0.0, -G), restitution=restitution, rest_damping=0.2)
    )
    found = jax.tree.map(np.asarray, slow_motion(made.system, made.state))
    assert np.abs(found["velocity"][:100]).max() > 1e-3
    assert found["age"][-1] > 1
    assert np.abs(found["velocity"][-50:]).max() < 1e-12


@pytest.mark.parametrize("orientation", TILTED, ids=["face", "edge", "corner"])
def test_no_impact_feels_the_damping_at_rest(damped, orientation):
    q = np.asarray(orientation) / np.linalg.norm(orientation)
    state = damped.state.replace_motion(
        position=jnp.array([[0.0], [0.0], [0.04]]),
        velocity=jnp.array([[0.0], [0.0], [-2.0]]),
        orientation=jnp.asarray(q)[:, None],
    )
    found = {k: np.asarray(v) for k, v in slow_motion(damped.system, state).items()}
    begin = np.argmax(found["force"] > 0)
    length = np.argmax(found["force"][begin:] == 0)
    assert length > 2
    # It never comes near to rest, and below an age of 1 nothing is added at all:
    # test_nothing_is_added_before_rest.
    assert found["age"][: begin + length].max() < 0.5


def test_nothing_is_added_before_rest():
    ages = jnp.array([0.0, 0.5, 1 - 1e-9])
    one = jnp.ones(3)
    spring = quasi_static_damping.DampedSpring(one, one, one, one, 0.2 * one)
    ways = (one, one, one)
    assert (quasi_static_damping.normal_damping_force(ages, spring, one, 0.1, -one, one) == 0).all()
    for found, elastic in zip(
        quasi_static_damping.damped_friction(ages, spring, one, ways, ways, 0.1 * one, 0.1),
        ways,
        strict=True,
    ):
        assert (found == elastic).all()
    torque, elastic = quasi_static_damping.damped_torque(
        quasi_static_damping.QuasiStaticHistory(ages, jnp.ones((3, 3))),
        ages,
        spring,
        ways,
        one,
        0.1,
    )
    assert (jnp.stack(torque) == 0).all() and (jnp.stack(elastic) == 0).all()


def test_rest_begins_after_ten_quarter_periods_and_outlasts_a_touch():
    one = jnp.ones(1)
    spring = quasi_static_damping.DampedSpring(one, one, one, one, 0.2 * one)
    quarter = np.pi / 2
    age, steps = jnp.zeros(1), 0
    while age[0] < 1:
        age, steps = (
            quasi_static_damping.update_rest_age(age, True, spring, 0.01 * quarter),
            steps + 1,
        )
    assert abs(steps - 1000) <= 1
    age = quasi_static_damping.update_rest_age(age, True, spring, 0.01 * quarter)
    touched = quasi_static_damping.update_rest_age(age, False, spring, 0.5 * quarter)
    assert (
        touched[0] >= 1
        and quasi_static_damping.update_rest_age(touched, True, spring, 0.01 * quarter)[0] == 2
    )
    assert quasi_static_damping.update_rest_age(touched, False, spring, 0.6 * quarter)[0] == 0


def test_what_may_be_asked_of_damping_at_rest():
    with pytest.raises(SceneError, match=r"material\.rest_damping.*0\.5"):
        load_scene("plate-drop").replace({"material.rest_damping": 0.6})
    with pytest.raises(
        SceneError, match=r'material\.rest_damping = 0\.2: law "linear-dashpot" has no such key'
    ):
        load_scene("plate-drop").replace(
            {"material.rest_damping": 0.2, "contact.law": "linear-dashpot"}
        )


@pytest.mark.parametrize(
    ("changes", "fastest", "end", "is_said"),
    [
        ({}, 0.005, 300, True),
        ({}, 0.005, 199, False),  # not 2 s yet
        ({}, 0.2, 300, False),  # faster than run.settled_speed
        ({"material.rest_damping": 0.2}, 0.005, 300, False),
        ({"material.unloading_damping": 0.05}, 0.005, 300, False),
        ({"contact.law": "linear-dashpot"}, 0.005, 300, False),
        ({"run.gravity": (0.0, 0.0, 0.0)}, 0.005, 300, False),  # slow, but at rest on nothing
    ],
)
def test_runs_say_where_rest_is_not_damped(changes, fastest, end, is_said):
    job = SimpleNamespace(
        scene=load_scene("plate-drop").replace({"run.sample_interval": 0.01} | changes),
        own_law=False,
    )
    samples = SimpleNamespace(fastest=np.array([[fastest] * 300, [1.0] * 300]))  # of two runs
    span = SimpleNamespace(count=end, end=end, samples=samples)
    assert undamped_rest.note_undamped_rest(job, span) == (
        [undamped_rest.UNDAMPED_NOTE] if is_said else []
    )
