"""From a scene to numbers: count, mass, inertia, stiffness, principal axes, arrangement, seeds."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, shapes, validation
from dem_jax.broad_phase import neighbour_list, overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.errors import SceneError
from dem_jax.scene import Scene, load_scene, placement

FLOOR = {
    "group": "floor",
    "corners": [(-0.4, -0.4, 0.0), (0.4, -0.4, 0.0), (0.4, 0.4, 0.0), (-0.4, 0.4, 0.0)],
}
SETTINGS = {"precision": "f64", "sample_interval": 1e-4, "frame_interval": 0.0}


@pytest.mark.parametrize(
    "target, factor, expected",
    [(0.05, 1.0, 9), (0.05, 0.3, 318), (0.1, 0.4, 268), (0.005832, 1.0, 1), (1e-6, 1.0, 1)],
)
def test_count_by_eq_16(target, factor, expected):
    mass = 300.0 * shapes.scale_shape(shapes.chamfered_cuboid(), factor).volume
    assert placement.count_pieces(target, mass) == expected


def test_mass_inertia_and_stiffness_of_a_marshmallow_reach_the_system():
    made = assembly.assemble_system(load_scene("plate-drop", {"run.precision": "f64"}))
    system, pieces = made.system, made.system.pieces
    assert float(pieces.mass[0]) == pytest.approx(5.832e-3, rel=1e-12)
    # seven digits eqs 5, 7, 8 with L = 33.36 mm, E_p 1e8, E_b 1e11 Pa, both times 0.01
    np.testing.assert_allclose(
        pieces.inertia[:, 0], (3.6855e-7, 1.494566e-6, 1.614284e-6), rtol=3e-7
    )
    size = (6 * 19440e-9 / np.pi) ** (1 / 3)
    own, wall = 0.01 * 1e8 * size, 0.01 * 1e11 * size
    stiffness = float(validation.wall_stiffness(system)[0])
    assert stiffness == pytest.approx(own * wall / (own + wall), rel=1e-12)
    assert stiffness == pytest.approx(33327.17, abs=0.005)
    slots = jax.jit(
        lambda state: (
            neighbour_list.rebuild_neighbour_list(
                validation.with_permanent_pairs(system), state
            ).scratch.slots
        )
    )(made.state)
    # what the law is given
    assert float(slots["hulls"].pair.stiffness[0]) == pytest.approx(stiffness, rel=1e-15)
    assert float(pieces.width[0]) == pytest.approx(0.016, rel=1e-12)


def test_the_scale_factor_scales_mass_inertia_and_stiffness():
    rows = [
        {"position": (0.1 * k, 0.0, 0.1), "scale_factor": factor}
        for k, factor in enumerate((1.0, 0.3))
    ]
    system = assembly.assemble_system(Scene(piece=rows, wall=[FLOOR], run=SETTINGS)).system
    pieces, stiffness = system.pieces, validation.wall_stiffness(system)
    for array, power in (
        (pieces.mass, 3),
        (pieces.inertia[0], 5),
        (stiffness, 1),
        (pieces.bounding_radius, 1),
    ):
        assert float(array[1] / array[0]) == pytest.approx(0.3**power, rel=1e-12)


def drop(points, orientation, position=(0.0, 0.0, 0.035)):
    piece = {
        "shape": "hull",
        "points": [tuple(p) for p in np.asarray(points).tolist()],
        "position": position,
        "orientation": orientation.as_quat(scalar_first=True).tolist(),
        "velocity": (0.2, 0.1, -1.5),
        "angular_velocity": (4.0, -6.0, 3.0),
    }
    made = assembly.assemble_system(Scene(piece=[piece], wall=[FLOOR], run=SETTINGS), 0)
    system = made.system.replace(skin=made.system.skin * 0 + 0.01)
    state, recorded, _ = stepping.run_compiled_chunk(
        system, made.state, np.int32(300), np.int32(1), samples=1024, frames=0
    )
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    return made, state, jax.tree.map(lambda x: np.asarray(x)[:300], recorded)


def test_a_hull_given_in_other_axes_is_the_same_body():
    """An irregular hull in its principal axes, and with its points turned in the body frame and the
    body turned back.
    """
    points = np.array(
        [(0, 0, 0), (0.04, 0.005, 0), (0.01, 0.03, 0.004), (0.012, 0.01, 0.02), (0.03, 0.02, 0.015)]
    )
    first = shapes.convex_hull(points)
    principal = Rotation.from_quat(first.principal, scalar_first=True)
    own = principal.inv().apply(first.vertices)  # in principal axes, about the centre of mass
    pose = Rotation.from_euler("xyz", (0.4, -0.7, 1.1))
    turn = Rotation.from_euler("xyz", (1.0, 0.5, -2.0))
    made, state, recorded = drop(own, pose)
    np.testing.assert_allclose(np.abs(made.frames[0]), (1, 0, 0, 0), atol=1e-6)
    other, moved, found = drop(turn.apply(own) + 0.01, pose * turn.inv())
    assert np.abs(other.frames[0][1:]).max() > 0.1
    peak = np.abs(recorded.force).max()
    assert peak > 1.0
    # turned points differ in the last bit, and so do their principal axes by some 1e-15 over
    # differences of moments; the second and third impact multiply that
    np.testing.assert_allclose(found.mean_force, recorded.mean_force, rtol=0, atol=1e-5 * peak)
    np.testing.assert_allclose(moved.position, state.position, rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        found.energy, recorded.energy, rtol=0, atol=1e-6 * recorded.energy[0, 0]
    )
    kinetic = 0.5 * float(made.system.pieces.mass[0]) * (0.2**2 + 0.1**2 + 1.5**2)
    spin = pose.inv().apply((4.0, -6.0, 3.0))
    kinetic += 0.5 * float(np.sum(np.asarray(made.system.pieces.inertia)[:, 0] * spin**2))
    assert recorded.energy[0, 0] == pytest.approx(kinetic, rel=2e-2)  # a sample interval later


def portion(count, seed, width=0.13):
    rows = {
        "count": count,
        "arrangement": "scattered",
        "region_low": (0.0, 0.0, 0.1),
        "region_high": (width, width, 0.4),
    }
    scene = Scene(portion=rows, wall=[FLOOR], run=SETTINGS)
    return assembly.assemble_system(scene, seed)


@pytest.mark.parametrize("count, width", [(9, 0.13), (60, 0.13), (25, 0.3)])
def test_scattered_pieces_never_overlap(count, width):
    """Not even their bounding spheres, whatever the orientation."""
    for seed in range(5):
        place = np.asarray(portion(count, seed, width).state.position).T
        gap = np.linalg.norm(place[:, None] - place[None], axis=-1)[np.triu_indices(count, 1)]
        radius = shapes.chamfered_cuboid().bounding_radius
        assert gap.min() >= 2 * radius * (1 - 1e-12)
        assert (place[:, :2] >= radius * (1 - 1e-12)).all() and (
            place[:, :2] <= width - radius * (1 - 1e-12)
        ).all()


def test_the_seed_decides_the_arrangement():
    one, same, other = (portion(20, seed).state for seed in (3, 3, 4))
    for name in ("position", "orientation"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
        assert (
            np.abs(np.asarray(getattr(one, name)) - np.asarray(getattr(other, name))).max() > 1e-4
        )


def test_random_orientations_are_uniform():
    """Each axis of the body points anywhere: its mean vanishes and its mean square along any
    direction is a third.
    """
    q = placement.draw_orientations(20000, np.random.default_rng(0))
    for axis in Rotation.from_quat(q, scalar_first=True).as_matrix().transpose(2, 1, 0):
        assert np.abs(axis.mean(1)).max() < 5 / np.sqrt(3 * 20000)  # five standard errors
        assert np.abs((axis**2).mean(1) - 1 / 3).max() < 5 * np.sqrt(4 / 45 / 20000)


def test_a_piece_that_nothing_can_touch_is_said():
    with pytest.raises(
        SceneError, match="a single piece and no wall: nothing can touch; allowed: another piece"
    ):
        assembly.assemble_system(load_scene("plate-drop").replace(wall=[], region=[]))
