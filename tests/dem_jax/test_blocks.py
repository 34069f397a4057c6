"""Slots computed block by block as far as they are filled, and free fall in one jump: the same
motion as all at once.
"""

import jax
import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.broad_phase import overflow_recovery
from dem_jax.contacts import tiling
from dem_jax.dynamics import stepping
from dem_jax.scene import load_scene

SAMPLES, PER_CHUNK = 200, 50  # of 30 us


def heap():
    """Layers of marshmallows that fall on a plate and on each other."""
    pieces = []
    for k in range(36):
        layer = k // 12
        orientation = (
            (1.0, 0.0, 0.0, 0.0)
            if layer == 0
            else (1.0, 0.02 * (k % 5), 0.03 * (k % 3), 0.1 * (k % 7))
        )
        position = (0.056 * (k % 4) + 0.01 * layer, 0.0245 * (k // 4 % 3), 0.0082 + 0.021 * layer)
        speed = (0.05 * (k % 3), 0.04 * (k % 4), -0.2 - 0.3 * layer)
        pieces.append({"position": position, "orientation": orientation, "velocity": speed})
    return load_scene("plate-drop").replace(
        piece=pieces, run={"precision": "f64", "frame_interval": 0.0}
    )


def high():
    """Two spinning marshmallows without contacts until each strikes the plate, both within a window
    of rebuild.
    """
    pieces = [
        {
            "position": (0.0, 0.0, 0.04),
            "velocity": (0.1, 0.0, -1.5),
            "angular_velocity": (30.0, -20.0, 10.0),
        },
        {
            "position": (0.1, 0.0, 0.018),
            "velocity": (0.0, 0.0, -2.0),
            "angular_velocity": (0.0, 10.0, 30.0),
        },
    ]
    return load_scene("plate-drop").replace(
        piece=pieces, run={"precision": "f64", "frame_interval": 0.0}
    )


def tubes():
    """Tubes that land upright on a plate of two panels, across the seam, and one that leans on
    them.
    """
    tube = {
        "shape": "tube",
        "outer_radius": 0.012,
        "inner_radius": 0.009,
        "height": 0.03,
        "sides": 6,
    }
    upright = [
        {"position": (0.026 * (k % 3), 0.026 * (k // 3) - 0.013, 0.01501), "velocity": (0, 0, -0.3)}
        for k in range(6)
    ]
    leaning = {
        "position": (0.03, 0.001, 0.0475),
        "orientation": (1.0, 0.9, 0.2, 0.0),
        "velocity": (0.0, 0.1, -0.8),
    }
    halves = [
        [(-0.1, y, 0.0), (0.2, y, 0.0), (0.2, y + 0.15, 0.0), (-0.1, y + 0.15, 0.0)]
        for y in (-0.15, 0.0)
    ]
    wall = [{"group": "plate", "corners": corners} for corners in halves]
    scene = load_scene("plate-drop").replace(
        piece=[tube | at for at in (*upright, leaning)], wall=wall
    )
    return scene.replace(run={"precision": "f64", "frame_interval": 0.0})


def roomy(made, slot_block):
    """System and first state with so many slots that there are several blocks."""
    system = made.system.replace(slot_block=slot_block)
    return overflow_recovery.with_capacity(
        system, made.state, tuple((k, 640, 176) for k, *_ in system.capacity), 24, 0
    )


def traced(scene, slot_block, count=SAMPLES):
    """State after ``count`` samples, these, and the fewest and most slots that were filled."""
    system, state = roomy(assembly.assemble_system(scene, 0), slot_block)
    samples, filled = [], []
    for _ in range(count // PER_CHUNK):
        state, rows, _ = stepping.run_compiled_chunk(
            system, state, np.int32(PER_CHUNK), np.int32(1), samples=PER_CHUNK, frames=0
        )
        samples.append(jax.device_get(rows))
        filled.append(sum(int(n) for n in state.scratch.filled.values()))
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    return (
        jax.device_get(state),
        jax.tree.map(lambda *x: np.concatenate(x), *samples),
        (min(filled), max(filled)),
    )


def difference(a, b):
    """The largest difference of any array, relative to the largest entry of each (absolute where
    that is tiny).
    """
    worst = 0.0
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        scale = max(np.abs(y).max(initial=0), 1e-6)
        worst = max(worst, np.abs(np.asarray(x, float) - y).max(initial=0) / scale)
    return worst


def test_blocks_of_slots_do_not_change_the_trace():
    with jax.enable_x64(True):
        state, samples, _ = traced(heap(), 0)
        in_blocks, rows, (_, most) = traced(heap(), 64)
        size = tiling.tile_size(
            assembly.assemble_system(heap(), 0).system.replace(slot_block=64), "hulls", 176
        )
    assert most > 2 * size > 0  # several blocks
    touching = np.asarray(in_blocks.contacts["hulls"].memory.overlap).reshape(-1, size) > 0
    filled = touching[: -(-int(in_blocks.scratch.filled["hulls"]) // size)]
    assert filled[0].all() and not filled.any(axis=1).all()  # and some, behind, where nothing
    # touches
    no_wall = (
        np.asarray(in_blocks.contacts["hulls"].a).reshape(-1, size) < len(state.position[0])
    ).all(axis=1)
    assert no_wall[0] and 1 < no_wall[: len(filled)].sum() < len(filled)  # which share their hulls,
    # and some that do not
    assert np.abs(samples.force).max() > 10
    for name in ("position", "orientation", "velocity", "angular_momentum"):
        # contacts amplify rounding
        assert difference(getattr(in_blocks, name), getattr(state, name)) < 1e-7, name
    assert difference(rows.force[:60], samples.force[:60]) < 1e-9
    assert difference(rows.energy, samples.energy) < 1e-7


@pytest.mark.long
def test_blocks_of_slots_of_shared_surfaces_do_not_change_the_trace(monkeypatch):
    """Each tube stands on six parts and two panels, in contacts that lie in several blocks and are
    one.
    """
    monkeypatch.setattr(tiling, "MIN_TILE_SIZE", 4)
    with jax.enable_x64(True):
        state, samples, _ = traced(tubes(), 0, 100)
        in_blocks, rows, (_, most) = traced(tubes(), 4, 100)
        room = in_blocks.contacts["hulls"].a.shape[0]
        size = tiling.tile_size(
            assembly.assemble_system(tubes(), 0).system.replace(slot_block=4), "hulls", room
        )
    assert most > 4 * size > 0
    siblings, filled = (
        in_blocks.scratch.shared_contacts["hulls"],
        int(in_blocks.scratch.filled["hulls"]),
    )
    block = np.arange(room) // size
    order, first, number = (
        np.asarray(of) for of in (siblings.order, siblings.first, siblings.number)
    )
    apart = [
        block[slot] != block[other]
        for slot in range(room)
        for other in order[first[slot] :][: number[slot]]
    ]
    touching = (np.asarray(in_blocks.contacts["hulls"].memory.overlap) > 0)[:filled]
    assert any(apart) and touching.any() and not touching.all()
    assert np.abs(samples.force).max() > 10
    for name in ("position", "orientation", "velocity", "angular_momentum"):
        assert difference(getattr(in_blocks, name), getattr(state, name)) < 1e-7, name
    assert difference(rows.force[:60], samples.force[:60]) < 1e-9
    assert difference(rows.energy, samples.energy) < 1e-7


@pytest.mark.long
def test_free_fall_in_one_jump_is_that_step_by_step():
    tolerance = 1e-11
    with jax.enable_x64(True):
        state, samples, _ = traced(high(), 0)
        jumped, rows, (fewest, _) = traced(high(), 64)
    struck = np.argmax(np.abs(samples.force[:, 2, 0]) > 0)
    assert fewest == 0 and 0 < struck < SAMPLES - 20 and np.abs(samples.force).max() > 1
    assert np.argmax(np.abs(rows.force[:, 2, 0]) > 0) == struck
    before = jax.tree.map(lambda x: x[:struck], (rows, samples))
    assert difference(before[0].energy, before[1].energy) < tolerance
    for name in ("position", "orientation", "velocity", "angular_momentum"):
        assert difference(getattr(jumped, name), getattr(state, name)) < 100 * tolerance, name
    assert difference(rows.mean_force, samples.mean_force) < 100 * tolerance


def test_free_fall_is_exact_where_it_can_be():
    with jax.enable_x64(True):
        scene = high().replace(run={"gravity": (1.0, -2.0, -9.81)})
        made, time = assembly.assemble_system(scene, 0), 20 * scene.run.sample_interval
        system, state = roomy(made, 64)
        state, samples, _ = stepping.run_compiled_chunk(
            system, state, np.int32(20), np.int32(1), samples=PER_CHUNK, frames=0
        )
        samples = jax.tree.map(lambda x: x[:20], samples)
        g, v = np.array([1.0, -2.0, -9.81]), np.array([p.velocity for p in scene.piece])
        start = np.array([p.position for p in scene.piece])
        assert (
            int(state.step) == 20 * made.step.substeps and sum(state.scratch.filled.values()) == 0
        )
        np.testing.assert_allclose(
            state.position.T, start + v * time + 0.5 * g * time**2, rtol=0, atol=1e-15
        )
        np.testing.assert_allclose(state.velocity.T, v + g * time, rtol=0, atol=1e-14)
        spin = np.asarray(samples.energy[:, 0]) + np.asarray(samples.energy[:, 1])
        np.testing.assert_allclose(spin, spin[0], rtol=1e-7)
