"""The simulation as pure functions: model, assemble and step, under jit, vmap, grad and lax.scan."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly, xla_flags
from dem_jax.errors import SceneError
from dem_jax.validation import plate_scene

DT = 4e-6  # s
SPEED, RADIUS = 2.2, 0.0167  # m/s, m
STEPS = 300
HEIGHT = RADIUS + 22.5 * DT * SPEED  # m: the first touch is half-way through a step
BLOCK, SKIN = 8, 1e-5  # steps between rebuilds; m
KEYS = ("material.restitution", "material.youngs_modulus", "material.density", "run.gravity")


def ball(**material):
    """A sphere just above a plate, in double precision."""
    piece = {
        "shape": "sphere",
        "radius": RADIUS,
        "position": (0.0, 0.0, HEIGHT),
        "velocity": (0.0, 0.0, -SPEED),
    }
    run = {
        "time_step": DT,
        "sample_interval": 2 * DT,
        "duration": STEPS * DT,
        "max_rebuild_interval": BLOCK,
    }
    smooth = {"friction_wall": 0.0, "friction_piece": 0.0, "restitution": 0.4} | material
    return plate_scene(piece, (0.0, 0.0, -9.81), run=run, **smooth)


@cache
def parts():
    return dem_jax.model(ball())


def jitted(function, **options):
    """Compiled quickly."""
    return jax.jit(
        function,
        compiler_options=xla_flags.supported_options("cpu") | {"xla_backend_optimization_level": 0},
        **options,
    )


def scan_steps(system, state):
    return jax.lax.scan(lambda state, _: dem_jax.step(system, state), state, None, length=STEPS)


COMPILED_SCAN = jitted(scan_steps)


@partial(jitted, static_argnums=0)
def run_all(topology, batch):
    """Last momentum (kg m/s) and largest force (N) for each row of parameters."""

    def run(parameters):
        samples = scan_steps(*dem_jax.assemble(topology, parameters))[1]
        return samples.momentum[-1, 2], -samples.force["plate"][:, 2].min()

    return jax.vmap(run)(batch)


def in_rows(rows):
    """Parameters of several runs as one tree."""
    return jax.tree.map(lambda *values: jnp.stack([jnp.asarray(value) for value in values]), *rows)


def test_a_scan_of_steps_is_the_run_that_simulate_makes():
    topology, parameters = parts()
    assert (
        topology.steps == STEPS and topology.steps_per_sample == 2 and topology.settling_steps == 0
    )
    system, state = dem_jax.assemble(topology, parameters)
    state, samples = COMPILED_SCAN(system, state)
    run = dem_jax.simulate(ball())
    assert int(state.step) == STEPS and not dem_jax.has_overflowed(system, state)
    assert set(samples.values) == set(run.series)
    # Steps and pairs are the same; sums are taken in another order: 300 steps of rounding.
    ends = slice(topology.steps_per_sample - 1, None, topology.steps_per_sample)
    for name, tolerance in (
        ("force", 1e-9),
        ("mean_force", 1e-9),
        ("peak_force", 1e-9),
        ("energy", 1e-14),
    ):
        for row, values in getattr(run, name).items():
            np.testing.assert_allclose(
                samples.values[name][row][ends], values, atol=tolerance, err_msg=name
            )
    np.testing.assert_allclose(samples.momentum[ends], run.momentum, atol=1e-14)


def test_steps_find_candidate_pairs_anew():
    """With a skin that does not reach the plate at first, the bits are those with all pairs at all times."""
    system, start = dem_jax.assemble(*parts())
    state, samples = COMPILED_SCAN(system, start)
    near = system.replace(skin=jnp.full_like(system.skin, SKIN))
    last, found = COMPILED_SCAN(near, start)
    assert (
        float(system.skin) > 100
        and int(last.scratch.rebuild_step) == STEPS - 1 - (STEPS - 1) % system.block_steps
    )
    np.testing.assert_array_equal(found.force["plate"], samples.force["plate"])
    assert BLOCK * SPEED * DT + SKIN < HEIGHT - RADIUS and np.any(found.force["plate"])


def test_the_gradient_is_that_of_finite_differences():
    """Of many parameters at once by reverse mode; the values of vmap serve as differences."""
    topology, parameters = parts()

    def momentum(chosen):
        samples = scan_steps(*dem_jax.assemble(topology, parameters | chosen))[1]
        return samples.momentum[-1, 2]

    chosen = {key: jnp.asarray(parameters[key]) for key in KEYS}
    gradient = jitted(jax.grad(momentum))(chosen)
    # So small that no step changes its branch of the law, so large that rounding of 0.03 kg m/s, 1e-17, leaves 1e-6.
    sizes = {
        "material.restitution": 1e-7,
        "material.youngs_modulus": 10.0,
        "material.density": 1e-4,
        "run.gravity": 1e-5,
    }
    along = {
        key: np.array([0.0, 0.0, h]) if key == "run.gravity" else h for key, h in sizes.items()
    }
    rows = [
        parameters | {key: parameters[key] + sign * along[key]} for key in KEYS for sign in (1, -1)
    ]
    values = np.asarray(run_all(topology, in_rows(rows))[0]).reshape(len(KEYS), 2)
    for (high, low), key in zip(values, KEYS, strict=True):
        finite = (high - low) / (2 * sizes[key])
        assert abs(finite) > 0
        np.testing.assert_allclose(
            np.ravel(gradient[key])[-1], finite, rtol=2e-5, atol=1e-16 / sizes[key], err_msg=key
        )


def test_runs_of_vmap_are_single_runs():
    topology, parameters = parts()
    rows = [
        parameters | {"material.restitution": np.array(0.3 + 0.05 * k)}
        for k in range(2 * len(KEYS))
    ]
    momentum, largest = run_all(topology, in_rows(rows))
    for k in (0, 5):
        samples = COMPILED_SCAN(*dem_jax.assemble(topology, rows[k]))[1]
        np.testing.assert_allclose(momentum[k], samples.momentum[-1, 2], rtol=1e-12)
        np.testing.assert_allclose(largest[k], -samples.force["plate"][:, 2].min(), rtol=1e-12)
    assert len(np.unique(momentum)) == len(rows)


def test_a_rebuild_stays_a_branch_under_vmap():
    """Else each run would pay for one in each step."""
    topology, parameters = parts()
    once = lambda parameters: dem_jax.step(*dem_jax.assemble(topology, parameters))[1].momentum  # noqa: E731
    batch = jax.tree.map(lambda value: np.stack([value, value]), parameters)
    jaxpr = jax.make_jaxpr(jax.vmap(once))(batch)
    assert [equation.primitive.name for equation in jaxpr.eqns].count("cond") == 1


def test_topologies_of_one_program_are_equal_and_compile_once():
    topology, parameters = parts()
    other, changed = dem_jax.model(ball(density=350.0, restitution=0.5))
    assert topology == other and hash(topology) == hash(other) and topology is not other
    assert changed["material.density"] == 350.0 and changed.keys() == parameters.keys()
    larger = dem_jax.model(
        ball().replace({"piece": [ball().piece[0].model_dump() | {"radius": 0.02}]})
    )[0]
    rough = dem_jax.model(ball(friction_wall=0.1))[0]
    assert topology != larger and topology != rough and topology != "a topology"
    traced = []

    @partial(jax.jit, static_argnums=0)
    def mass(topology, parameters):
        traced.append(topology)
        return dem_jax.assemble(topology, parameters)[0].pieces.mass[0]

    masses = [mass(topology, parameters), mass(other, changed)]
    assert len(traced) == 1 and masses[1] / masses[0] == pytest.approx(350 / 300, rel=1e-12)


@pytest.mark.parametrize("name", ["plate-drop", "weighing-station"])
def test_parameters_of_a_scene_give_the_arrays_of_its_run(name):
    """The bits of the system and of the state that simulate begins with."""
    scene = dem_jax.load_scene(name, {"portion.count": 3} if name != "plate-drop" else {})
    built = assembly.assemble_system(assembly.inline_files(scene), 2)
    system, state = dem_jax.assemble(*dem_jax.model(scene, seed=2))
    beside = ("skin",)  # that of all pairs, see overflow_recovery.with_all_pairs
    for (path, one), (_, other) in zip(
        *map(jax.tree_util.tree_leaves_with_path, (system, built.system)), strict=True
    ):
        if jax.tree_util.keystr(path, simple=True) not in beside:
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other, err_msg=jax.tree_util.keystr(path))
    jax.tree.map(np.testing.assert_array_equal, state.motion, built.state.motion)


def test_all_numbers_that_enter_arrays_only_are_parameters():
    """As their sections mark them, but for those that nothing in the program depends on."""
    station = dem_jax.model("weighing-station")[1]
    assert {
        "material.density",
        "run.gravity",
        "drop.height",
        "feed_bucket.opening_time",
        "feeder.stroke",
    } <= station.keys()
    assert station["portion.position"].shape[1] == 3
    drop = dem_jax.model("plate-drop")[1]
    assert (
        not {"drop.height", "material.pull_off", "material.rest_damping", "portion.position"}
        & drop.keys()
    )
    piece = {
        "shape": "sphere",
        "radius": RADIUS,
        "position": (0.0, 0.0, 0.1),
        "material": "gum",
        "piece_weight": 0.01,
    }
    foam = {"contact.law": "densifying", "material.gum.friction_wall": 0.5, "piece": [piece]}
    topology, parameters = dem_jax.model(ball().replace(foam))
    assert "contact.densification" in parameters and "material.density" not in parameters
    assert (
        "material.gum.restitution" not in parameters
        and "material.gum.restitution" in topology.shapes
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"material.density": None},
            "material.density: missing; allowed: all parameters that dem_jax.model returns",
        ),
        ({"material.densiti": 1.0}, "did you mean 'material.density'"),
        ({"piece.0.radius": 1.0}, "piece.0.radius: decides the program"),
        ({"material.pull_off": 1.0}, "material.pull_off: the scene has 0"),
        ({"run.gravity": 9.81}, r"run.gravity: a value of the form \(\); allowed: \(3,\)"),
    ],
)
def test_what_is_no_parameter_is_refused_in_one_line(change, message):
    topology, parameters = parts()
    given = {key: value for key, value in (parameters | change).items() if value is not None}
    with pytest.raises(SceneError, match=message) as error:
        dem_jax.assemble(topology, given)
    assert "\n" not in str(error.value)


def test_pieces_that_come_and_go_are_refused():
    scene = dem_jax.load_scene("weighing-station", {"outlet": {}})
    with pytest.raises(SceneError, match=r"\[inlet\], \[outlet\]"):
        dem_jax.model(scene)


def test_a_state_that_missed_contacts_is_told():
    system, state = dem_jax.assemble(*parts())
    assert not dem_jax.has_overflowed(system, state)
    assert dem_jax.has_overflowed(
        system, state.replace(guard=state.guard.replace(touching=jnp.int32(99)))
    )
