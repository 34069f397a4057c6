"""General convex polytopes: exact for all of them, near features say what all features say, thin
walls are walls.
"""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import depth as exact
from dem_jax import Scene, assembly, ensemble, shapes, simulate, validation
from dem_jax.assembly import hull_table as tables_of
from dem_jax.broad_phase import candidate_search, neighbour_list, overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.narrow_phase import (
    cached_features,
    collision_primitives,
    contact_geometry,
    feature_cache,
    feature_search,
    hull_lookup,
    packed_bodies,
)
from dem_jax.walls import kinematics
from dem_jax.xla_flags import supported_options

MARSHMALLOW = shapes.chamfered_cuboid()


def test_depth_and_normal_of_random_hulls_equal_hull_arithmetic():
    single, double = exact.errors(400, exact.DTYPES, seed=1)
    assert single.touching == double.touching > 100
    assert single.depth.max() < 1e-6
    assert double.depth.max() < 1e-13
    assert single.left.max() < 1e-6
    assert double.left.max() < 1e-13
    assert single.apart.max() < 1e-6
    assert double.apart.max() < 1e-13


# --- near features ---

BATCH = 64
HULLS = [exact.bodies()[k] for k in (6, 10)] + [shapes.cuboid((0.09, 0.09, 0.02)), MARSHMALLOW]


@partial(jax.jit, compiler_options=supported_options("cpu"))
def from_all(table, rows, rel):
    """Near features, and contact from all of them."""
    found = feature_search.find_active_features(
        table.features, rows, tuple(table.bounding_radius[row] for row in rows), rel, None
    )
    axes = cached_features.find_separating_axis(found, rel)
    facing = feature_search.find_support_faces(table.features, rows, axes.normal, rel)
    faces = cached_features.select_support_faces(facing, axes.normal, rel)
    return (
        found,
        facing,
        axes,
        faces,
        cached_features.polytope_contact_patch(
            table, rows, faces, cached_features.all_clip_planes(table, rows), rel, axes
        )[:2],
    )


@partial(jax.jit, compiler_options=supported_options("cpu"))
def from_near(table, rows, kept, facing, rel):
    """The same from what is known from before, how far the bodies have moved, and whether the
    facing faces are certain.
    """
    axes = cached_features.find_separating_axis(kept, rel)
    touching = jnp.ones_like(axes.depth, bool)
    facing = cached_features.update_support_faces(table, facing, rows, axes.normal, touching, rel)
    faces = cached_features.select_support_faces(facing, axes.normal, rel)
    centre, in_full = (
        cached_features.polytope_contact_patch(
            table, rows, faces, cached_features.ClipPlanes(kept.clip_planes, is_wide), rel, axes
        )[0]
        for is_wide in (False, True)
    )
    return (
        axes,
        faces,
        centre,
        in_full,
        cached_features.relative_displacement_bound(kept, table.bounding_radius[rows[1]], rel),
    )


def relative(turn, offset):
    return collision_primitives.RelativePose(
        tuple(tuple(row) for row in turn.as_matrix().transpose(1, 2, 0)), tuple(offset.T)
    )


def test_near_features_say_what_all_say_until_bodies_have_moved_by_the_margin():
    table = jax.tree.map(jnp.asarray, tables_of.build_hull_table(HULLS, np.float64))
    table = table.replace(row=table.row.astype(np.int32))
    corners = [exact.in_principal_frame(shape) for shape in HULLS]
    random, compared, in_full = np.random.default_rng(2), 0, 0
    for trial in range(16):
        pairs = exact.random_pairs(BATCH, corners, [shape.normals for shape in HULLS], seed=trial)
        rows = tuple(i.astype(np.int32) for i in (pairs.a, pairs.b))
        kept, facing, *_ = from_all(table, rows, relative(pairs.turn, pairs.offset))
        margin = np.asarray(kept.validity_radius)
        is_shallow = np.abs(np.asarray(kept.depth)) < 5e-4
        assert (margin[is_shallow] > 0).all()
        rel = moved_within(margin, random, pairs)
        _, _, true, true_faces, true_centre = from_all(table, rows, rel)
        axes, faces, centre, from_every_plane, moved = from_near(table, rows, kept, facing, rel)
        sure = (np.asarray(moved) <= margin) & (np.asarray(true.depth) > 1e-9)
        compared += sure.sum()
        np.testing.assert_allclose(axes.depth[sure], true.depth[sure], atol=1e-15, rtol=0)
        for one, other in zip((*axes.normal, *faces), (*true.normal, *true_faces), strict=True):
            np.testing.assert_allclose(one[sure], other[sure], atol=1e-12)
        narrow = sure & ~np.asarray(kept.needs_all_planes)
        in_full += narrow.sum()
        for one, every, other in zip(centre, from_every_plane, true_centre[0], strict=True):
            np.testing.assert_allclose(one[narrow], other[narrow], atol=1e-12)
            np.testing.assert_allclose(every[sure], other[sure], atol=1e-12)
    assert compared > 200 and in_full > 0.8 * compared


def moved_within(margin, random, pairs):
    """Where bodies are that move and turn by up to their margin."""
    way = np.maximum(margin, 0) * random.uniform(0, 1, BATCH)
    share = random.uniform(0, 1, BATCH)
    along, about = (
        x / np.linalg.norm(x, axis=1, keepdims=True) for x in random.normal(size=(2, BATCH, 3))
    )
    offset = pairs.offset + along * (way * share)[:, None]
    radius = np.array([HULLS[k].bounding_radius for k in pairs.b])
    return relative(
        pairs.turn * Rotation.from_rotvec(about * (way * (1 - share) / radius)[:, None]), offset
    )


def test_near_features_say_what_all_say_of_bodies_apart_within_the_reach_of_a_law():
    """And mostly not in this place only: cohesive pieces in a heap would be looked at in every
    step.
    """
    reach = 3e-4
    table = jax.tree.map(jnp.asarray, tables_of.build_hull_table(HULLS, np.float64))
    table = table.replace(row=table.row.astype(np.int32))
    corners = [exact.in_principal_frame(shape) for shape in HULLS]
    random, compared, known_for_more = np.random.default_rng(5), 0, 0

    @jax.jit
    def found(rows, rel):
        kept = feature_search.find_active_features(
            table.features,
            rows,
            tuple(table.bounding_radius[row] for row in rows),
            rel,
            jnp.full((BATCH,), reach),
        )
        return kept, cached_features.find_separating_axis(kept, rel)

    for trial in range(16):
        pairs = exact.random_pairs(BATCH, corners, [shape.normals for shape in HULLS], seed=trial)
        rows = tuple(i.astype(np.int32) for i in (pairs.a, pairs.b))
        for _ in range(3):  # to a gap along the normal, which turns on the way
            axes = found(rows, relative(pairs.turn, pairs.offset))[1]
            gap = random.uniform(0.1, 0.9, BATCH) * reach
            pairs = pairs._replace(
                offset=pairs.offset + (np.stack(axes.normal) * (np.asarray(axes.depth) + gap)).T
            )
        for k in range(0, BATCH, 4):  # a corner opposite to a corner: no axis of the bodies has
            # their distance
            along = random.normal(size=3)
            ours, theirs = corners[pairs.a[k]], pairs.turn[k].apply(corners[pairs.b[k]])
            tip = ours[np.argmax(ours @ along)] - theirs[np.argmin(theirs @ along)]
            pairs.offset[k] = tip + gap[k] * along / np.linalg.norm(along)
        kept, axes = found(rows, relative(pairs.turn, pairs.offset))
        margin, apart = np.asarray(kept.validity_radius), (-reach < axes.depth) & (axes.depth < 0)
        known_for_more += (margin[apart] > 1e-6).sum()
        rel = moved_within(margin, random, pairs)
        true = found(rows, rel)[1]
        axes = cached_features.find_separating_axis(kept, rel)
        sure = np.asarray(
            apart
            & (
                cached_features.relative_displacement_bound(
                    kept, table.bounding_radius[rows[1]], rel
                )
                <= margin
            )
            & (true.depth > -reach)
        )
        compared += sure.sum()
        np.testing.assert_allclose(axes.depth[sure], true.depth[sure], atol=1e-15, rtol=0)
        there = sure & (np.abs(np.asarray(true.depth)) > 1e-9)
        for one, other in zip(axes.normal, true.normal, strict=True):
            np.testing.assert_allclose(one[there], other[there], atol=1e-9)
    print(f"{compared} pairs compared, {known_for_more} with a margin of more than a micrometre")
    assert compared > 500 and known_for_more > compared


MIXTURE = [
    {"shape": "hull", "points": tuple(map(tuple, exact.bodies()[7].vertices.tolist()))},
    {"shape": "hull", "points": tuple(map(tuple, exact.bodies()[9].vertices.tolist()))},
    {"shape": "prism", "radius": 0.012, "height": 0.02, "sides": 5},
    {"shape": "chamfered-cuboid", "scale_factor": 0.5},
]


def test_an_end_that_stands_on_a_wall_is_not_looked_at_in_every_step():
    """All edges of its rim are equally near then, to rounding."""
    bodies = [shapes.cuboid((0.2, 0.2, 0.02)), shapes.cylinder(0.015, 0.05, 64)]
    table = jax.tree.map(jnp.asarray, tables_of.build_hull_table(bodies, np.float32))
    rows = tuple(np.full(BATCH, k, np.int32) for k in (0, 1))
    random = np.random.default_rng(0)
    tilts = 10.0 ** random.uniform(-8, -5, BATCH) * (np.arange(BATCH) > 8)  # the first stand
    # exactly upright
    axes = np.c_[random.normal(size=(BATCH, 2)), np.zeros(BATCH)]
    lying = exact.in_principal_frame(bodies[1])
    up = np.eye(3)[np.argmin(np.abs(np.ptp(lying, axis=0) - 0.05))]  # the axis in the principal
    # frame
    upright = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]
    turn = (
        Rotation.from_rotvec(tilts[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True))
        * upright
    )
    offset = np.c_[random.uniform(-0.05, 0.05, (BATCH, 2)), np.full(BATCH, 0.035 - 4e-6)].astype(
        np.float32
    )
    rel = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), relative(turn, offset))
    radius = tuple(table.bounding_radius[row] for row in rows)
    found = jax.jit(
        lambda rows, rel: feature_search.find_active_features(
            table.features, rows, radius, rel, None
        )
    )(rows, rel)
    assert np.allclose(found.depth, 4e-6, atol=2e-7)
    assert np.all(np.asarray(found.validity_radius) > 1e-5)


def closed_box(**run):
    """Eight pieces of four shapes that fly about in a closed box, without gravity, with friction."""
    half, random = 0.045, np.random.default_rng(3)
    walls = [
        {"group": "box", "corners": inside(axis, side, half), "thickness": 0.02}
        for axis in range(3)
        for side in (-1, 1)
    ]
    pieces = []
    for k in range(8):
        at = (np.array([k & 1, k >> 1 & 1, k >> 2]) - 0.5) * 0.04
        turn = random.normal(size=4)
        pieces.append(
            MIXTURE[k % 4]
            | {
                "position": tuple(at.tolist()),
                "orientation": tuple((turn / np.linalg.norm(turn)).tolist()),
                "velocity": tuple(random.uniform(-1, 1, 3).tolist()),
                "angular_velocity": tuple(random.uniform(-30, 30, 3).tolist()),
            }
        )
    run = {
        "precision": "f64",
        "gravity": (0.0, 0.0, 0.0),
        "sample_interval": 2e-4,
        "frame_interval": 0.01,
    } | run
    return Scene(name="closed", piece=pieces, wall=walls, material={"restitution": 0.5}, run=run)


def inside(axis, side, half):
    """Corners of a side of a cube about the origin, counter-clockwise seen from inside."""
    corners = np.insert(
        np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (half + 0.01), axis, side * half, axis=1
    )
    turns = np.cross(corners[1] - corners[0], corners[2] - corners[1])[axis]
    return tuple(map(tuple, (corners if turns * side < 0 else corners[::-1]).tolist()))


@pytest.mark.long
def test_energy_of_mixed_hulls_in_a_closed_box_never_grows_and_the_ledger_closes():
    run = simulate(closed_box(duration=0.25))
    mechanical = run.energy["kinetic"] + run.energy["potential"] + run.energy["elastic"]
    off = np.abs(run.energy["total"] - run.energy["total"][0]).max()
    rise = (mechanical - np.minimum.accumulate(mechanical)).max()  # the largest above any earlier
    # value
    print(
        f"rise {rise:.2g} J, ledger {off:.2g} J of {mechanical[0]:.3g} J; left {mechanical[-1] / mechanical[0]:.2f}"
    )
    assert mechanical[-1] < 0.6 * mechanical[0]  # they have met
    assert rise < 1e-3 * mechanical[0]
    assert off < 1e-3 * mechanical[0]


@pytest.mark.long
def test_a_run_with_kept_features_is_the_one_that_looks_at_all_in_every_step(monkeypatch):
    scene = closed_box(duration=0.03)
    kept = simulate(scene)
    monkeypatch.setattr("dem_jax.runner.job_setup.choose_slot_block", lambda: 0)
    plain = simulate(scene)
    assert np.abs(kept.force["box"]).max() > 1
    np.testing.assert_allclose(kept.force["box"], plain.force["box"], atol=1e-7)
    np.testing.assert_allclose(kept.pieces.position, plain.pieces.position, atol=1e-12)


def test_no_pair_moves_faster_than_what_a_look_waits_for():
    """Pieces that fly and spin fast, also with parts that are off their centre, near a wall that
    turns.
    """
    part = {"shape": "cuboid", "size": (0.012, 0.012, 0.012)}
    double = {
        "shape": "compound",
        "part": [part | {"position": (x, 0.0, 0.0)} for x in (-0.006, 0.006)],
    }
    kinds, share = [*MIXTURE[:3], double], np.array([1.0, -0.2, 0.0, 0.5, -1.0, 0.1, 0.7, -0.6])
    pieces = [
        kinds[k % 4]
        | {
            "position": (0.03 * (k % 4), 0.03 * (k // 4), 0.03 + 0.004 * (k % 3)),
            "velocity": tuple(share[k] * np.array((3.0, 1.0, -2.0))),
            "angular_velocity": tuple(share[k] * np.array((2000.0, -1000.0, 500.0))),
        }
        for k in range(8)
    ]
    corners = [(-0.05, -0.05, 0.0), (0.15, -0.05, 0.0), (0.15, 0.1, 0.0), (-0.05, 0.1, 0.0)]
    flap = {
        "group": "flap",
        "pivot": (-0.05, 0.0, 0.0),
        "axis": (0.0, 1.0, 0.0),
        "opening_angle_deg": 60.0,
        "opening_start": 0.0,
        "opening_time": 0.02,
    }
    wall, run = {"group": "flap", "corners": corners}, {"precision": "f64", "frame_interval": 0.0}
    made = assembly.assemble_system(Scene(piece=pieces, wall=[wall], motion=[flap], run=run), 0)
    roomy = (("hulls", *[candidate_search.pair_count("hulls", 16, 0, 1)] * 2),)
    system, state = overflow_recovery.with_capacity(
        made.system, made.state, roomy, 16, made.system.row_capacity
    )
    # in the middle of the swing
    state = state.replace(step=jnp.asarray(round(0.01 / float(system.dt)), jnp.int32))

    @jax.jit
    def moved(state):
        """The state after the way of a step, and how far each pair moved, and was to move at most."""
        state = neighbour_list.rebuild_neighbour_list(system, state)
        slots, there = state.scratch.slots["hulls"], []
        after, omega, panels = stepping._advance_kinematics(
            system, state.replace(step=state.step + 1), None
        )
        for each, walls in (
            (state, kinematics.wall_state_after_step(system, state.step)),
            (after, panels),
        ):
            stacked = packed_bodies.pack_bodies(system, each, omega, walls)
            a, b = (packed_bodies.gather_bodies(stacked, of) for of in (slots.a, slots.b))
            there.append(contact_geometry.relative_pose(a, b, packed_bodies.centre_offset(a, b)))
        was = SimpleNamespace(
            offset=jnp.stack(there[0].offset),
            rotation=[c for row in there[0].rotation for c in row],
        )
        way = cached_features.relative_displacement_bound(
            was, system.hulls.bounding_radius[system.shape[slots.b]], there[1]
        )
        return (
            after,
            way,
            system.dt * feature_cache._relative_speed_bounds(system, state.scratch, stacked),
            slots.live,
        )

    ratios = []
    for _ in range(50):
        state, way, most, live = jax.device_get(moved(state))
        ratios.append((way / most)[live])
    ratios = np.concatenate(ratios)
    print(
        f"{ratios.size} pairs moved by {ratios.min():.2g} to {ratios.max():.4f} of what a look waits for"
    )
    assert ratios.size > 500 and 0.5 < ratios.max() < feature_cache.SPEED_MARGIN


# --- thin walls ---


@pytest.mark.parametrize("general", [False, True], ids=["zonotopes", "general"])
@pytest.mark.parametrize("dtype, rounding", [(np.float32, 1e-6), (np.float64, 1e-15)])
def test_a_panel_of_a_tenth_of_a_millimetre_has_the_contact_of_one_of_ten(
    general, dtype, rounding, monkeypatch
):
    """A marshmallow in any orientation, up to half of its width deep."""
    if general:
        monkeypatch.setattr(tables_of, "MOST_DIRECTIONS", 0)
    table = tables_of.build_hull_table(
        [shapes.cuboid((0.3, 0.3, t)) for t in (1e-4, 1e-2)] + [MARSHMALLOW], dtype
    )
    table = table.replace(row=table.row.astype(np.int32))
    random, count = np.random.default_rng(0), 96
    turn = Rotation.from_quat(random.normal(size=(count, 4)))
    corners = exact.in_principal_frame(MARSHMALLOW)
    low = np.array([r.apply(corners)[:, 2].min() for r in turn])
    depth = random.uniform(0, 0.5, count) * 0.016
    rows = np.full(count, 2, np.int32)
    found = []
    for panel, thickness in enumerate((1e-4, 1e-2)):
        offset = np.c_[np.zeros((count, 2)), 0.5 * thickness - low - depth]
        rel = jax.tree.map(lambda x: x.astype(dtype), relative(turn, offset))
        found.append(contact(table, (np.full(count, panel, np.int32), rows), rel))
    thin, thick = found
    np.testing.assert_allclose(thin.depth, depth, atol=rounding, rtol=0)
    np.testing.assert_allclose(thin.depth, thick.depth, atol=rounding, rtol=0)
    np.testing.assert_allclose(thin.normal, thick.normal, atol=0)
    np.testing.assert_allclose(thin.point[:2], thick.point[:2], atol=30 * rounding, rtol=0)
    np.testing.assert_allclose(
        thin.point[2] - 0.5e-4, thick.point[2] - 0.5e-2, atol=30 * rounding, rtol=0
    )


@partial(jax.jit, compiler_options=supported_options("cpu"))
def contact(table, rows, rel):
    if table.features is not None:
        # a function
        return contact_geometry.polytope_contact(table, rows, rel)._replace(moments=None)
    rows_of_both = (
        hull_lookup.attach_face_loops(hull_lookup.gather_hulls(table, row, False), table)
        for row in rows
    )
    return collision_primitives.hull_hull(*rows_of_both, rel)._replace(moments=None)


ON_SHEETS = [pytest.param({"shape": "chamfered-cuboid"}, marks=pytest.mark.long), MIXTURE[0]]


@pytest.mark.parametrize("piece", ON_SHEETS, ids=["zonotope", "hull"])
def test_a_piece_bounces_off_a_sheet_as_off_a_slab(piece):
    """Tilted, at 2.2 m/s: of 0.5 mm and of 10 mm. Nothing differs but rounding."""
    floor, out = ((-0.2, -0.2, 0), (0.2, -0.2, 0), (0.2, 0.2, 0), (-0.2, 0.2, 0)), []
    for thickness in (5e-4, 1e-2):
        start = {
            "position": (0.0, 0.0, 0.045),
            "orientation": (0.9, 0.3, 0.2, 0.1),
            "velocity": (0.0, 0.0, -2.2),
        }
        wall = {"group": "sheet", "corners": floor, "thickness": thickness}
        run = {"precision": "f64", "duration": 0.03, "frame_interval": 0.01}
        out.append(
            simulate(
                Scene(
                    name="sheet",
                    piece=[piece | start],
                    wall=[wall],
                    material={"numerical_softening": 0.003},
                    run=run,
                )
            )
        )
    sheet, slab = out
    assert sheet.max_relative_overlap.max() * 0.016 > 5e-4  # deeper than the sheet is thick
    np.testing.assert_allclose(sheet.force["sheet"], slab.force["sheet"], atol=1e-8)
    np.testing.assert_allclose(sheet.pieces.velocity, slab.pieces.velocity, atol=1e-10)


def test_a_sphere_on_a_hull_of_hundreds_of_faces():
    shape = exact.bodies()[14]
    table = tables_of.build_hull_table([shape], np.float64)
    corners, random = exact.in_principal_frame(shape), np.random.default_rng(4)
    centre, radius = random.normal(size=(60, 3)) * 0.012, np.full(60, 0.004)
    found = sphere_on(
        table.replace(face_loops=None, open_edges=None, features=None), radius, tuple(centre.T)
    )
    true = [exact.reference(point[None] - corners) for point in centre]
    inside = np.array([depth > 0 for depth, _ in true])
    assert len(shape.normals) > collision_primitives.UNROLL_LIMIT and 5 < inside.sum() < 55
    np.testing.assert_allclose(found.depth, [0.004 + depth for depth, _ in true], atol=1e-15)
    np.testing.assert_allclose(
        np.stack(found.normal, axis=1), [normal for _, normal in true], atol=1e-10
    )


sphere_on = jax.jit(collision_primitives.hull_sphere, compiler_options=supported_options("cpu"))


def test_contact_whose_edges_are_on_neither_of_the_facing_faces_is_where_they_cross():
    """Two hip roofs, ridge across ridge: the faces that look most along the normal are hips, far
    from where the ridges cross.

    The hips lean by 30 degrees, the slopes by 60: with a depth of d, of each ridge, an edge of two
    faces, a length of 2 d tan 30 is inside the other roof, and of no other edge anything.
    """
    end, high = 5e-3, 1e-2  # m: half of a ridge; height of a roof
    depth = np.r_[np.linspace(-1e-4, 2e-4, 19), 1e-4]  # m: of one ridge below the other
    x, y = 2e-3 - np.linspace(0, 3e-3, 20), -1e-3  # m: where b has its middle
    base = [(end + high * 3**0.5) * u for u in (-1, 1)], [high / 3**0.5 * u for u in (-1, 1)]
    corners = [(-end, 0, 0), (end, 0, 0), *((u, v, -high) for u in base[0] for v in base[1])]
    shape, centre = shapes.hull_and_centre(np.array(corners))
    table = jax.tree.map(jnp.asarray, tables_of.build_hull_table([shape], np.float64))
    principal = quaternion_to_matrix(shape.principal)
    turned = np.array([(0, 1, 0), (1, 0, 0), (0, 0, -1)])  # b: upside down, its ridge along y
    place = np.stack([x, np.full(20, y), -depth], axis=1)
    offset = (place + turned @ centre - centre) @ principal
    rotation = principal.T @ turned @ principal
    rel = collision_primitives.RelativePose(
        tuple(tuple(jnp.full(20, c) for c in row) for row in rotation),
        tuple(jnp.asarray(c) for c in offset.T),
    )
    rows = (jnp.zeros(20, jnp.int32),) * 2
    is_asked = np.arange(20) % 5 != 2  # more than are searched at once

    @partial(jax.jit, compiler_options=supported_options("cpu"))
    def contact(table, rows, rel):
        found = contact_geometry.polytope_contact(table, rows, rel)
        pairs = jnp.asarray(is_asked), table, rows, rel, found.normal
        return (
            found.depth,
            found.weight,
            cached_features.edges_inside(*pairs),
            cached_features.edges_inside_where(*pairs),
        )

    found, weight, *ways = contact(table, rows, rel)
    np.testing.assert_allclose(found, depth, rtol=1e-9, atol=1e-16)
    np.testing.assert_array_equal(weight, 0)
    touches = is_asked & (depth > 1e-12)
    assert 8 < touches.sum() < is_asked.sum() < 20
    for length, point in ways:
        inside = np.where(touches, 8 * depth * np.tan(np.pi / 6), 0)
        np.testing.assert_allclose(length, inside, rtol=1e-9, atol=1e-15)
        crossing = (np.stack(point, axis=1) + offset) @ principal.T + centre
        right = np.stack([x, 0 * x, -depth / 2], axis=1)
        np.testing.assert_allclose(crossing[touches], right[touches], atol=1e-9)


@pytest.mark.long
def test_long_hulls_that_land_on_an_edge_bounce():
    """Of an impact at e = 1 with friction nothing gains energy, and nothing sinks in: 64
    orientations, of which about ten begin on an edge that is on no face that looks at the plate.
    """
    random = np.random.default_rng(1).normal(size=(24, 3))
    points = random / np.linalg.norm(random, axis=1, keepdims=True) * (0.03, 0.004, 0.003)
    settings = {
        "gravity": (0.0, 0.0, 0.0),
        "precision": "f64",
        "frame_interval": 0.0,
        "sample_interval": 1e-4,
        "duration": 0.02,
    }
    row = {
        "shape": "hull",
        "points": tuple(map(tuple, points.tolist())),
        "position": (0.0, 0.0, 0.2),
    }
    scene = validation.plate_scene(row, run=settings, restitution=1.0, friction_wall=10.0)
    (shape,) = assembly.assemble_system(scene).shapes
    turns = Rotation.random(64, random_state=5)
    heights = [1e-5 - (turn.as_matrix() @ shape.vertices.T)[2].min() for turn in turns]
    parameters = {
        "piece.0.position": [[0.0, 0.0, height] for height in heights],
        "piece.0.velocity": [[0.2, 0.1, -1.0]] * 64,
        "piece.0.orientation": turns.as_quat(scalar_first=True).tolist(),
    }
    run = ensemble(scene, 64, parameters=parameters)
    energy = run.energy["kinetic"] + run.energy["elastic"]
    assert (energy.max(axis=1) / energy[:, 0]).max() < 1.01  # no impact gains more at a stable step
    assert run.max_relative_overlap.max() < 0.5
