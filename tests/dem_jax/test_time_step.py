"""The time step: how it is chosen, what limits it, and the errors that its resolution leaves."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import assembly, ensemble, shapes, simulate, validation
from dem_jax.contact_laws import walton_braun
from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.validation import NormalImpact
from tests.dem_jax.impacts import trace_impacts

MASS = 5.832e-3  # kg
DIAMETER = (6 * 19440e-9 / np.pi) ** (1 / 3)  # m, of the sphere of equal volume


def step_of(run=None, piece=None, **material):
    """The choice of the time step of a scene."""
    return assembly.assemble_system(validation.plate_scene(piece or {}, run=run, **material)).step


def exact_quarter(softening=1.0):
    """Quarter period (s) of the marshmallow on the plate, from eqs 5, 7 and 8."""
    own, wall = softening * 1e8 * DIAMETER, softening * 1e11 * DIAMETER
    return np.pi / 2 * np.sqrt(MASS / (own * wall / (own + wall)))


def test_stiffness_of_the_marshmallow():
    system = assembly.assemble_system(validation.plate_scene({})).system
    pieces = system.pieces
    # printed digits
    np.testing.assert_allclose(validation.wall_stiffness(system), 33327.17, rtol=2e-7)
    np.testing.assert_allclose(pieces.mass, MASS, rtol=1e-12)


def test_softening_by_a_hundred_makes_steps_ten_times_longer():
    # Both moduli are softened, so that K_nl goes with the softening factor and the step with its
    # root.
    np.testing.assert_allclose(
        step_of(numerical_softening=0.01).critical / step_of(numerical_softening=1.0).critical,
        10,
        rtol=1e-12,
    )


@pytest.mark.parametrize("epsilon", [0.1, 0.3, 0.5, 0.9])
def test_critical_step_is_the_smaller_of_loading_and_unloading(epsilon):
    # 15 steps per loading and 10 per unloading quarter period, which is epsilon times as long:
    # equal at 2/3.
    step = step_of(restitution=epsilon, numerical_softening=0.01)
    load, unload = exact_quarter(0.01) / 15, epsilon * exact_quarter(0.01) / 10
    np.testing.assert_allclose(step.critical, min(load, unload), rtol=1e-9)
    assert ("unloading" in step.limit) == (unload < load)
    assert "chamfered-cuboid" in step.limit and "wall" in step.limit


def test_step_divides_the_sample_interval():
    step = step_of()
    assert step.dt <= step.critical
    np.testing.assert_allclose(step.dt * step.substeps, 30e-6, rtol=1e-14)
    asked = step_of(run={"time_step": 4e-6})
    assert asked.substeps == 8 and asked.dt <= 4e-6


def test_limit_is_the_quickest_of_all_contacts_that_can_be():
    """Of forty kinds, one of them twice, against a search through all pairs."""
    random = np.random.default_rng(0)
    rows = [{"shape": "sphere", "radius": r} for r in random.uniform(0.01, 0.03, 20)]
    rows += [
        {"shape": "cuboid", "size": tuple(size)}
        for size in random.uniform(0.01, 0.05, (20, 3)).tolist()
    ]
    rows += rows[-1:]
    pieces = [{**row, "position": (0.1 * k, 0.0, 0.0)} for k, row in enumerate(rows)]
    floor = {"group": "floor", "corners": [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)]}
    scene = Scene(piece=pieces, wall=[floor], material={"restitution": 0.5})
    goods = assembly.piece_arrays.build_piece_set(scene)
    made, arrays = goods.shapes, assembly.piece_arrays.build_piece_arrays(scene, goods)
    m, k, e = (
        arrays.mass,
        0.01 * 1e8 * arrays.size,
        np.array([assembly.time_step._normal_mass_ratio(shape) for shape in made]),
    )
    wall = 0.01 * 1e11 * arrays.size
    slow = [m / (k * wall / (k + wall)), m * e / (k * wall / (k + wall))]
    i, j = np.triu_indices(len(made), 1)
    pair = m[i] * m[j] / (m[i] + m[j]) * (k[i] + k[j]) / (k[i] * k[j])
    slow = [
        np.concatenate(both).min()
        for both in zip(slow, (pair, pair * np.minimum(e[i], e[j])), strict=True)
    ]
    law, materials = (
        assembly.contact_law.build_contact_law(scene),
        assembly.contact_law.build_materials(scene),
    )
    step = assembly.choose_step(
        scene, law, assembly.time_step.list_possible_contacts(law, materials, made, arrays)
    )
    np.testing.assert_allclose(
        step.critical, np.pi / 2 * np.sqrt(slow[0]) * min(1 / 15, 0.5 / 10), rtol=1e-12
    )
    both_sides = np.sqrt(2)  # of a body that is pressed from there
    np.testing.assert_allclose(
        step.linear_limit, 2 * 0.5 * np.sqrt(slow[1]) / both_sides, rtol=1e-12
    )


def test_limit_is_the_smallest_piece():
    small = {"shape": "sphere", "radius": 0.002, "position": (0.0, 0.0, 0.05)}
    large = {"shape": "chamfered-cuboid", "position": (0.0, 0.0, 0.2)}
    scene = validation.plate_scene(large).replace(piece=[large, small])
    both, alone = assembly.assemble_system(scene).step, step_of(piece=small)
    # Against the wall: its own mass on nearly its own stiffness. Against the marshmallow: series
    # stiffness, but nearly the same mass. The wall is the stiffer one.
    np.testing.assert_allclose(both.critical, alone.critical, rtol=1e-12)
    assert "sphere" in both.limit


def test_pair_and_wall_limit_alike():
    # Two like pieces: half the mass on half the stiffness, so the wall's K_nl, 0.1 % below E_p L,
    # is what differs.
    two = [{"position": (0.0, 0.0, 0.1)}, {"position": (0.0, 0.0, 0.2)}]
    pair = assembly.assemble_system(validation.plate_scene({}).replace(piece=two)).step.critical
    np.testing.assert_allclose(pair, step_of().critical, rtol=6e-4)
    assert pair < step_of().critical


def test_a_step_that_is_not_stable_is_refused_unless_it_is_allowed_by_name():
    limits = step_of()
    stable, linear = limits.stable, limits.linear_limit
    with pytest.raises(
        SceneError,
        match=r"run\.time_step = .*at most .* gains more than 1 % of its energy; with run\.allow",
    ):
        step_of(run={"time_step": 1.01 * stable})
    allowed = {"sample_interval": 1e-3, "allow_unstable_step": True}
    assert stable < step_of(run={"time_step": 1.1 * stable} | allowed).dt <= 1.1 * stable
    with pytest.raises(
        SceneError, match=r"run\.time_step = .*allowed: at most .* s, the linear stability limit"
    ):
        step_of(run={"time_step": 1.01 * linear} | allowed)
    steps = [
        step_of(run={**allowed, "time_step": q * linear, "sample_interval": q * linear})
        for q in (0.1, 0.5, 0.51)
    ]
    assert [step.resolved for step in steps] == [1, 1, 0]


BALL = {"shape": "sphere", "radius": 0.01}


def ball(run=None, walls=(), **changes):
    """A sphere over the plate, epsilon = 1, friction 0.3, without gravity."""
    settings = {
        "gravity": (0.0, 0.0, 0.0),
        "precision": "f64",
        "frame_interval": 0.0,
        "sample_interval": 1e-3,
        "duration": 0.01,
        **(run or {}),
    }
    scene = validation.plate_scene(BALL | changes, run=settings, restitution=1.0, friction_wall=0.3)
    return scene.replace(
        wall=[*(wall.model_dump(exclude_none=True) for wall in scene.wall), *walls]
    )


def test_limit_of_a_sphere_is_that_of_its_tangential_spring():
    # K_t = K_nl moves 2/7 of the mass; without friction the normal spring moves all of it.
    scene = ball()
    changes = ({}, {"material.friction_wall": 0.0}, {"material.tangential_stiffness_ratio": 0.05})
    rough, smooth, loose = (
        assembly.assemble_system(scene.replace(change)).step for change in changes
    )
    np.testing.assert_allclose(rough.linear_limit / smooth.linear_limit, np.sqrt(2 / 7), rtol=1e-9)
    np.testing.assert_allclose(loose.linear_limit, smooth.linear_limit, rtol=1e-9)
    np.testing.assert_allclose(loose.stable, smooth.stable, rtol=1e-9)
    np.testing.assert_allclose(rough.stable / rough.linear_limit, 0.14, rtol=1e-9)
    np.testing.assert_allclose(smooth.stable / smooth.linear_limit, 0.25, rtol=1e-9)


def test_an_impact_that_loses_more_than_a_step_adds_may_take_larger_steps():
    steps = [step_of(piece=BALL, restitution=e, friction_wall=0.0) for e in (0.91, 0.9)]
    np.testing.assert_allclose(
        [step.stable / step.linear_limit for step in steps], [0.25, 0.4], rtol=1e-9
    )


@pytest.mark.parametrize(("friction", "allowed", "fails"), [(0.0, 0.01, 2.0), (10.0, 0.01, 3.0)])
def test_no_impact_gains_more_than_a_hundredth_of_its_energy_at_a_stable_step(
    friction, allowed, fails
):
    """A sphere that lands at 1 m/s and up to 3 m/s sideways, epsilon = 1, at 48 phases of the step;
    ``fails``: at so many times the stable step it does gain more, so that the limit is not far
    below.
    """
    scene = ball(
        {
            "max_rebuild_interval": 4096,
            "allow_unstable_step": True,
            "duration": 0.012,
            "sample_interval": 4e-3,
        }
    )
    scene = scene.replace({"material.friction_wall": friction})
    stable = assembly.assemble_system(scene).step.stable
    gains = [worst_gain(scene, part * stable, 48) for part in (1.0, fails)]
    assert gains[0] < allowed < gains[1]


def worst_gain(scene, step, phases):
    """The largest relative gain of energy over phases of the step (s), of spheres that have left
    the plate again.
    """
    sideways = (0.0, 0.1, 0.25, 0.5, 1.0, 3.0)
    place = [[0.0, 0.0, 0.01 + (0.2 + k / phases) * step] for k in range(phases)]
    speed = [[sideways[k % len(sideways)], 0.0, -1.0] for k in range(phases)]
    run = ensemble(
        scene,
        phases,
        parameters={
            "piece.0.position": place,
            "piece.0.velocity": speed,
            "run.time_step": [step] * phases,
        },
    )
    assert (run.force["plate"][:, -1] == 0).all() and (
        np.abs(run.mean_force["plate"]).max(axis=(1, 2)) > 0
    ).all()
    start = 0.5 * (4 / 3 * np.pi * 0.01**3 * 300) * np.square(speed).sum(axis=1)
    return float((run.energy["kinetic"][:, -1] / start - 1).max())


def test_a_step_beyond_the_stable_one_is_warned_of_with_the_error_to_expect():
    limits = assembly.assemble_system(ball()).step
    settings = {
        "time_step": 0.8 * limits.linear_limit,
        "duration": 1e-3,
        "allow_unstable_step": True,
    }
    run = simulate(ball(settings, position=(0.0, 0.0, 0.1)))
    note, *_ = run.info["notes"]
    assert (
        note.startswith("run.time_step: dt = ")
        and "times the stable step: an impact may gain up to about" in note
    )
    assert assembly.assemble_system(ball({"time_step": 0.9 * limits.stable})).step.warning is None


def test_limit_holds_for_a_body_between_two_walls():
    """A sphere pressed from both sides rings on both springs: the square of its frequency is twice
    that of one.
    """
    gap, v = 1e-5, 0.01
    lid = [(x, y, 0.02 - 2 * gap) for x, y in ((-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.5, -0.5))]
    walls = [{"group": "lid", "corners": lid}]
    place = {"position": (0.0, 0.0, 0.01 - gap), "velocity": (0.0, 0.0, v)}
    linear = assembly.assemble_system(ball(walls=walls)).step.linear_limit
    np.testing.assert_allclose(
        linear, assembly.assemble_system(ball()).step.linear_limit / np.sqrt(2), rtol=1e-9
    )
    smooth = {"material.friction_wall": 0.0, "run.allow_unstable_step": True}
    limit = assembly.assemble_system(ball(walls=walls).replace(smooth)).step.linear_limit
    for part in (0.3, 0.5, 0.9, 0.98):  # up to half of it the corners of the force are corrected:
        # that feeds nothing
        dt = part * limit
        run = simulate(
            ball(
                {"time_step": dt, "sample_interval": dt, "duration": 400 * limit}, walls, **place
            ).replace(smooth)
        )
        energy = run.energy["kinetic"] + run.energy["elastic"]
        # of an oscillator in velocity Verlet, q of the limit, kinetic and elastic energy together
        # swing by 1 / (1 - q^2)
        assert energy.max() < energy.min() / (1 - part**2) * 1.3
    with pytest.raises(SceneError, match="linear stability limit"):
        assembly.assemble_system(ball({"time_step": 1.01 * limit}, walls, **place).replace(smooth))


def test_stability_limit_is_that_of_the_unloading_branch():
    # The oscillator (m_eff, K_nu) is stable in velocity Verlet below 2 / omega. The smallest m_eff
    # of the marshmallow's corners over all directions, by a random search from above; the bound
    # takes all directions at all corners.
    shape = shapes.chamfered_cuboid()
    up = np.random.default_rng(0).normal(size=(20000, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    turning = np.cross(shape.vertices[:, None], up[None])
    least = 1 / (1 + np.sum(turning**2 / shape.gyration, axis=2).max())
    exact = 2 * 0.1 * np.sqrt(least) * exact_quarter(0.01) / (np.pi / 2)
    step = step_of(restitution=0.1)
    assert 0.98 * exact < step.linear_limit <= exact * (1 + 1e-6)


def test_oscillation_on_the_unloading_branch_blows_up_above_the_limit_only():
    def swing(ratio):
        law, pair = (
            walton_braun.WaltonBraun(0.0, 1.0, None),
            walton_braun.WaltonBraunPair(1.0, 1.0, None, None),
        )
        dt = ratio * law.stable_step(pair, 1.0)  # m = K = epsilon = 1
        s, v, largest = 1.0, 0.0, 1.0
        for _ in range(400):
            v -= 0.5 * dt * s
            s += dt * v
            v -= 0.5 * dt * s
            largest = max(largest, abs(s))
        return largest

    assert swing(0.99) < 1.1
    assert swing(1.01) > 1e6


@partial(jax.jit, static_argnames="steps")
def scalar_impacts(dt, phase, epsilon, steps):
    """Rebound over impact speed, and peak force over v sqrt(m K), of velocity Verlet with the law;
    m = K = v = 1.
    """
    law, pair = (
        walton_braun.WaltonBraun(0.001, 1.0, None),
        walton_braun.WaltonBraunPair(1.0, epsilon, None, None),
    )
    _, force, velocity, _ = trace_impacts(law, pair, 1.0, jnp.ones_like(dt), dt, steps, phase)
    return -velocity[-1], force.max(axis=0)


def worst_errors(epsilon, number):
    """Worst relative errors of restitution and of peak force over phases of first touch."""
    phase = (np.arange(200) + 0.5) / 200
    dt = np.full_like(phase, np.pi / 2 / number)
    with jax.enable_x64(True):
        rebound, peak = scalar_impacts(
            *map(jnp.asarray, (dt, phase, np.full_like(phase, epsilon))), steps=2000
        )
    exact = NormalImpact(1.0, 1.0, epsilon, 1.0).rebound_speed
    return np.abs(np.asarray(rebound) / exact - 1).max(), np.abs(np.asarray(peak) - 1).max()


@pytest.mark.parametrize(
    ("epsilon", "number", "restitution", "peak"),
    [
        (0.1, 10, 0.521, 2.04e-3),
        (0.1, 15, 0.067, 9.1e-4),
        (0.1, 20, 0.0197, 5.1e-4),
        (0.1, 30, 3.66e-3, 2.27e-4),
        (0.1, 50, 4.7e-4, 8.2e-5),
        (0.1, 60, 2.26e-4, 5.7e-5),
        (0.1, 100, 2.89e-5, 2.04e-5),
        (0.1, 112, 1.71e-5, 1.62e-5),
        (0.3, 8, 7.8e-3, 3.22e-3),
        (0.3, 15, 4.89e-4, 9.1e-4),
        (0.3, 30, 4.46e-5, 2.27e-4),
        (0.5, 8, 1.04e-3, 3.22e-3),
        (0.5, 15, 4.9e-5, 9.1e-4),
        (0.7, 15, 6.2e-6, 9.1e-4),
    ],
)
def test_errors_of_a_resolution(epsilon, number, restitution, peak):
    # The scheme's own numbers, from an independent computation in plain Python that knows the
    # branches by name. Without the corrections of corners restitution errs by 0.28 % with 100 steps
    # at 0.1, and so with the square of the step.
    found = worst_errors(epsilon, number)
    assert 0.9 * restitution < found[0] < 1.1 * restitution
    assert 0.95 * peak < found[1] < 1.05 * peak


def test_restitution_is_of_fourth_order():
    for epsilon in (0.1, 0.3):
        coarse, fine = (worst_errors(epsilon, number / epsilon)[0] for number in (6, 12))
        assert 3.5 < np.log2(coarse / fine) < 4.5


def test_default_resolution_keeps_restitution_within_a_hundredth_of_a_per_cent():
    # The default is 10 steps per unloading quarter period (15 per loading one, where that is
    # finer).
    for epsilon in (0.1, 0.3, 0.5, 0.7):
        number = max(walton_braun.LOAD_STEPS, walton_braun.UNLOAD_STEPS / epsilon)
        assert worst_errors(epsilon, number)[0] < 1e-4
