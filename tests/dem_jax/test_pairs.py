"""Whole runs by each way of searching for pairs, and what happens when the list of jax-md outgrows
its room.
"""

import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax.broad_phase import neighbour_list, overflow_recovery
from dem_jax.errors import SceneError
from dem_jax.runner import restart_state
from dem_jax.runner.interface import run_job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.scene import Scene

FLOOR = {
    "group": "floor",
    "corners": [(-0.2, -0.2, 0.0), (0.2, -0.2, 0.0), (0.2, 0.2, 0.0), (-0.2, 0.2, 0.0)],
}
SETTINGS = {"precision": "f64", "duration": 4e-3, "sample_interval": 1e-4, "frame_interval": 0.0}


def heap(neighbours):
    """Balls thrown at each other and at the floor: contacts begin all along the run."""
    cells = np.stack(np.unravel_index(np.arange(36), (3, 4, 3)), axis=1)[:, ::-1] - (1.0, 1.5, 0.0)
    place = 0.0212 * cells + (0.0, 0.0, 0.0105) + np.random.default_rng(0).uniform(0, 4e-4, (36, 3))
    towards = -8.0 * place * (1, 1, 0) - (0.0, 0.0, 0.5)
    rows = zip(place.tolist(), towards.tolist(), strict=True)
    pieces = [
        {"shape": "sphere", "radius": 0.01, "position": tuple(p), "velocity": tuple(v)}
        for p, v in rows
    ]
    return Scene(piece=pieces, wall=[FLOOR], run=SETTINGS | {"broad_phase": neighbours})


@pytest.fixture(scope="module")
def runs():
    return {choice: dem_jax.simulate(heap(choice)) for choice in ("all-pairs", "cells", "jax-md")}


@pytest.mark.parametrize("choice", ["cells", "jax-md"])
def test_a_run_does_not_depend_on_how_pairs_are_found(runs, choice):
    """To rounding, which collisions enlarge: the loads of a piece are added up in the order of the
    list.
    """
    one, other = runs["all-pairs"], runs[choice]
    scale = np.abs(one.force["floor"]).max()
    assert (one.energy["dissipated"][10] < 0.8 * one.energy["dissipated"][-1]) and scale > 10
    np.testing.assert_allclose(other.force["floor"], one.force["floor"], rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(
        other.momentum, one.momentum, rtol=0, atol=1e-9 * np.abs(one.momentum).max()
    )


@pytest.mark.long
def test_a_list_without_room_grows_and_the_run_is_the_same(runs):
    job = prepare_job(heap("jax-md"), (0,), None)
    small = job.system.partition._replace(pairs=60, cell=1, reach=4e-4, sides=(3, 3, 3))
    job = replace(job, system=job.system.replace(partition=small))
    grown = run_job(job, None, False, False)
    notes = " ".join(grown.header.info["reruns"])
    assert "more than 60 pairs in the list of jax-md" in notes
    assert (
        "pieces in a cell of jax-md for 1" in notes
        and "for a list of jax-md within 0.0004 m" in notes
    )
    ample = runs["jax-md"]
    scale = np.abs(ample.force["floor"]).max()
    np.testing.assert_allclose(
        grown.force["floor"], ample.force["floor"], rtol=0, atol=1e-9 * scale
    )


def test_a_restart_keeps_the_room_of_the_list():
    job = prepare_job(heap("jax-md"), (0,), None)
    larger = job.system.replace(
        partition=job.system.partition._replace(pairs=777, cell=41, reach=0.0123)
    )
    system, _ = restart_state.unpack_state(
        job.system,
        job.state,
        restart_state.pack_state(larger, job.state, job.piece_count),
        job.piece_count,
    )
    assert system.partition == larger.partition


@pytest.mark.long
def test_the_list_of_jax_md_can_be_made_for_many_members_at_once():
    job = prepare_job(heap("jax-md"), (0,), None)
    shifts = jnp.asarray([0.0, 0.002, 0.004], job.state.position.dtype)
    pressed = lambda shift: job.state.replace_motion(position=job.state.position * (1 - 15 * shift))
    rebuild = partial(neighbour_list.rebuild_neighbour_list, job.system)
    together = jax.jit(jax.vmap(rebuild))(jax.vmap(pressed)(shifts))
    counts = []
    for k, shift in enumerate(shifts):
        alone = jax.jit(rebuild)(pressed(shift))
        assert not overflow_recovery.describe_overflow(job.system, jax.device_get(alone.guard))
        for kind, table in alone.contacts.items():
            np.testing.assert_array_equal(together.contacts[kind].a[k], table.a)
            np.testing.assert_array_equal(together.contacts[kind].b[k], table.b)
        counts.append(sum(int((table.a >= 0).sum()) for table in alone.contacts.values()))
    assert counts[2] > counts[0]


def test_an_unknown_way_of_searching_is_an_error():
    with pytest.raises(
        SceneError,
        match='run.broad_phase = "octree": allowed: "auto" or "all-pairs" or "cells" or "jax-md"',
    ):
        dem_jax.load_scene("plate-drop", {"run.broad_phase": "octree"})


def test_the_list_of_jax_md_without_jax_md_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax_md", None)  # as if it were not installed
    with pytest.raises(
        SceneError,
        match=r"""run.broad_phase = "jax-md": needs jax-md: pip install 'product-impact\[jax-md\]'""",
    ):
        dem_jax.simulate(heap("jax-md"))
