"""Where the pieces of a portion begin, and whether they rest when it is released."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dem_jax
from dem_jax import shapes
from dem_jax.assembly.initial_conditions import place_pieces
from dem_jax.assembly.system import assemble_system
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.scene import load_scene, placement

LOW, HIGH = np.array([-0.06, -0.05, 0.3]), np.array([0.06, 0.05, 0.4])


def shape_of(name):
    ball = shapes.PlacedShape(shapes.sphere(0.01), [0.015, 0.0, 0.0])
    return {
        "stick": lambda: shapes.cylinder(0.003, 0.07, 10),
        "cuboid": lambda: shapes.cuboid([0.03, 0.02, 0.01]),
        "sphere": lambda: shapes.sphere(0.01),
        "dumbbell": lambda: shapes.make_compound([shapes.PlacedShape(shapes.sphere(0.01)), ball]),
    }[name]()


@pytest.mark.parametrize("name", ["stick", "cuboid", "sphere", "dumbbell"])
def test_the_box_of_a_turned_piece(name):
    """Of a drawn surface it is that box, but for the sagitta of the drawn balls."""
    shape = shape_of(name)
    q = placement.draw_orientations(20, np.random.default_rng(0))
    corners = shapes.box_corners(shape, q)
    points = shapes.surface_mesh(shape, 5)[0] @ np.swapaxes(quaternion_to_matrix(q), -1, -2)
    drawn = np.stack([points.min(axis=1), points.max(axis=1)], axis=1)
    np.testing.assert_allclose(corners, drawn, rtol=0, atol=1e-5)
    assert np.all(np.abs(corners) <= shape.bounding_radius * (1 + 1e-12))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 60), st.floats(0.0, 0.003))
def test_boxes_of_a_stack_lie_in_the_region_and_apart(seed, number, gap):
    random = np.random.default_rng(seed)
    half = random.uniform(0.002, 0.03, (number, 4, 3))
    corners = np.stack([-half, 0.7 * half], axis=2)
    position, chosen = placement.stack_pieces(corners, gap, LOW, HIGH, random)
    own = position[:, None] + corners[np.arange(number), chosen]
    assert np.all(own[:, 0] >= LOW - 1e-12) and np.all(own[:, 1, :2] <= HIGH[:2] + 1e-12)
    a, b = np.triu_indices(number, 1)
    between = np.maximum(own[a, 0] - own[b, 1], own[b, 0] - own[a, 1]).max(axis=-1)
    assert np.all(between >= gap - 1e-12)


def stacked(changes, seed=0):
    """Shapes, start and lowest corner of a portion in the stock feed bucket."""
    scene = load_scene("weigh-bucket").replace(changes)
    built = assemble_system(scene, seed)
    random = np.random.default_rng(seed)
    start = place_pieces(scene, built.shapes, built.numbers, built.regions, random)
    return built.shapes, start, built.regions[0]


STICK = {"shape": "cylinder", "radius": 3e-3, "height": 0.07, "sides": 10}


@pytest.mark.parametrize("changes", [
    {"product": "pretzel-stick"},
    {"product": "french-fry", "portion.target_weight": 0.2},
    {"portion": {"product": [{"share": 0.5} | STICK, {"share": 0.5, "shape": "sphere", "radius": 6e-3}]}},
])  # fmt: skip
def test_long_pieces_begin_in_a_low_stack(changes):
    """In the grid of their bounding spheres they would reach up by metres, and those on
    top would still be falling at the release.
    """
    made, start, (low, high) = stacked(changes)
    corners = np.stack(
        [shapes.box_corners(shape, q) for shape, q in zip(made, start.orientation, strict=True)]
    )
    own = start.position[:, None] + corners
    assert np.all(own[:, 0, :2] >= low[:2]) and np.all(own[:, 1, :2] <= high[:2])
    a, b = np.triu_indices(len(made), 1)
    assert np.all(np.maximum(own[a, 0] - own[b, 1], own[b, 0] - own[a, 1]).max(axis=-1) > 0)
    radius = max(shape.bounding_radius for shape in made)
    assert placement.find_grid_height(len(made), radius, 1.02, low, high) > 0.6
    assert own[:, 1, 2].max() - low[2] < 0.6
    again = stacked(changes)[1]
    np.testing.assert_array_equal(start.position, again.position)
    assert np.any(start.position != stacked(changes, seed=1)[1].position)


def test_a_portion_that_is_scattered_is_on_the_grid_however_tall():
    changes = {"product": "french-fry", "portion.arrangement": "scattered"}
    made, start, (low, _) = stacked(changes)
    assert start.position[:, 2].max() - low[2] > 0.6


def test_balls_stay_on_the_grid_where_a_stack_would_be_higher():
    made, start, (low, high) = stacked({"product": "hazelnut", "portion.count": 2000})
    radius = max(shape.bounding_radius for shape in made)
    height = placement.find_grid_height(len(made), radius, 1.02, low, high)
    assert height > 0.6
    assert start.position[:, 2].max() - low[2] < height
    first = np.sum(start.position[:, 2] < low[2] + 2.04 * radius)
    assert first == placement.count_places(radius, 1.02, low, high).prod()


FALLING = {
    "portion": {"shape": "sphere", "radius": 0.01, "count": 2, "settling_time": 0.03},
    "run.duration": 0.01,
}


def test_pieces_that_fall_at_the_release_are_counted():
    scene = load_scene("quick-release").replace(FALLING)
    (note,) = dem_jax.simulate(scene).info["notes"]
    assert "2 of 2 pieces do not rest in the feed bucket yet" in note
    assert "fastest: 0.29 m/s" in note  # as falling for 30 ms
    many = dem_jax.ensemble(scene, 2).info["notes"]
    assert any(line.startswith("in 2 of 2 runs up to 2 of 2 pieces") for line in many)
    resting = load_scene("quick-release").replace({"run.duration": 0.01})
    assert "notes" not in dem_jax.simulate(resting).info
