"""Sticky pieces: how firmly they stick, and one that a flap throws; spread of the weight; products
by name in mixtures.
"""

import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.assembly import portion_counts
from dem_jax.errors import SceneError
from dem_jax.runner import failure
from dem_jax.scene import load_scene, parse_scene
from dem_jax.visualization.metadata import describe_stickiness


def sphere_scene(pull_off):
    """A portion of spheres of 10 g in the weigh bucket, whose flaps open."""
    piece = {"shape": "sphere", "radius": 0.01, "piece_weight": 0.01, "count": 3}
    return parse_scene('base = "weigh-bucket"').replace(
        portion={"product": [], **piece},
        material={"pull_off": pull_off},
        weigh_bucket={"opening_angle_deg": 60.0},
    )


def test_stickiness_is_pull_off_over_the_weight_of_a_piece():
    weight = 0.01 * 9.81
    words = "stickiness of default: pull-off is 2.5 times the weight of a piece on pieces, 2.5 times the weight of a piece on walls"
    assert describe_stickiness(sphere_scene(2.5 * weight)) == [words]
    assert describe_stickiness(sphere_scene(0.0)) == []


@pytest.mark.parametrize(
    ("pull_off", "speed", "is_told"), [(0.25, 1.0, True), (0.25, 40.0, False), (0.0, 1.0, False)]
)
def test_a_sticky_piece_that_a_flap_throws_is_told_as_such(pull_off, speed, is_told):
    """No faster than twice the flap and its fall: not the fault of the time step."""
    scene = sphere_scene(pull_off)
    system, state = (made := assembly.assemble_system(scene)).system, made.state
    steps = int(1.0 / float(system.dt))  # the flaps have opened by then
    said = failure._diagnose_throw(system, state.replace(step=np.int32(steps)), 0, speed)
    assert (said is not None) is is_told
    if said:
        assert (
            said.startswith("it stuck to wall group '")
            and "2.55 times its weight" in said
            and "time step" not in said
        )


def test_the_speed_of_a_flap_is_that_of_its_far_edge():
    """The fastest point of a panel moves by less than the whole circle that it swings by, and by
    more than its centre.
    """
    system = assembly.assemble_system(sphere_scene(0.1)).system
    fastest, top = failure._measure_panel_speeds(system, 1.0)
    moving = np.array([name.split("_")[1].startswith("flap") for name in system.walls.groups])[
        np.asarray(system.walls.group)
    ]
    assert (fastest[moving] > 0.1).all() and (fastest[~moving] == 0.0).all()
    assert top > np.asarray(system.walls.centre)[2].max()


@pytest.mark.parametrize("number", [2, 7, 16, 40, 1000])
def test_a_spread_of_the_weight_is_exact_and_keeps_the_mean_weight(number):
    weight = portion_counts.distribute_sizes(number, 0.3, of_weight=True) ** 3
    assert weight.mean() == pytest.approx(1.0, rel=1e-12) and weight.std() == pytest.approx(
        0.3, rel=1e-12
    )
    assert (np.diff(weight) >= 0).all() and weight.min() > 0
    assert len(np.unique(np.round(weight, 9))) <= portion_counts.MOST_SIZES


def test_pieces_of_a_portion_have_the_spread_of_weight_asked():
    row = {
        "shape": "cuboid",
        "size": (0.02, 0.01, 0.01),
        "piece_weight": 0.004,
        "piece_weight_spread": 0.2,
    }
    scene = load_scene("weigh-bucket").replace(portion={**row, "count": 12})
    mass = np.asarray(assembly.assemble_system(scene).system.pieces.mass, float)
    # single precision
    assert mass.mean() == pytest.approx(0.004, rel=1e-6) and mass.std() == pytest.approx(
        0.0008, rel=1e-5
    )
    with pytest.raises(
        SceneError,
        match=r"size_spread = 0\.1 beside piece_weight_spread = 0\.2: each decides the other",
    ):
        scene.replace(portion={"size_spread": 0.1, "piece_weight_spread": 0.2})
    other = scene.replace(portion={"size_spread": 0.1}).portion
    assert (other.size_spread, other.piece_weight_spread) == (0.1, 0.0), (
        "the one on top replaces the one below"
    )


def test_a_mixture_takes_products_by_name():
    rows = '[[portion.product]]\nproduct = "hazelnut"\nshare = 2\n[[portion.product]]\nproduct = "gummy-bear"\nsize_spread = 0.1\n'
    scene = parse_scene(
        f'base = "weigh-bucket"\n[portion]\ntarget_weight = 0.05\n{rows}[material.hazelnut]\nrestitution = 0.6\n'
    )
    nut, bear = scene.portion.product
    assert (nut.shape, nut.radius, nut.piece_weight_spread, nut.share, nut.material) == (
        "sphere",
        6.4e-3,
        0.25,
        2.0,
        "hazelnut",
    )
    assert (bear.shape, bear.size_spread, bear.material) == ("chamfered-cuboid", 0.1, "gummy-bear")
    named = scene.material.named_materials
    assert (named["hazelnut"].density, named["hazelnut"].restitution) == (920.0, 0.6)
    assert (named["gummy-bear"].youngs_modulus, named["gummy-bear"].pull_off) == (5e5, 0.005)
    assert scene.material.numerical_softening == 1.0  # of the gummy bears, the larger
    assert parse_scene(scene.to_toml()) == scene
    with pytest.raises(
        SceneError, match=r"portion\.product\.0\.product = 'hazelnit': no such product; .*hazelnut"
    ):
        parse_scene('base = "weigh-bucket"\n[[portion.product]]\nproduct = "hazelnit"\n')
