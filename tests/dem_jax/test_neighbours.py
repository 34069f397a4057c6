"""Candidate pairs against brute force, contact history across rebuilds, and what is reported when
something overflows.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from dem_jax import assembly
from dem_jax.broad_phase import candidate_search, neighbour_list, overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.scene import Scene

SETTINGS = {"precision": "f64", "sample_interval": 1e-4, "frame_interval": 0.0}
FLOOR = {
    "group": "floor",
    "corners": [(-0.4, -0.4, 0.0), (0.4, -0.4, 0.0), (0.4, 0.4, 0.0), (-0.4, 0.4, 0.0)],
}
SKIN = 2e-3
COUNT = 12


def poses(kind, random, count, size):
    """Places [N, 3] and orientations [N, 4]; size: of a piece."""
    q = random.normal(size=(count, 4))
    side = int(np.ceil(count ** (1 / 3)))
    cells = np.array(
        [(i, j, k) for k in range(side) for j in range(side) for i in range(side)][:count]
    )
    place = {
        "random": lambda: random.uniform(-1.5, 1.5, (count, 3)) * size + (0, 0, 1.6 * size),
        "packed": lambda: (cells - 1) * 0.6 * size + (0, 0, size),
        "clustered": lambda: random.normal(size=(count, 3)) * 0.25 * size + (0, 0, 0.7 * size),
        "collinear": lambda: np.outer(np.arange(count), (0, 0, 0.7 * size)) + (0, 0, 0.3 * size),
        "far apart": lambda: (cells - 1) * 3.0 * size + (0, 0, 5 * size),
    }[kind]()
    return place, q / np.linalg.norm(q, axis=1, keepdims=True)


KINDS = ("random", "packed", "clustered", "collinear", "far apart")


@pytest.fixture(scope="module")
def marshmallows():
    """A dozen marshmallows over a floor, with room for every pair."""
    pieces = [{"position": (0.07 * (k % 4), 0.07 * (k // 4), 0.3)} for k in range(COUNT)]
    made = assembly.assemble_system(Scene(piece=pieces, wall=[FLOOR], run=SETTINGS), 0)
    system = made.system.replace(skin=jnp.asarray(SKIN))
    every = (("hulls", *[candidate_search.pair_count("hulls", COUNT, 0, 1)] * 2),)
    system, state = overflow_recovery.with_capacity(
        system, made.state, every, COUNT, system.row_capacity
    )
    return made, system, state, jax.jit(partial(neighbour_list.rebuild_neighbour_list, system))


def placed(state, place, orientation):
    return state.replace_motion(
        position=jnp.asarray(place.T), orientation=jnp.asarray(orientation.T)
    )


def corners(made, place, orientation):
    """Vertices [N, V, 3] in the world."""
    turn = Rotation.from_quat(orientation, scalar_first=True).as_matrix()
    return np.einsum("nij,vj->nvi", turn, made.shapes[0].vertices) + place[:, None]


def distance(a, b):
    """Distance (m) of two convex bodies from their corners; 0 if they overlap."""
    found = ConvexHull((b[None] - a[:, None]).reshape(-1, 3))
    rows = np.vstack([-found.equations[:, :3].T, found.equations[:, 3]])
    if found.equations[:, 3].max() <= 0:
        return 0.0
    left = rows @ nnls(rows, np.array([0, 0, 0, 1.0]))[0] - np.array([0, 0, 0, 1.0])
    return np.linalg.norm(left[:3] / left[3])


def pairs_in(table):
    return {
        (a, b)
        for a, b in zip(np.asarray(table.a).tolist(), np.asarray(table.b).tolist(), strict=True)
        if a >= 0
    }


@pytest.mark.parametrize("kind", KINDS)
def test_every_pair_nearer_than_the_skin_is_a_candidate(marshmallows, kind):
    made, _, state, rebuild = marshmallows
    random = np.random.default_rng(1)
    place, orientation = poses(kind, random, COUNT, 0.045)
    found = rebuild(placed(state, place, orientation))
    listed = pairs_in(found.contacts["hulls"])
    solid = corners(made, place, orientation)
    near = {
        (i, j)
        for i in range(COUNT)
        for j in range(i + 1, COUNT)
        if distance(solid[i], solid[j]) < SKIN
    }
    near |= {(COUNT, k) for k in range(COUNT) if -0.01 - SKIN < solid[k, :, 2].min() < SKIN}
    assert near <= listed
    assert len(near) >= (0 if kind == "far apart" else 5)
    if kind == "far apart":
        assert not listed
    incidence = np.asarray(found.incidence)
    loads = np.sum(incidence < 2 * found.contacts["hulls"].a.shape[0], axis=0)
    each = [sum(k in pair for pair in listed) for k in range(COUNT)]
    np.testing.assert_array_equal(loads, each)


CHOICES = ("all-pairs", "cells", "jax-md")


@pytest.mark.parametrize("precision", ["f32", pytest.param("f64", marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", KINDS)
def test_all_ways_of_searching_find_the_pairs_of_a_brute_force_search(kind, precision):
    """300 spheres; some lie outside the domain that cells are counted in."""
    random = np.random.default_rng(2)
    place, _ = poses(kind, random, COUNT_SPHERES, 2 * RADIUS)
    if kind == "clustered":
        place = place * 3
    place = place.astype({"f32": np.float32, "f64": np.float64}[precision])
    found = {}
    for choice in CHOICES:
        system, state, rebuild = spheres(choice, precision)
        box = {name: jnp.asarray(corner) for name, corner in box_around(place, kind).items()}
        after = rebuild(
            system.replace(skin=jnp.full_like(system.skin, SKIN), **box),
            state.replace_motion(position=jnp.asarray(place.T)),
        )
        assert not overflow_recovery.describe_overflow(system, jax.device_get(after.guard))
        found[choice] = pairs_in(after.contacts["spheres"])
    place = place.astype(float)
    gap = np.linalg.norm(place[:, None] - place[None], axis=-1) - 2 * RADIUS
    rounding = 2e-7 if precision == "f32" else 1e-15  # m, of places of up to 1 m or less
    near = lambda within: set(
        zip(*(rows.tolist() for rows in np.nonzero(np.triu(gap < within, 1))), strict=True)
    )
    assert near(SKIN - rounding) <= found["all-pairs"] <= near(SKIN + rounding)
    assert found["cells"] == found["jax-md"] == found["all-pairs"]
    assert len(found["cells"]) > 50 or kind == "far apart"


def test_a_table_of_parts_has_the_pairs_of_the_list_in_their_order(monkeypatch):
    """Parts of one piece, which overlap, are none."""
    two = [
        {"shape": "sphere", "radius": RADIUS, "position": (x, 0.0, 0.0)}
        for x in (-0.5 * RADIUS, 0.5 * RADIUS)
    ]
    place, turn = poses("clustered", np.random.default_rng(5), 30, 4 * RADIUS)
    rows = zip(place.tolist(), turn.tolist(), strict=True)
    pieces = [
        {"shape": "compound", "part": two, "position": at, "orientation": q} for at, q in rows
    ]
    made = assembly.assemble_system(Scene(piece=pieces, wall=[FLOOR], run=SETTINGS), 0)
    every = tuple(
        (kind, *[candidate_search.pair_count(kind, 0, 60, 1)] * 2)
        for kind, *_ in made.system.capacity
    )
    system, state = overflow_recovery.with_capacity(
        made.system.replace(skin=jnp.asarray(SKIN)), made.state, every, 120, 0
    )
    tables = []
    for many in (61, 60):
        monkeypatch.setattr(candidate_search, "TABLE_MIN_PARTS", many)
        tables.append(
            jax.jit(
                lambda state: neighbour_list.rebuild_neighbour_list(system, state).contacts[
                    "spheres"
                ]
            )(state)
        )
    owner, one = np.asarray(system.parts.owner), jax.device_get(tables[0])
    live = one.a >= 0
    assert 100 < live.sum() < 60 * 59 / 2 - 30 and (owner[one.a[live]] != owner[one.b[live]]).all()
    for name in ("a", "b"):
        np.testing.assert_array_equal(getattr(tables[1], name), getattr(one, name))


def box_around(place, kind):
    low, high = place.min(0), place.max(0)
    if kind == "random":  # some of the pieces have left
        low, high = low + place.dtype.type(0.01), high - place.dtype.type(0.01)
    return {"domain_low": low, "domain_high": high}


COUNT_SPHERES, RADIUS = 300, 0.01
_SPHERES = {}


def spheres(choice, precision):
    """A system of spheres with room for very many pairs, its state, and its compiled rebuild; made
    once.
    """
    if (choice, precision) not in _SPHERES:
        pieces = [
            {
                "shape": "sphere",
                "radius": RADIUS,
                "position": (0.025 * (k % 20), 0.025 * (k // 20), 0.0),
            }
            for k in range(COUNT_SPHERES)
        ]
        made = assembly.assemble_system(
            Scene(piece=pieces, run=SETTINGS | {"precision": precision, "broad_phase": choice}), 0
        )
        system = made.system
        if choice == "jax-md":
            system = system.replace(
                partition=system.partition._replace(pairs=30_000, cell=120, reach=1.5 * SKIN)
            )
        system, state = overflow_recovery.with_capacity(
            system, made.state, (("spheres", 20000, 20000),), COUNT_SPHERES, COUNT_SPHERES
        )
        _SPHERES[choice, precision] = system, state, jax.jit(neighbour_list.rebuild_neighbour_list)
    return _SPHERES[choice, precision]


def test_too_many_pairs_are_reported_not_lost_in_silence(marshmallows):
    made, _, state, _ = marshmallows
    small = (("hulls", 8, 8),)
    system = made.system.replace(skin=jnp.asarray(SKIN), capacity=small, touching=2)
    tables = {"hulls": neighbour_list.init_contact_table(system, "hulls", 8)}
    state = overflow_recovery.with_empty_scratch(
        system,
        placed(made.state, *poses("clustered", np.random.default_rng(3), COUNT, 0.045)).replace(
            contacts=tables
        ),
    )
    after = jax.device_get(jax.jit(neighbour_list.rebuild_neighbour_list)(system, state)).guard
    assert after.needed["hulls"][0] > 8
    assert after.touching > 2
    said = " ".join(overflow_recovery.describe_overflow(system, after))
    assert "of hulls for 8" in said and "contacts of a piece" in said
    larger, again = overflow_recovery.grow_capacity(system, state, after)
    for _ in range(4):  # what was cut off in one stage shows in the next
        after = jax.device_get(jax.jit(neighbour_list.rebuild_neighbour_list)(larger, again)).guard
        left = overflow_recovery.describe_overflow(larger, after)
        if not left:
            break
        larger, again = overflow_recovery.grow_capacity(larger, again, after)
    assert not left


def test_every_search_counts_the_pairs_that_it_has_no_room_for():
    """With room for 64 candidates, all ways of searching report as many as with room for all."""
    place, _ = poses("clustered", np.random.default_rng(2), COUNT_SPHERES, 2 * RADIUS)
    needed = {}
    for choice in ("all-pairs", "cells"):
        for room in (64, 20000):
            system, state, rebuild = spheres(choice, "f64")
            box = {
                name: jnp.asarray(corner) for name, corner in box_around(place, "clustered").items()
            }
            small = system.replace(
                capacity=(("spheres", room, 20000),), skin=jnp.full_like(system.skin, SKIN), **box
            )
            after = rebuild(small, state.replace_motion(position=jnp.asarray(place.T)))
            needed[choice, room] = int(after.guard.needed["spheres"][0])
    assert len(set(needed.values())) == 1 and needed["cells", 64] > 640


@pytest.mark.long
def test_the_order_of_the_slots_does_not_matter(marshmallows):
    """Tables permuted before a rebuild keep the history of each pair, and the forces of the next
    step.
    """
    _, system, state, rebuild = marshmallows
    random = np.random.default_rng(4)
    state = placed(state, *poses("packed", random, COUNT, 0.045))
    advance = jax.jit(partial(stepping.advance_step, system))
    settled = rebuild(state)
    for _ in range(3):
        settled = advance(settled)
    table = settled.contacts["hulls"]
    assert (np.asarray(table.memory.law.force) > 0).sum() > 5 and np.abs(
        np.asarray(table.memory.law.spring)
    ).max() > 0
    order = random.permutation(table.a.shape[0])
    tables = {"hulls": jax.tree.map(lambda x: x[..., order], table)}
    mixed = settled.replace(
        contacts=tables, incidence=neighbour_list.find_incidence(system, tables).load_columns
    )
    one, other = (advance(rebuild(s)) for s in (settled, mixed))
    np.testing.assert_array_equal(
        one.contacts["hulls"].memory.law.force, other.contacts["hulls"].memory.law.force
    )
    np.testing.assert_array_equal(one.motion.force, other.motion.force)
    np.testing.assert_array_equal(one.motion.torque, other.motion.torque)
    # and a rebuild between two steps changes nothing
    np.testing.assert_allclose(
        advance(settled).motion.force,
        one.motion.force,
        rtol=0,
        atol=1e-12 * np.abs(one.motion.force).max(),
    )


def incline(rebuild_steps):
    """A marshmallow on a slope of 10 degrees (as gravity askew), below the angle of friction, and
    what became of it.
    """
    piece = {"position": (0.0, 0.0, 0.008 - 2e-6)}
    slope = np.radians(10)
    gravity = (9.81 * np.sin(slope), 0.0, -9.81 * np.cos(slope))
    settings = {**SETTINGS, "gravity": gravity, "max_rebuild_interval": rebuild_steps}
    made = assembly.assemble_system(Scene(piece=[piece], wall=[FLOOR], run=settings), 0)
    state, recorded, _ = stepping.run_compiled_chunk(
        made.system, made.state, np.int32(1000), np.int32(1), samples=1024, frames=0
    )
    assert not overflow_recovery.describe_overflow(made.system, jax.device_get(state.guard))
    return made, state, jax.tree.map(lambda x: np.asarray(x)[:1000], recorded)


def test_a_stuck_contact_holds_through_many_rebuilds():
    made, often, trace = incline(16)
    rare, seldom, _ = incline(512)
    assert (
        1000 * made.system.sample_parts >= 1000
        and rare.system.block_steps > 8 * made.system.block_steps
    )
    np.testing.assert_allclose(often.position, seldom.position, rtol=0, atol=1e-12)
    # m g sin 10 / K_t is 0.3 um; without its spring it would have gone 8 mm down the slope
    assert abs(float(often.position[0, 0])) < 2e-5
    force = trace.mean_force[-500:, :, 0].mean(0)
    weight = 5.832e-3 * 9.81
    np.testing.assert_allclose(
        force,
        weight * np.array([np.sin(np.radians(10)), 0, -np.cos(np.radians(10))]),
        atol=5e-3 * weight,
    )


def test_the_noted_way_bounds_how_far_bodies_have_approached_each_other(marshmallows):
    """Pieces that fly and spin at random for some steps: no gap shrinks by more, so no pair within
    it was missed.
    """
    made, system, state, rebuild = marshmallows
    random = np.random.default_rng(5)
    advance = jax.jit(partial(stepping.advance_step, system.replace(touching=1)))
    place, orientation = poses("random", random, COUNT, 0.09)
    solid = corners(made, place, orientation)
    gaps = lambda s: np.array(
        [distance(s[i], s[j]) for i in range(COUNT) for j in range(i + 1, COUNT)]
    )
    before, tightest = gaps(solid), []
    for speed in (0.1, 1.0, 10.0):
        start = rebuild(placed(state, place, orientation))
        spin = random.normal(size=(3, COUNT)) * speed / 0.03 * np.asarray(system.pieces.inertia)
        start = start.replace_motion(
            velocity=jnp.asarray(random.normal(size=(3, COUNT)) * speed),
            angular_momentum=jnp.asarray(spin),
        )
        for _ in range(6):
            start = advance(start)
        said = float(start.scratch.displacement[0])
        moved = corners(made, np.asarray(start.position).T, np.asarray(start.orientation).T)
        shrunk = (before - gaps(moved)).max()
        assert 0 < shrunk <= said
        floor = solid[:, :, 2].min(1) - moved[:, :, 2].min(1)
        assert floor.max() <= said
        tightest.append(shrunk / said)
    assert max(tightest) > 0.2  # a bound that is of use
