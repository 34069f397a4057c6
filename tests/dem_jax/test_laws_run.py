"""Contact laws in whole runs: energy and momentum in a closed box, restart, runs side by side, a
law of one's own, mistakes.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.broad_phase import candidate_search, overflow_recovery
from dem_jax.contact_laws import Response
from dem_jax.contact_laws.cohesion import Cohesive
from dem_jax.contact_laws.linear_dashpot import LinearDashpot
from dem_jax.contact_laws.springs import combine_in_series, quarter_period
from dem_jax.contact_laws.walton_braun import WaltonBraun
from dem_jax.dynamics import stepping
from dem_jax.errors import RecordError, SceneError
from dem_jax.scene import Scene, describe_scene, load_scene, parse_scene
from dem_jax.types import pytree

SAMPLES = 500
GENERAL = "hertz-mindlin"  # the case with a piece that is not centrally symmetric, which takes long
# to compile


def mixture(sides):
    return (
        {"shape": "sphere", "radius": 0.014},
        {"shape": "cuboid", "size": (0.03, 0.02, 0.02)},
        {"shape": "prism", "sides": sides, "radius": 0.014, "height": 0.03},
        {"shape": "cylinder", "radius": 0.012, "height": 0.03, "sides": 8},
    )


# separation = 0: on that line Walton and Braun's law gives a part of 0.1 % that it did not take as
# the overlap grows by turning.
CASES = {
    "linear-dashpot": ({"law": "linear-dashpot"}, {}),
    "hertz-mindlin": ({"law": "hertz-mindlin", "max_impact_speed": 2.0}, {}),
    "densifying": ({"law": "densifying", "max_impact_speed": 2.0}, {}),
    "elastic-plastic": (
        {"law": "elastic-plastic", "max_impact_speed": 2.0, "yield_pressure": 1e5},
        {},
    ),
    "sticky walton-braun": (
        {"cohesion": {"interaction_range": 1e-3}},
        {"pull_off": 0.3, "separation_slope_ratio": 0.0},
    ),
    "sticky hertz-mindlin": (
        {"law": "hertz-mindlin", "max_impact_speed": 2.0, "cohesion": {"interaction_range": 2e-4}},
        {"pull_off": 0.05},
    ),
}


def box(contact, material, run, sides=6):
    """Eight mixed pieces, in random poses, that fly about in a closed box of 100 mm."""
    random = np.random.default_rng(3)
    corners = 0.025 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    pieces = []
    for shape, x in zip(mixture(sides) * 2, corners, strict=True):
        turn = random.normal(size=4)
        motion = {
            "velocity": random.normal(0, 0.5, 3).tolist(),
            "angular_velocity": random.normal(0, 20, 3).tolist(),
        }
        pieces.append(
            shape
            | {"position": x.tolist(), "orientation": (turn / np.linalg.norm(turn)).tolist()}
            | motion
        )
    walls = []
    for axis in range(3):
        first, second = np.roll(np.eye(3), 1, axis=1)[axis], np.roll(np.eye(3), 2, axis=1)[axis]
        for side in (-1, 1):
            turn = [(-1, -1), (1, -1), (1, 1), (-1, 1)][::-side]  # counter-clockwise seen from
            # within
            corners = [0.05 * (side * np.eye(3)[axis] + u * first + v * second) for u, v in turn]
            walls.append({"group": "box", "corners": [c.tolist() for c in corners]})
    settings = {"precision": "f64", "sample_interval": 2e-4, "frame_interval": 0.0}
    return Scene(piece=pieces, wall=walls, material=material, contact=contact, run=settings | run)


LONG = dict.fromkeys(set(CASES) - {GENERAL}, pytest.mark.long)  # each like that one, and like those
# of test_cohesion.py


@pytest.mark.parametrize("case", [pytest.param(case, marks=LONG.get(case, ())) for case in CASES])
def test_energy_never_comes_from_nothing_and_momentum_balances(case):
    contact, material = CASES[case]
    made = assembly.assemble_system(
        box(contact, {"restitution": 0.4} | material, {}, 5 if case == GENERAL else 6)
    )
    system = made.system
    counts = (
        system.parts.polytopes.shape[0],
        system.parts.spheres.shape[0],
        system.walls.group.shape[0],
    )
    room = tuple(
        (kind, *[candidate_search.pair_count(kind, *counts)] * 2) for kind, *_ in system.capacity
    )
    system, state = overflow_recovery.with_capacity(
        system, made.state, room, 7 + 6, system.row_capacity
    )
    system = system.replace(skin=jnp.asarray(0.02))
    state, recorded, _ = stepping.run_compiled_chunk(
        system, state, np.int32(SAMPLES), np.int32(1), samples=SAMPLES, frames=0
    )
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    energy = np.asarray(recorded.energy)
    kinetic, _, elastic, lost, _, total = energy.T
    start = kinetic[0]
    mechanical = energy[:, :3].sum(1)
    rise = (mechanical - np.minimum.accumulate(mechanical)).max()
    regained = (np.maximum.accumulate(lost) - lost).max()
    print(
        f"{case}: {start:.3g} J, lost {lost[-1]:.3g}, rise {rise:.2g}, regained {regained:.2g}, off {np.ptp(total):.2g}"
    )
    assert lost[-1] > 0.5 * start and (elastic >= 0).all() and elastic.max() > 0.01 * start
    # What the time step leaves, of second order.
    assert rise < 2e-4 * start and regained < 2e-4 * start and np.ptp(total) < 2e-3 * start
    mass, interval = np.asarray(system.pieces.mass), 2e-4
    before = (mass * np.asarray(made.state.velocity)).sum(1)
    momentum = np.concatenate([before[None], np.asarray(recorded.momentum)])
    impulse = (
        mass.sum() * np.array([0, 0, -9.81]) - np.asarray(recorded.mean_force).sum(-1)
    ) * interval
    assert np.abs(np.diff(momentum, axis=0) - impulse).max() < 1e-13 * np.abs(momentum).max()


def falling(law, **changes):
    """One marshmallow on edge, half a millimetre above the plate."""
    piece = {
        "position": (0.0, 0.0, 0.0265),
        "orientation": (0.9, 0.2, 0.4, 0.1),
        "velocity": (0.3, 0.0, -1.0),
    }
    run = {"duration": 0.012, "frame_interval": 2e-3, "sample_interval": 1e-4, "precision": "f64"}
    scene = load_scene("plate-drop").replace(piece=[piece], run=run, contact={"law": law})
    return scene.replace(changes) if changes else scene


REPEATED = (("linear-dashpot", 0.0), ("hertz-mindlin", 0.0), ("hertz-mindlin", 0.2))
GOING_ON = [
    ("linear-dashpot", 0.2),
    *(pytest.param(*case, marks=pytest.mark.long) for case in REPEATED),
]


@pytest.mark.parametrize(("law", "pull_off"), GOING_ON)
def test_a_run_goes_on_in_the_middle_of_a_contact_with_the_same_bits(law, pull_off):
    scene = falling(law, **{"material.pull_off": pull_off})
    whole = dem_jax.simulate(scene)
    touching = np.flatnonzero(np.abs(whole.force["plate"][:, 2]) > 0)
    middle = 1e-4 * int(touching[len(touching) // 2])
    dem_jax.simulate(scene.replace(run={"duration": middle}), out="part.h5")
    again = dem_jax.resume("part.h5", duration=scene.run.duration)
    np.testing.assert_array_equal(again.force["plate"], whole.force["plate"])
    np.testing.assert_array_equal(again.energy["total"], whole.energy["total"])
    assert (whole.mean_force["plate"][:, 2] > 1e-3).any() == (pull_off > 0)  # it pulls at the plate


@pytest.mark.long
@pytest.mark.parametrize("law", ["hertz-mindlin"])
def test_runs_side_by_side_equal_single_ones(law):
    """Sixteen in one program, as of f32 production and f64: up to rounding, before contacts amplify
    it.
    """
    portion = {"count": 2, "arrangement": "scattered", "shape": "sphere", "radius": 0.012}
    portion |= {"region_low": (-0.03, -0.03, 0.0), "region_high": (0.03, 0.03, 0.05)}
    walls = [w.model_dump(exclude_none=True) for w in load_scene("plate-drop").wall]
    scene = Scene(
        portion=portion,
        wall=walls,
        material={"pull_off": 0.05},
        contact={"law": law},
        run={"duration": 0.06, "precision": "f64", "frame_interval": 0.0, "sample_interval": 1e-4},
    )
    runs = dem_jax.ensemble(scene, runs=16)
    for seed in (0, 15):
        single = dem_jax.simulate(scene, seed=seed)
        force = single.mean_force["plate"]
        assert np.abs(force).max() > 0.1
        np.testing.assert_allclose(
            runs.mean_force["plate"][seed], force, atol=1e-7 * np.abs(force).max()
        )


# --- a law of one's own ---


@pytree
class Plateau:
    """A linear spring whose force grows no further beyond a limit; elastic, without friction."""

    limit: jax.Array  # (N)

    def pair_parameters(self, couple):
        return combine_in_series(
            *(e * size for e, size in zip(couple.youngs_modulus, couple.size, strict=True))
        )

    def init_history(self, pair, like):
        return ()

    def force(self, pair, history, contact):
        return Response(
            jnp.minimum(pair * jnp.maximum(contact.overlap, 0), self.limit), None, history
        )

    def energy(self, pair, history, overlap):
        s, edge = jnp.maximum(overlap, 0), self.limit / pair
        return jnp.where(s < edge, 0.5 * pair * s * s, self.limit * (s - 0.5 * edge))

    def interaction_range(self, pair):
        return None

    def critical_steps(self, pair, mass):
        return {"20 steps per quarter period": quarter_period(mass, pair) / 20}

    def stable_step(self, pair, mass):
        return 2 * np.sqrt(mass / pair)


def test_a_law_of_one_s_own_is_run_kept_by_name_and_asked_for_again():
    piece = {
        "shape": "sphere",
        "radius": 0.0167,
        "position": (0.0, 0.0, 0.0177),
        "velocity": (0.0, 0.0, -1.0),
    }
    run = {
        "duration": 0.012,
        "frame_interval": 0.0,
        "sample_interval": 2e-5,
        "gravity": (0.0, 0.0, 0.0),
    }
    scene = load_scene("plate-drop").replace(piece=[piece], run=run)
    whole = dem_jax.simulate(scene, law=Plateau(5.0), out="whole.h5")
    assert whole.info["law"] == "Plateau" and "20 steps" in whole.info["limit"]
    assert -whole.force["plate"][:, 2].min() == pytest.approx(5.0, rel=1e-6)
    assert whole.momentum[-1, 2] == pytest.approx(-whole.momentum[0, 2], rel=1e-3)  # elastic
    dem_jax.simulate(scene.replace(run={"duration": 0.003}), law=Plateau(5.0), out="part.h5")
    for law in (None, WaltonBraun(0.0, 1.0, None)):
        with pytest.raises(
            RecordError,
            match="part.h5: law = .*: allowed: a Plateau, with the parameters that it had",
        ):
            dem_jax.resume("part.h5", duration=0.012, law=law)
    again = dem_jax.resume("part.h5", duration=0.012, law=Plateau(5.0))
    np.testing.assert_array_equal(again.force["plate"], whole.force["plate"])
    dem_jax.simulate(scene.replace(run={"duration": 0.003}), out="plain.h5")
    with pytest.raises(RecordError, match="law = Plateau: allowed: none, the scene says which"):
        dem_jax.resume("plain.h5", law=Plateau(5.0))
    both = dem_jax.ensemble(scene, runs=2, law=Plateau(5.0))
    assert both.info["law"] == "Plateau" and -both.force["plate"][..., 2].min() == pytest.approx(
        5.0, rel=1e-6
    )


# --- the section of a scene ---


def test_a_scene_names_its_law_and_comes_back():
    contact = {"law": "hertz-mindlin", "cohesion": {"interaction_range": 2e-4}}
    scene = load_scene("plate-drop").replace(contact=contact, material={"pull_off": 0.1})
    assert parse_scene(scene.to_toml()) == scene == parse_scene(describe_scene(scene))
    law = assembly.contact_law.build_contact_law(scene)
    assert (
        type(law).__name__ == "Cohesive"
        and float(law.range) == 2e-4
        and float(law.law.impact_speed) == 5.0
    )
    assert isinstance(
        assembly.contact_law.build_contact_law(
            scene.replace(contact={"law": "linear-dashpot"}, material={"pull_off": 0.0})
        ),
        LinearDashpot,
    )
    assert isinstance(assembly.contact_law.build_contact_law(load_scene("plate-drop")), WaltonBraun)


MISTAKES = [
    (
        {"contact.law": "hertz"},
        r'contact\.law = "hertz": allowed: "walton-braun" or "linear-dashpot" or "hertz-mindlin"',
    ),
    (
        {"contact.max_impact_speed": 3.0},
        r'contact\.max_impact_speed = 3: law "walton-braun" has no such key; allowed: with law "hertz-m',
    ),
    (
        {"contact.law": "hertz-mindlin", "material.separation_slope_ratio": 0.1},
        r'material\.separation_slope_ratio = 0\.1: law "hertz-mindlin" has no such',
    ),
    (
        {"contact.law": "hertz-mindlin", "material.tangential_stiffness_ratio": 0.5},
        r'tangential_stiffness_ratio = 0\.5: .* allowed: with law "walton-braun" or "linear-dashpot"',
    ),
    (
        {"contact.law": "linear-dashpot", "material.unloading_damping": 0.5},
        r"material\.unloading_damping = 0\.5: law",
    ),
    ({"contact.max_impact_speed": 0.0}, r"contact\.max_impact_speed = 0\.0: allowed: a number > 0"),
    (
        {"contact.cohesion.interaction_range": -1.0},
        r"contact\.cohesion\.interaction_range = -1\.0: allowed: a number >= 0",
    ),
    (
        {"contact.cohesion.gap": 1.0},
        r"contact\.cohesion\.gap = 1\.0: unknown key; allowed: stiffness, interaction_range",
    ),
]


@pytest.mark.parametrize(("changes", "expected"), MISTAKES)
def test_a_mistake_is_one_clear_line(changes, expected):
    with pytest.raises(SceneError, match=expected) as error:
        load_scene("plate-drop").replace(changes)
    assert "\n" not in str(error.value)


def test_a_cohesive_law_needs_a_pull_off_force():
    with pytest.raises(SceneError, match="material.pull_off = 0: with a cohesive law"):
        assembly.assemble_system(
            load_scene("plate-drop"), law=Cohesive(LinearDashpot(1.0), 1.0, 1e-4)
        )


def test_the_accuracy_of_another_law_is_not_known():
    scene = load_scene("plate-drop").replace(
        contact={"law": "hertz-mindlin"}, run={"accuracy": {"restitution": 0.01}}
    )
    with pytest.raises(
        SceneError,
        match="run.accuracy: known of the law of Walton and Braun only, not of HertzMindlin",
    ):
        assembly.assemble_system(scene)
