"""Runs whose portion was settled before their command arrived: the bits of any other run."""

from unittest.mock import Mock

import numpy as np
import pytest

from dem_jax import program_store
from dem_jax.errors import SceneError
from dem_jax.runner import settled_ahead
from dem_jax.runner.interface import run_job, simulate
from dem_jax.scene import load_scene

SCENE = load_scene("quick-release").replace(
    {
        "run.duration": 0.08,
        "portion.settling_time": 0.12,
        "portion.count": 3,
        "run.sizes": "classes",
        "name": "heap",
    }
)
SERIES = ("mean_force", "peak_force", "settled_mass")


def assert_same_bits(run, other):
    assert run.seed == other.seed and run.scene == other.scene
    assert all(
        run.info.get(name) == other.info.get(name) for name in ("notes", "reruns", "settling")
    )
    for name in SERIES:
        for group, values in getattr(run, name).items():
            np.testing.assert_array_equal(values, getattr(other, name)[group])
    np.testing.assert_array_equal(run.pieces.position, other.pieces.position)


@pytest.mark.parametrize("most", [99, 2, 0])
def test_a_settled_run_has_the_bits_of_another(most):
    """Settled to its release, or not to the end as an order had come; under another name."""
    asked = []
    settled_ahead.settle_ahead(SCENE, 5, lambda: asked.append(1) or len(asked) <= most)
    scene = SCENE.replace({"name": "other"})
    job = settled_ahead.take_job(scene, 5)
    assert job.ahead[-1].end == 0 if most == 99 else len(job.ahead) == most
    assert_same_bits(run_job(job), simulate(scene, seed=5))
    assert not settled_ahead.take_job(scene, 5).ahead, "it was taken"


@pytest.fixture
def files(tmp_path):
    """The folder of the store of programs, empty."""
    program_store.use_folder(tmp_path)
    return tmp_path


def settle_from_file(monkeypatch, scene, seed):
    """Settle without computing a chunk; the job."""
    with monkeypatch.context() as changed:
        changed.setattr(settled_ahead, "_settle", Mock(side_effect=AssertionError("computed")))
        settled_ahead.settle_ahead(scene, seed, lambda: True)
    return settled_ahead.take_job(scene, seed)


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_settled_portion_is_read_from_its_file(files, monkeypatch, precision):
    """With the same bits, also under another name; that of another seed or height is not there."""
    scene = SCENE.replace({"run.precision": precision})
    settled_ahead.settle_ahead(scene, 5, lambda: True)
    job = settle_from_file(monkeypatch, scene.replace({"name": "other"}), 5)
    assert job.ahead[-1].end == 0
    assert_same_bits(run_job(job), simulate(scene.replace({"name": "other"}), seed=5))
    for changes, seed in (({}, 6), ({"drop.height": 0.3}, 5)):
        with pytest.raises(AssertionError, match="computed"):
            settle_from_file(monkeypatch, scene.replace(changes), seed)


def test_a_damaged_file_is_computed_anew_and_the_oldest_are_removed(files, monkeypatch):
    monkeypatch.setattr(settled_ahead, "MOST_FILES", 1)
    program = files / "program-0"
    program.touch()
    settled_ahead.settle_ahead(SCENE, 5, lambda: True)
    (path,) = files.glob("settled-*")
    path.write_bytes(path.read_bytes()[:-100])
    settled_ahead.settle_ahead(SCENE, 5, lambda: True)
    assert settled_ahead.take_job(SCENE, 5).ahead[-1].end == 0
    settled_ahead.settle_ahead(SCENE, 6, lambda: True)
    assert len(list(files.glob("settled-*"))) == 1 and not path.exists()
    assert program.exists(), "programs are counted by themselves"


@pytest.mark.parametrize(
    "goes_on, changes", [(False, {}), (True, {"portion.arrangement": "scattered"})]
)
def test_a_portion_that_does_not_settle_leaves_no_file(files, goes_on, changes):
    settled_ahead.settle_ahead(SCENE.replace(changes), 5, lambda: goes_on)
    assert not list(files.glob("settled-*"))


def test_a_portion_that_cannot_settle_leaves_nothing(files, monkeypatch):
    monkeypatch.setattr(settled_ahead, "_settle", Mock(side_effect=SceneError("overlap")))
    with pytest.raises(SceneError):
        settled_ahead.settle_ahead(SCENE, 5, lambda: True)
    assert not settled_ahead._KEPT


def test_a_portion_at_rest_is_released_early():
    scene = SCENE.replace({"portion.settling_time": 0.6, "run.until_settled": True})
    settled_ahead.settle_ahead(scene, 0, lambda: True)
    job = settled_ahead.take_job(scene, 0)
    assert job.ahead[-1].settled and job.ahead[-1].end < 0
    assert_same_bits(run_job(job), simulate(scene))


@pytest.mark.parametrize("changes, seed", [({}, 6), ({"drop.height": 0.3}, 5)])
def test_another_run_begins_anew(changes, seed):
    settled_ahead.settle_ahead(SCENE, 5, lambda: True)
    assert not settled_ahead.take_job(SCENE.replace(changes), seed).ahead


def test_a_scene_that_cannot_be_used_leaves_nothing(monkeypatch):
    settled_ahead.settle_ahead(SCENE, 5, lambda: True)
    with monkeypatch.context() as changed, pytest.raises(SceneError):
        changed.setattr(settled_ahead, "prepare_job", Mock(side_effect=SceneError("too many")))
        settled_ahead.settle_ahead(SCENE, 5, lambda: True)
    assert not settled_ahead.take_job(SCENE, 5).ahead
