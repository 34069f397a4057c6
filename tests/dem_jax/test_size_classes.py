"""Scenes filled up to the sizes of a class: the same physics, one program, and files of their own
size.
"""

import h5py
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.assembly.ensemble_capacity import PIECE_CLASSES, find_size_class
from dem_jax.runner import parameter_sweep, programs, restart_state
from dem_jax.runner.job_setup import prepare_job
from dem_jax.scene import load_scene
from dem_jax.scene.library import load_product

BALLS = {
    "portion": {
        "shape": "sphere", "radius": 0.01, "count": 3, "arrangement": "scattered",
        "region_low": [-0.04, -0.04, 0.0], "region_high": [0.04, 0.04, 0.06],
    },
    "piece": [], "name": "balls", "run.precision": "f64", "run.sizes": "classes",
    "run.duration": 0.03, "run.sample_interval": 2e-5, "run.frame_interval": 7e-4,
}  # fmt: skip
NUGGETS = {
    "portion": load_product("nugget", "a test")["portion"] | {
        "count": 2, "arrangement": "scattered", "region_low": [-0.03, -0.03, 0.0], "region_high": [0.03, 0.03, 0.06],
    },
    "piece": [], "name": "nuggets", "run.precision": "f64", "run.sizes": "classes",
    "run.duration": 0.03, "run.sample_interval": 5e-5, "run.frame_interval": 7e-4,
}  # fmt: skip


def scene_of(tree, **changes):
    return load_scene("plate-drop", tree | {k.replace("__", "."): v for k, v in changes.items()})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("sizes") / "whole.h5"
    programs.EXECUTABLES.clear()
    return dem_jax.simulate(scene_of(BALLS), seed=3, out=path), path


@pytest.mark.parametrize(
    "tree",
    [
        pytest.param(BALLS, id="spheres"),
        pytest.param(NUGGETS, id="general hulls", marks=pytest.mark.long),
    ],
)
def test_padding_is_inert(tree):
    filled, exact = (
        dem_jax.simulate(scene_of(tree, run__sizes=sizes), seed=3) for sizes in ("classes", "exact")
    )
    force = exact.force["plate"]
    assert np.abs(force).max() > 0.01 and exact.contact_count["plate"].max() > 0
    # pieces and slots outside add zeros, but in another order, and vectors are of other lengths
    np.testing.assert_allclose(
        filled.force["plate"], force, rtol=0, atol=1e-7 * np.abs(force).max()
    )
    np.testing.assert_allclose(filled.energy["total"], exact.energy["total"], rtol=1e-9)
    np.testing.assert_allclose(filled.pieces.position, exact.pieces.position, rtol=0, atol=1e-9)
    assert filled.piece_counts.tolist() == exact.piece_counts.tolist()


def test_other_counts_and_sizes_share_the_program(whole):
    for changes in ({"portion__count": 5}, {"portion__count": 16}, {"portion__scale_factor": 0.9}):
        run = dem_jax.simulate(scene_of(BALLS, run__duration=2e-3, **changes), seed=3)
        assert np.isfinite(run.energy["kinetic"]).all()
    found = dem_jax.ensemble(
        scene_of(BALLS, run__duration=2e-3),
        seed=(3, 3, 3),
        parameters={"portion.count": [2, 9, 4], "portion.scale_factor": [1.0, 0.7, 0.9]},
    )
    assert found.piece_counts.tolist() == [2, 9, 4] and found.header.piece_count == 9
    assert len(programs.EXECUTABLES) == 1
    beyond = scene_of(BALLS, run__duration=2e-3, portion__count=PIECE_CLASSES[0] + 1)
    beyond = beyond.replace({"portion.region_high": [0.08, 0.08, 0.12]})
    dem_jax.simulate(beyond, seed=3)
    assert len(programs.EXECUTABLES) == 2  # another class: the test can fail


def test_a_file_has_the_sizes_of_its_scene(whole, tmp_path):
    _, path = whole
    exact = tmp_path / "exact.h5"
    dem_jax.simulate(scene_of(BALLS, run__sizes="exact"), seed=3, out=exact)
    with h5py.File(path) as one, h5py.File(exact) as other:
        assert one["pieces/position"].shape == other["pieces/position"].shape
        forms = {
            name: other[f"restart/{name}"].shape for name in ("motion/position", "motion/force")
        }
        assert forms == {name: one[f"restart/{name}"].shape for name in forms}
        assert one["restart/contacts/spheres/a"].size <= other["restart/contacts/spheres/a"].size
    assert path.stat().st_size <= exact.stat().st_size * 1.01


def test_a_run_goes_on_with_the_same_bits(whole, tmp_path):
    run, _ = whole
    half = tmp_path / "half.h5"
    dem_jax.simulate(scene_of(BALLS, run__duration=0.02), seed=3, out=half)
    gone_on = dem_jax.resume(half, duration=0.03)
    np.testing.assert_array_equal(gone_on.force["plate"], run.force["plate"])
    np.testing.assert_array_equal(gone_on.pieces.position, run.pieces.position)


def test_a_state_of_exact_sizes_is_filled_up():
    """As of a file of a former version."""
    exact, filled = (
        prepare_job(scene_of(BALLS, run__sizes=sizes), (3,), None) for sizes in ("exact", "classes")
    )
    table = exact.state.contacts["plates"]
    panel = exact.system.parts.count  # the plate is numbered after the pieces
    table = table.replace(a=table.a.at[0].set(panel), b=table.b.at[0].set(1))
    state = exact.state.replace(contacts=exact.state.contacts | {"plates": table})
    arrays = restart_state.pack_state(exact.system, state, 3)
    _, found = restart_state.unpack_state(filled.system, filled.state, arrays, 3)
    assert found.position.shape == filled.state.position.shape == (3, PIECE_CLASSES[0])
    np.testing.assert_array_equal(found.position, filled.state.position)
    contacts = found.contacts["plates"]
    assert contacts.a[:2].tolist() == [filled.system.parts.count, -1] and contacts.b[0] == 1
    again = restart_state.pack_state(filled.system, found, 3)
    assert again["contacts/plates/a"].tolist() == [panel]
    np.testing.assert_array_equal(again["motion/position"], arrays["motion/position"])


def test_classes_of_products():
    def signature(product, count, sizes="classes"):
        scene = load_scene(
            "weigh-bucket", {"product": product, "portion.count": count, "run.sizes": sizes}
        )
        reuse = assembly.AssemblyCache()
        room = find_size_class([scene], reuse)
        return parameter_sweep.program_signature(
            assembly.assemble_system(scene, 0, None, reuse, room)
        )[:2]

    assert signature("almond", 20) == signature("peanut", 50)
    assert signature("almond", 20) != signature("peanut", 50, "exact")
    assert signature("marshmallow", 9) == signature("toffee", 16) != signature("toffee", 17)
    many = load_scene(
        "weigh-bucket", {"portion.count": PIECE_CLASSES[-1] + 1, "run.sizes": "classes"}
    )
    assert find_size_class([many], assembly.AssemblyCache()) is None
    listed = load_scene("plate-drop", {"run.sizes": "classes"})
    assert find_size_class([listed], assembly.AssemblyCache()) is None
