"""A run as a differentiable function of numbers of its scene."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly, smooth_peak, validation, xla_flags
from dem_jax.assembly.topology import POSES, assemble, split_scene
from dem_jax.broad_phase import overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.errors import SceneError
from dem_jax.runner.rollout import check_numbers
from dem_jax.validation import plate_scene
from dem_jax.walls.motion.hermite_cubics import fit_hermite_cubics

DT = 4e-6  # s
SPEED, RADIUS, EPSILON = 2.2, 0.0167, 0.4  # m/s, m
TOUCH = 22.5 * DT  # s: half-way through a step, where the discrete peak is stationary in it, see
# test_gradients.py
HEIGHT = RADIUS + SPEED * TOUCH


def ball(**run):
    """A sphere just above a plate."""
    piece = {
        "shape": "sphere",
        "radius": RADIUS,
        "position": (0.0, 0.0, HEIGHT),
        "velocity": (0.0, 0.0, -SPEED),
    }
    run = {
        "time_step": DT,
        "sample_interval": 2 * DT,
        "duration": 300 * DT,
        "max_rebuild_interval": 32,
    } | run
    return plate_scene(
        piece,
        (0.0, 0.0, -9.81),
        run=run,
        restitution=EPSILON,
        friction_wall=0.0,
        friction_piece=0.0,
    )


PARAMETERS = {
    "material.restitution": np.array(EPSILON),
    "material.youngs_modulus": np.array(1e8),
    "material.density": np.array(300.0),
    "piece.0.velocity": np.array([0.0, 0.0, -SPEED]),
}


def outcome(parameters):
    """Smooth peak of the force (N), last momentum (kg m/s), and the top (N) of a parabola through
    the largest reading.
    """
    run = dem_jax.rollout(ball(), parameters)
    force = -run.force["plate"][:, 2]
    return jnp.stack([smooth_peak(force, 0.3), run.momentum[-1, 2], peak(force)])


def peak(force):
    """See test_gradients.py."""
    k = jnp.argmax(force)
    f0, f1, f2 = force[k - 2], force[k - 1], force[k]
    slope, bend = 0.5 * (3 * f2 - 4 * f1 + f0), f2 - 2 * f1 + f0
    return f2 - slope**2 / (2 * bend)


@cache
def reverse():
    """Compiled: outcomes and their derivatives with weights. All the time goes into compiling."""
    options = {
        "compiler_options": xla_flags.supported_options("cpu")
        | {"xla_backend_optimization_level": 0}
    }
    both = lambda p, weights: (lambda out, pull: (out, pull(weights)[0]))(*jax.vjp(outcome, p))
    return jax.jit(both, **options)


def test_gradients_equal_finite_differences():
    found = [reverse()(PARAMETERS, weights)[1] for weights in jnp.eye(3)]
    # So small that no step changes its branch of the law, so large that rounding of 50 N, 1e-14,
    # leaves 1e-6.
    steps = {
        "material.restitution": 1e-7,
        "material.youngs_modulus": 10.0,
        "material.density": 1e-4,
        "piece.0.velocity": 1e-8,
    }
    for key, h in steps.items():
        change = np.array([0.0, 0.0, h]) if key == "piece.0.velocity" else h
        high, low = (
            reverse()(PARAMETERS | {key: PARAMETERS[key] + s * change}, jnp.zeros(3))[0]
            for s in (1, -1)
        )
        finite = (np.asarray(high) - np.asarray(low)) / (2 * h)
        derivative = np.array([np.reshape(row[key], -1)[-1] for row in found])
        assert np.abs(derivative - finite).max() > 0 and np.isfinite(derivative).all()
        np.testing.assert_allclose(derivative, finite, rtol=2e-5, atol=50 * 1e-14 / h, err_msg=key)


def test_gradients_equal_the_closed_forms():
    """F = m g + sqrt((m g)^2 + m K v^2); restitution does not enter before the peak, and is all of
    the rebound after it.
    """
    system = assembly.assemble_system(ball()).system
    mass, stiffness = float(system.pieces.mass[0]), float(validation.wall_stiffness(system)[0])
    speed = np.sqrt(SPEED**2 + 2 * 9.81 * (HEIGHT - RADIUS))
    case = validation.NormalImpact(mass, stiffness, EPSILON, speed, 9.81)
    value, by = reverse()(PARAMETERS, jnp.array([0.0, 0.0, 1.0]))
    assert abs(value[2] / case.peak_force - 1) < 1e-3 and 0 < value[0] - value[2] < 0.3 * np.log(
        150
    )
    half, modulus = 0.5 * mass * stiffness * speed**2 / (case.peak_force - mass * 9.81), 1e8
    share = stiffness / (0.01 * modulus * 2 * RADIUS)  # d ln K / d ln E, of two bodies in series
    assert abs(by["material.youngs_modulus"] * modulus / (half * share) - 1) < 2e-3
    assert abs(by["piece.0.velocity"][2] * -speed / (2 * half) - 1) < 2e-3
    assert by["material.restitution"] == 0
    rebound = reverse()(PARAMETERS, jnp.array([0.0, 1.0, 0.0]))[1]["material.restitution"]
    assert abs(rebound / (mass * speed) - 1) < 0.05  # but for lambda's part


def test_forward_mode_and_many_at_once_give_the_same():
    """In forward mode, mapped over two impacts: values and derivatives are those of reverse mode
    one by one.
    """
    first, rest = (
        PARAMETERS["piece.0.velocity"],
        {k: v for k, v in PARAMETERS.items() if k != "piece.0.velocity"},
    )
    along = jnp.array([0.0, 0.0, 1.0])
    of_velocity = lambda v: jax.jvp(
        lambda v: outcome(rest | {"piece.0.velocity": v}), (v,), (along,)
    )
    options = {
        "compiler_options": xla_flags.supported_options("cpu")
        | {"xla_backend_optimization_level": 0}
    }
    values, slopes = jax.jit(jax.vmap(of_velocity), **options)(
        jnp.stack([jnp.asarray(first), 0.5 * jnp.asarray(first)])
    )
    for k, part in enumerate((1.0, 0.5)):
        parameters = rest | {"piece.0.velocity": part * first}
        both = [reverse()(parameters, weights) for weights in jnp.eye(3)]
        np.testing.assert_allclose(values[k], both[0][0], rtol=1e-9)
        np.testing.assert_allclose(
            slopes[k], [pull["piece.0.velocity"][2] for _, pull in both], rtol=1e-6
        )


def test_what_reverse_mode_keeps_changes_no_derivative(monkeypatch):
    """The states after all steps where there is room for them, else those at rebuilds: the same
    derivatives.
    """
    kept, real = [], stepping.rollout
    spy = lambda *given: kept.append(given[-1]) or real(*given)
    monkeypatch.setattr(stepping, "rollout", spy)
    jax.eval_shape(outcome, PARAMETERS)
    monkeypatch.setattr("dem_jax.runner.rollout.MOST_STATE_BYTES", 1000)  # bytes
    of_rebuilds = reverse.__wrapped__()(PARAMETERS, jnp.ones(3))
    assert kept == [False, True]
    for a, b in zip(
        jax.tree.leaves(reverse()(PARAMETERS, jnp.ones(3))),
        jax.tree.leaves(of_rebuilds),
        strict=True,
    ):
        assert np.any(a)
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_it_is_the_run_that_simulate_makes():
    scene = ball(track_energy=False)
    run = dem_jax.simulate(scene.replace({"material.restitution": 0.5}))
    found = jax.jit(partial(dem_jax.rollout, scene))({"material.restitution": 0.5})
    assert set(found.series) == set(run.series)
    np.testing.assert_allclose(found.time, run.time, rtol=1e-12)
    # Steps and pairs are the same, sums are taken in another order: 300 steps of rounding.
    np.testing.assert_allclose(found.force["plate"], run.force["plate"], atol=1e-9)
    np.testing.assert_allclose(found.momentum, run.momentum, atol=1e-14)
    with pytest.raises(AttributeError, match="no 'heat'; it has: contact_count, energy, force"):
        _ = found.heat


STATION = {
    "portion.shape": "sphere",
    "portion.radius": 0.01,
    "portion.count": 3,
    "material.pull_off": 0.01,
    "material.rest_damping": 0.1,
    "material.rolling_friction": 0.05,
    "weigh_bucket.load_cell": {"stiffness": 1e5},
    "weigh_bucket.opening_angle_deg": 10.0,
    "weigh_bucket.drive": {},
    "feed_bucket.drive": {"torque": 0.3},
}
WAYS = [[0.0, 0.0, 1e-3 * k] for k in range(4)]
TABLE = {
    "group": "plate",
    "times": [0.0, 0.01, 0.02, 0.04],
    "angles_deg": [0.0, 3.0, 5.0, 4.0],
    "displacements": WAYS,
}
SHAKE = {
    "group": "other",
    "stroke": (0.0, 0.0, 1e-3),
    "opening_angle_deg": 30.0,
    "drive": {"inertia": 2e-3},
}


def scenes():
    station = dem_jax.load_scene("weighing-station", STATION)
    walls = [ball().wall[0].model_dump(), ball().wall[0].model_dump() | {"group": "other"}]
    moving = ball().replace(
        wall=walls, motion=[TABLE, SHAKE], pair=[{"of": ["default", "wall"], "friction": 0.2}]
    )
    piece = moving.piece[0].model_dump() | {"material": "gum"}
    rough = {
        f"material.{key}": 0.3 for key in ("friction_wall", "friction_piece", "rolling_friction")
    }
    rough |= {"material.gum.density": 700.0, "piece": [piece]}
    return {"station": station, "moving": moving.replace(rough)}


def changed(topology, parameters):
    """Values of all parameters, a tenth less than the scene's own; of speeds with something added."""
    values = {}
    for key, form in topology.shapes.items():
        if (
            not key.endswith(("duration", "vibration_end")) and key not in POSES
        ):  # what ends before it
            # begins is no motion
            values[key] = parameters.get(key, np.full(form, 0.5)) * 0.9 + 0.01 * key.endswith(
                "velocity"
            )
    return values


@pytest.mark.parametrize("name", scenes())
def test_values_do_what_the_scene_s_own_numbers_do(name):
    """The arrays of system and state are those of a scene with these numbers."""
    scene = assembly.inline_files(
        scenes()[name].replace({"run.precision": "f64", "run.time_step": 2e-6})
    )
    made = assembly.assemble_system(scene)
    topology, own = split_scene(scene, made)
    values = changed(topology, own)
    assert len(values) > 30
    system, state = assemble(topology, own | values)
    plain = lambda value: tuple(map(tuple, value.tolist())) if value.ndim == 2 else value.tolist()
    new = assembly.assemble_system(
        scene.replace({key: plain(value) for key, value in values.items()})
    )
    walls = np.array(made.system.materials.is_wall)
    for found, wanted in ((system, new.system), (state.motion, new.state.motion)):
        leaves = zip(
            *(jax.tree_util.tree_flatten_with_path(tree)[0] for tree in (found, wanted)),
            strict=True,
        )
        for (path, one), (_, other) in leaves:
            where = jax.tree_util.keystr(path)
            if where.split(".")[1] in (
                "dt",
                "substeps",
                "domain_low",
                "domain_high",
                "reach",
                "skin",
            ):
                continue
            one, other = np.broadcast_arrays(one, other)
            if where.startswith(".materials") and one.ndim == 2:  # what stands between two walls
                # means nothing
                one, other = (np.where(np.outer(walls, walls), 0, table) for table in (one, other))
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13, err_msg=where)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            {"run.sample_interval": 1e-4},
            "run.sample_interval: decides the program or its sizes, or is .* allowed: material.density, .*run.gravity",
        ),
        ({"material.restitutio": 0.1}, "did you mean 'material.restitution'"),
        ({"piece.0.radius": 0.1}, "decides the program"),
        ({"piece.1.position": [0.0, 0.0, 1.0]}, "is no key of the scene"),
        ({"piece.0.position": 1.0}, r"piece.0.position: a value of the form \(\); allowed: \(3,\)"),
        ({"material.pull_off": 1.0}, "material.pull_off: the scene has 0"),
        ({"material.friction_wall": 1.0}, "material.friction_wall: the scene has 0"),
        ({"material.rest_damping": 1.0}, "material.rest_damping: the scene has 0"),
        (
            {"material.youngs_modulus": -1e8},
            r"material\.youngs_modulus = -100000000\.0: allowed: a number > 0",
        ),
        (
            {"material.restitution": 1.5},
            r"material\.restitution = 1\.5: allowed: a number > 0 and <= 1",
        ),
        (
            {"material.poisson_ratio": np.float32(0.5)},
            r"material\.poisson_ratio = 0\.5: allowed: a number >= 0 and < 0\.5",
        ),
        (
            {"run.gravity": [0.0, 0.0, np.nan]},
            r"run\.gravity = \[0\.0, 0\.0, nan\]: allowed: a list of 3",
        ),
        (
            {"piece.0.orientation": jnp.zeros(4)},
            r"piece\.0\.orientation = .*: allowed: a quaternion that is not zero",
        ),
        ({"material.density": 1e-6}, r"run\.time_step = .*: allowed: at most .* s"),
    ],
)
def test_what_decides_the_program_is_refused_in_one_line(parameters, message):
    with pytest.raises(SceneError, match=message) as error:
        dem_jax.rollout(ball(), parameters)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", scenes())
def test_every_number_has_the_limits_of_the_scene(name):
    """Below any of them for each key that has one; what is traced passes."""
    scene = assembly.inline_files(scenes()[name])
    made = assembly.assemble_system(scene)
    free = {
        "height",
        "opening_angle_deg",
        "start",
        "opening_start",
        "vibration_start",
        "vibration_end",
    }
    refused = 0
    for key, form in split_scene(scene, made)[0].shapes.items():
        if form or key.split(".")[-1] in free:
            continue
        try:
            check_numbers(scene, made, {key: -1e3})
        except SceneError as error:
            refused += "the scene has 0" not in str(error)
        else:
            pytest.fail(f"{key} = -1000 is taken")
    assert refused > 20
    traced = jax.eval_shape(
        lambda e: check_numbers(scene, made, {"material.restitution": e}) or e,
        jax.ShapeDtypeStruct((), float),
    )
    assert traced.shape == ()


def test_a_value_that_makes_the_time_step_unstable_is_refused():
    with pytest.raises(
        SceneError,
        match=r"density = 0\.001: the scene's time step, .* is not stable with it; allowed: .* at most",
    ):
        dem_jax.rollout(ball(time_step="auto"), {"material.density": 1e-3})


def test_double_precision_is_asked_for():
    with jax.enable_x64(False), pytest.raises(SceneError, match="jax_enable_x64"):
        dem_jax.rollout(ball(), {})


def test_a_run_that_outgrew_its_room_is_told():
    made = assembly.assemble_system(ball())
    good = made.state.guard
    for bad in (good.replace(travel=2 * made.system.skin), good.replace(touching=jnp.int32(99))):
        assert overflow_recovery.describe_overflow(
            made.system, jax.device_get(bad)
        ) and not overflow_recovery.is_within_capacity(made.system, bad)
    assert not overflow_recovery.describe_overflow(
        made.system, jax.device_get(good)
    ) and overflow_recovery.is_within_capacity(made.system, good)
    assert overflow_recovery.with_all_pairs(made.system).skin > 100 and made.system.skin < 2e-3
    assert (
        overflow_recovery.with_all_pairs(made.system.replace(touching=0)).skin == made.system.skin
    )


def test_a_smooth_peak_tends_to_the_peak():
    values = 40.0 - 0.02 * (np.arange(-300, 300) - 0.3) ** 2
    both = jax.jit(jax.value_and_grad(smooth_peak))
    for width in (3.0, 0.3, 0.1):
        value, weights = both(values, width)
        assert float(value) == pytest.approx(
            40.0 + 0.5 * width * np.log(np.pi * width / 0.02), abs=1e-6 * width
        )
        assert float(weights.sum()) == pytest.approx(1.0) and int(weights.argmax()) == 300
    assert float(both(values, 1e-4)[0]) == pytest.approx(values.max(), abs=1e-9)


def test_cubics_of_values_that_are_differentiated_are_those_of_numbers():
    times, random = np.cumsum(np.array([0.0, 0.1, 0.3, 0.05, 0.2, 0.4])), np.random.default_rng(0)
    for values in (random.normal(size=6), np.sort(random.normal(size=6)), np.zeros(6)):
        found = jax.jit(partial(fit_hermite_cubics, times))(values)
        np.testing.assert_allclose(found, fit_hermite_cubics(times, values), rtol=1e-12, atol=1e-10)
    assert np.isfinite(jax.jit(jax.jacfwd(partial(fit_hermite_cubics, times)))(jnp.zeros(6))).all()
