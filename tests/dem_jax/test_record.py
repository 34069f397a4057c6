"""Files of runs: layout and units, what survives a kill, refusal to overwrite, damaged files, PIF."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from dem_jax.deprecation import FormerNameWarning
from dem_jax.errors import RecordError
from dem_jax.io.former_datasets import FORMER_LABELS, FORMER_QUANTITIES
from dem_jax.io.run_files import (
    Run,
    RunHeader,
    StoredQuantity,
    Writer,
    collect_series,
    load_restart,
    load_run,
)

LABELS = {  # of the made-up runs' quantities
    **dict.fromkeys(("force", "mean_force", "torque"), ("wb_flaps", "wb_walls")),
    "settled_mass": ("wb",),
    "energy": ("kinetic", "potential"),
    "momentum": None,
    "max_relative_overlap": None,
}
KNOWN = RunHeader("", 0, 1.0, "", "", 1.0, (), (), (), 1).stored_quantities
STORED = tuple(
    stored._replace(labels=LABELS[stored.name]) for stored in KNOWN if stored.name in LABELS
)
REPOSITORY = Path(__file__).resolve().parents[2]


def header(**changes):
    plain = RunHeader(
        scene='base = "weigh-bucket"\n[portion]\nscale_factor = 1.0\n',
        seed=7,
        dt=5.0e-6,
        precision="f64",
        version="0.1.0",
        sample=30e-6,
        gravity=(0.0, 0.0, -9.81),
        groups=("wb_flaps", "wb_walls"),
        blocks=("wb",),
        piece_count=3,
        info={"limited by": "unloading"},
        quantities=STORED,
    )
    return replace(plain, **changes)


def samples(start, count, runs=None, seed=0):
    """Samples start ... start + count of a made-up run; every value tells its place, so that a
    mix-up shows.
    """
    rng = np.random.default_rng((seed, start))
    lead = () if runs is None else (runs,)
    index = np.broadcast_to(np.arange(start, start + count, dtype=float), (*lead, count))
    vector = index[..., None] * (1.0, 2.0, -3.0) + rng.normal(size=(*lead, count, 3))
    return {
        "time": 30e-6 * (1 + np.arange(start, start + count)),
        "force": {"wb_flaps": vector, "wb_walls": -vector},
        "mean_force": {"wb_flaps": 2 * vector, "wb_walls": 3 * vector},
        "torque": {"wb_flaps": 4 * vector, "wb_walls": 5 * vector},
        "settled_mass": {"wb": index * 1e-3},
        "energy": {"kinetic": index + 0.25, "potential": -index},
        "max_relative_overlap": index * 1e-4,
        "momentum": vector + 1,
    }


def frames(start, count, runs=None):
    lead = () if runs is None else (runs,)
    at = np.arange(start, start + count, dtype=float)
    pose = np.broadcast_to(at[:, None, None], (*lead, count, 3, 3))
    return {
        "time": at * 1e-3,
        "position": pose + 0.0,
        "orientation": np.broadcast_to([1.0, 0, 0, 0], (*lead, count, 3, 4)),
        "velocity": pose + 0.5,
        "angular_velocity": pose - 0.5,
    }


def written(path, runs=None, chunks=((0, 50), (50, 1), (51, 1500))):
    with Writer.create(path, header(run_count=runs), interval=0) as writer:
        for i, (start, count) in enumerate(chunks):
            state = {
                "position": np.full((3, 3), float(start)),
                "contact/partner": np.array([i, -1]),
                "step": np.int64(i),
            }
            writer.append(samples(start, count, runs), frames(2 * i, 2, runs), state)
    return [samples(start, count, runs) for start, count in chunks]


def joined(parts, *path, axis=0):
    arrays = []
    for part in parts:
        for key in path:
            part = part[key]
        arrays.append(part)
    return np.concatenate(arrays, axis=axis)


def test_a_file_has_the_documented_layout_with_units(tmp_path):
    parts = written(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5") as file:
        shapes = {}
        file.visititems(
            lambda name, item: (
                shapes.update({name: item.shape}) if isinstance(item, h5py.Dataset) else None
            )
        )
        assert all(isinstance(file[name].attrs["units"], str) for name in shapes)
        units = {
            "time": "s",
            "force/wb_flaps": "N",
            "mean_force/wb_walls": "N",
            "settled_mass/wb": "kg",
            "energy/kinetic": "J",
        }
        units |= {
            "torque/wb_flaps": "N m",
            "pieces/position": "m",
            "pieces/angular_velocity": "rad/s",
            "max_relative_overlap": "1",
        }
        assert {name: file[name].attrs["units"] for name in units} == units
        assert (
            shapes["time"] == (1551,)
            and shapes["force/wb_flaps"] == (1551, 3)
            and shapes["settled_mass/wb"] == (1551,)
        )
        assert shapes["pieces/time"] == (6,) and shapes["pieces/orientation"] == (6, 3, 4)
        np.testing.assert_array_equal(file["force/wb_flaps"], joined(parts, "force", "wb_flaps"))
        assert file["time"].dtype == np.float64
        assert file.attrs["scene"] == header().scene
        assert (file.attrs["seed"], file.attrs["dt"], file.attrs["precision"]) == (7, 5e-6, "f64")
        np.testing.assert_array_equal(file["restart/position"], 51.0)  # the last state only
        np.testing.assert_array_equal(file["restart/contact/partner"], [2, -1])


@pytest.mark.parametrize("runs", [None, 5])
def test_a_run_comes_back_as_it_was_written(tmp_path, runs):
    parts = written(tmp_path / "run.h5", runs)
    run = load_run(tmp_path / "run.h5")
    axis = 0 if runs is None else 1
    np.testing.assert_array_equal(run.time, joined(parts, "time"))
    for kind in ("force", "mean_force", "torque", "settled_mass", "energy"):
        found = getattr(run, kind)
        assert set(found) == set(parts[0][kind])
        for name in found:
            np.testing.assert_array_equal(found[name], joined(parts, kind, name, axis=axis))
    np.testing.assert_array_equal(
        run.max_relative_overlap, joined(parts, "max_relative_overlap", axis=axis)
    )
    np.testing.assert_array_equal(run.momentum, joined(parts, "momentum", axis=axis))
    np.testing.assert_array_equal(run.pieces.position, frames(0, 6, runs)["position"])
    assert run.header == header(run_count=runs)
    assert (run.scene, run.seed, run.dt, run.precision) == (header().scene, 7, 5e-6, "f64")
    assert run.restart["step"] == 2 and run.restart["step"].dtype == np.int64


def test_single_precision_stays_single_but_time_does_not(tmp_path):
    single = {
        n: {k: v.astype(np.float32) for k, v in a.items()} if isinstance(a, dict) else a
        for n, a in samples(0, 9).items()
    }
    with Writer.create(tmp_path / "run.h5", header(precision="f32")) as writer:
        writer.append({**single, "time": single["time"].astype(np.float32)})
    run = load_run(tmp_path / "run.h5")
    assert run.force["wb_flaps"].dtype == np.float32 and run.time.dtype == np.float64


def test_a_member_of_an_ensemble_is_a_single_run(tmp_path):
    parts = written(tmp_path / "runs.h5", runs=4)
    ensemble = load_run(tmp_path / "runs.h5")
    member = replace(ensemble, header=replace(ensemble.header, seed=(3, 1, 4, 1))).member(2)
    assert member.seed == 4 and member.run_count is None
    np.testing.assert_array_equal(
        member.force["wb_flaps"], joined(parts, "force", "wb_flaps", axis=1)[2]
    )
    np.testing.assert_array_equal(member.time, ensemble.time)
    np.testing.assert_array_equal(member.pieces.velocity, ensemble.pieces.velocity[2])
    with pytest.raises(RecordError, match="run 4 is not in this ensemble; it has 0 to 3"):
        ensemble.member(4)
    with pytest.raises(RecordError, match="single run"):
        member.member(0)


def test_saving_and_loading_are_inverse(tmp_path):
    for runs in (None, 2):
        written(tmp_path / f"{runs}.h5", runs)
        run = load_run(tmp_path / f"{runs}.h5")
        run.save(tmp_path / f"{runs}-again.h5")
        again = load_run(tmp_path / f"{runs}-again.h5")
        assert again.header == run.header
        np.testing.assert_array_equal(again.mean_force["wb_walls"], run.mean_force["wb_walls"])
        np.testing.assert_array_equal(again.pieces.orientation, run.pieces.orientation)
        assert {k: v.tolist() for k, v in again.restart.items()} == {
            k: v.tolist() for k, v in run.restart.items()
        }
    bare = Run(header(groups=(), blocks=(), quantities=()), time=np.arange(3.0), series={})
    bare.save(tmp_path / "bare.h5")
    assert load_run(tmp_path / "bare.h5").pieces is None


def test_product_impact_force_is_the_force_along_gravity_over_g():
    force = np.array([(0.0, 0, 0), (3, 4, -9.81), (0, 0, -44.145)])
    run = Run(
        header(),
        np.arange(3.0),
        {"force": {"wb_flaps": force}, "mean_force": {"wb_flaps": force / 2}},
    )
    np.testing.assert_allclose(run.pif_kg("wb_flaps", mean=False), [0, 1, 4.5], rtol=1e-15)
    np.testing.assert_allclose(run.pif_kg("wb_flaps"), [0, 0.5, 2.25], rtol=1e-15)
    ensemble = replace(
        run,
        series={"mean_force": {"wb_flaps": np.stack([force, 2 * force])}},
        header=header(run_count=2),
    )
    np.testing.assert_allclose(ensemble.pif_kg("wb_flaps"), [[0, 1, 4.5], [0, 2, 9]], rtol=1e-15)
    floating = replace(run, header=header(gravity=(0.0, 0.0, 0.0)))
    np.testing.assert_allclose(floating.pif_kg("wb_flaps", mean=False), [0, 1, 4.5], rtol=1e-15)
    with pytest.raises(RecordError, match="group = 'plate' is not in this run; it has: wb_flaps"):
        run.pif_kg("plate")


# --- what survives ---

KILLED = """
import os, signal, sys
sys.path[:0] = [{repository!r}, {tests!r}]
import dem_jax.io.writer as record
from dem_jax.io import atomic_files
from test_record import header, samples, frames

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

writer = record.Writer.create("run.h5", header(), interval={interval})
for i in range(10):
    writer.append(samples(100 * i, 100), frames(i, 1), {{"step": record.np.int64(i)}})
{then}
"""


def run_killed(then, interval=0):
    script = KILLED.format(
        repository=str(REPOSITORY), tests=str(Path(__file__).parent), then=then, interval=interval
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.mark.parametrize(
    "then",
    [
        "die()",
        "writer._interval = 9; writer.append(samples(1000, 5)); die()",  # not flushed yet
        "atomic_files.os.link = die; writer.append(samples(1000, 5))",  # the copy is complete, without a
        # name
        "atomic_files.os.replace = die; writer.append(samples(1000, 5))",  # not yet in place
        "record.replace_restart = die; writer.append(samples(1000, 5), restart={'step': record.np.int64(10)})",
        "atomic_files.os.fdopen = lambda file, _: (os.write(file, b'HDF'), die()); writer.append(samples(1000, 5))",
    ],
)
def test_a_killed_process_leaves_the_file_of_its_last_flush(then):
    run_killed(then)
    run = load_run("run.h5")
    assert len(run.time) == 1000 and run.restart["step"] == 9 and len(run.pieces.time) == 10
    np.testing.assert_array_equal(
        run.force["wb_flaps"][500:600], samples(500, 100)["force"]["wb_flaps"]
    )


def test_a_run_that_was_killed_goes_on_where_its_file_ends():
    run_killed("die()")
    with Writer.resume("run.h5") as writer:
        writer.append(samples(1000, 7), frames(10, 1), {"step": np.int64(10)}, info={"resumed": 1})
    run = load_run("run.h5")
    np.testing.assert_array_equal(
        run.time, np.concatenate([samples(0, 1000)["time"], samples(1000, 7)["time"]])
    )
    np.testing.assert_array_equal(
        run.force["wb_walls"][1000:], samples(1000, 7)["force"]["wb_walls"]
    )
    assert run.restart["step"] == 10 and run.info == {"limited by": "unloading", "resumed": 1}


def test_a_process_killed_at_any_moment_leaves_a_consistent_file():
    """A process that does nothing but flush is killed after odd waits: the restart state belongs to
    the last sample.
    """
    endless = f"""
import sys
sys.path[:0] = [{str(REPOSITORY)!r}, {str(Path(__file__).parent)!r}]
import numpy as np
from dem_jax.io.run_files import Writer
from test_record import header, samples
writer = Writer.create("run.h5", header(), overwrite=True, interval=0)
for i in range(100000):
    writer.append(samples(20 * i, 20), restart={{"last": np.float64(20 * i + 19)}})
    print("written", flush=True)
"""
    for wait in (0.11, 0.173, 0.257, 0.301):
        with subprocess.Popen([sys.executable, "-c", endless], stdout=subprocess.PIPE) as process:
            process.stdout.readline()  # the pipe holds as many lines as are written meanwhile
            time.sleep(wait)
            process.kill()
        run = load_run("run.h5")
        count = len(run.time)
        assert count > 0 and count % 20 == 0 and run.restart["last"] == count - 1
        np.testing.assert_array_equal(run.energy["potential"], -np.arange(count))


def test_the_file_can_be_read_while_it_is_written(tmp_path):
    writer = Writer.create(tmp_path / "run.h5", header(), interval=0)
    writer.append(samples(0, 10))
    with h5py.File(tmp_path / "run.h5") as reader:
        writer.append(samples(10, 10))
        assert reader["time"].shape == (10,)  # its own consistent view
    assert len(load_run(tmp_path / "run.h5").time) == 20


def test_the_first_flush_comes_early_for_those_who_watch(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("dem_jax.io.writer.time.monotonic", lambda: now[0])
    writer = Writer.create(tmp_path / "run.h5", header(), interval=3600)
    for start, later, held in ((0, 0.1, 0), (5, 0.15, 10), (10, 3000.0, 10), (15, 1000.0, 20)):
        now[0] += later
        writer.append(samples(start, 5))
        with h5py.File(tmp_path / "run.h5") as file:
            assert len(file.get("time", ())) == held


def test_flushes_are_spaced_and_the_last_one_comes_with_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr("dem_jax.io.writer.FIRST_FLUSH", 3600)
    with Writer.create(tmp_path / "run.h5", header(), interval=3600) as writer:
        writer.append(samples(0, 10))
        with pytest.raises(
            RecordError, match="holds no samples: its run stopped before the first flush"
        ):
            load_run(tmp_path / "run.h5")
        writer.flush()
        writer.append(samples(10, 5))
        assert len(load_run(tmp_path / "run.h5").time) == 10
    assert len(load_run(tmp_path / "run.h5").time) == 15
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


def test_rewriting_the_restart_state_does_not_grow_the_file(tmp_path):
    with Writer.create(tmp_path / "run.h5", header(), interval=0) as writer:
        writer.append(samples(0, 10))
        writer.write_restart({"state": np.zeros(100000), "old": np.zeros(3)})
        size = (tmp_path / "run.h5").stat().st_size
        for i in range(20):
            writer.write_restart({"state": np.full(100000, float(i)), "old": np.full(3, float(i))})
        assert (tmp_path / "run.h5").stat().st_size == size
        # a capacity grew
        writer.write_restart({"state": np.zeros(200000, np.int32), "new": np.zeros(5)})
    restart = load_run(tmp_path / "run.h5").restart
    assert set(restart) == {"state", "new"} and restart["state"].shape == (200000,)


# --- what is refused ---


def test_nothing_is_overwritten_unasked_and_the_old_file_stays_until_there_is_something_new(
    tmp_path,
):
    path = tmp_path / "run.h5"
    written(path)
    before = path.read_bytes()
    run = load_run(path)
    with pytest.raises(
        RecordError, match=r"run\.h5 exists; allowed: another name, or overwrite=True"
    ):
        run.save(path)
    with pytest.raises(RecordError, match=r"run\.h5 exists"):
        Writer.create(path, header())
    Writer.create(path, header(), overwrite=True)  # and never gets a sample
    assert path.read_bytes() == before
    replace(run, time=run.time + 1).save(path, overwrite=True)
    assert load_run(path).time[0] == run.time[0] + 1


def test_a_write_that_fails_leaves_the_old_file_and_can_be_tried_again(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    writer = Writer.create(path, header(), interval=0)
    writer.append(samples(0, 10))
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("dem_jax.io.writer.extend_dataset", full)
        with pytest.raises(
            RecordError, match=r"run\.h5 cannot be written: No space left on device"
        ):
            writer.append(samples(10, 10))
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["run.h5"]
    writer.close()
    np.testing.assert_array_equal(load_run(path).time, samples(0, 20)["time"])


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(
        RecordError, match=r"run\.h5 cannot be written: there is no folder '.*nowhere'"
    ):
        Writer.create(tmp_path / "nowhere" / "run.h5", header())


@pytest.mark.parametrize("kept", [0, 4, 100, 0.2, 0.5, 0.9, -1])
def test_a_file_cut_short_is_one_clear_line(tmp_path, kept):
    path = tmp_path / "run.h5"
    written(path)
    content = path.read_bytes()
    length = int(kept * len(content)) if 0 < kept < 1 else kept
    path.write_bytes(content[:length])
    with pytest.raises(
        RecordError, match=r"run\.h5 is (not an HDF5 file|damaged or cut short)"
    ) as caught:
        load_run(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(RecordError):
        Writer.resume(path)


def test_other_files_are_refused_by_what_they_lack(tmp_path):
    with pytest.raises(RecordError, match=r"no\.h5: there is no such file"):
        load_run(tmp_path / "no.h5")
    (tmp_path / "text.h5").write_text("time force\n0 1\n")
    with pytest.raises(RecordError, match=r"text\.h5 is not an HDF5 file"):
        load_run(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["time"] = np.arange(3.0)
    with pytest.raises(
        RecordError, match=r"other\.h5 is no run of dem_jax: it lacks the attribute 'scene'"
    ):
        load_run(tmp_path / "other.h5")
    for lost in ("mean_force/wb_flaps", "settled_mass/wb", "pieces/velocity", "force"):
        written(tmp_path / "run.h5")
        with h5py.File(tmp_path / "run.h5", "r+") as file:
            del file[lost]
        with pytest.raises(RecordError, match=f"run.h5 lacks the dataset '{lost}"):
            load_run(tmp_path / "run.h5")
        (tmp_path / "run.h5").unlink()
    written(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        file["energy/kinetic"].resize(7, axis=0)
    with pytest.raises(
        RecordError, match=r"damaged: 'energy/kinetic' of form \(7,\) does not fit 1551, of times"
    ):
        load_run(tmp_path / "run.h5")


def link_to(file, name, other):
    file[name] = h5py.ExternalLink(other, "secret")


def share_values(file, name, other):
    layout = h5py.VirtualLayout(shape=(3,), dtype=float)
    layout[:] = h5py.VirtualSource(other, "secret", shape=(3,))
    file.create_virtual_dataset(name, layout)


def keep_values(file, name, other):
    file.create_dataset(name, (3,), float, external=[(other, 0, 24)])


@pytest.mark.parametrize("place", [link_to, share_values, keep_values])
@pytest.mark.parametrize("name", ["force", "pieces/colour", "new/group/values"])
def test_a_file_whose_values_lie_in_another_one_is_refused(tmp_path, place, name):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["secret"] = np.arange(3.0)
    written(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        if name in file:
            del file[name]
        place(file, name, str(tmp_path / "other.h5"))
    words = f"run.h5: {name} lies in another file; allowed: a file that contains all of its values"
    for read in (load_run, load_restart):
        with pytest.raises(RecordError, match=words):
            read(tmp_path / "run.h5")


def test_samples_that_do_not_fit_are_refused_before_anything_is_written(tmp_path):
    writer = Writer.create(tmp_path / "run.h5", header(run_count=2), interval=0)
    writer.append(samples(0, 10, 2))
    fewer = samples(10, 10, 2)
    del fewer["max_relative_overlap"]
    for wrong, message in (
        (fewer, r"series \['max_relative_overlap'\] must be in every append"),
        (
            {**samples(10, 10, 2), "max_relative_overlap": np.zeros((2, 9))},
            r"max_relative_overlap of form \(2, 9\) does not fit 10 times",
        ),
        (
            {**samples(10, 10, 2), "max_relative_overlap": np.zeros((3, 10))},
            r"max_relative_overlap of form \(3, 10\) does not fit",
        ),
        (
            {**samples(10, 10, 2), "max_relative_overlap": np.zeros(10)},
            r"max_relative_overlap of form \(10,\) does not fit",
        ),
        (
            {**samples(10, 10, 2), "heat": np.zeros((2, 10))},
            r"series 'heat' is unknown; allowed: time, force",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            writer.append(wrong)
    writer.append(samples(10, 10, 2))
    np.testing.assert_array_equal(load_run(tmp_path / "run.h5").time, samples(0, 20)["time"])


# --- files of format 1: former names of datasets ---

FLOW = {"inside": np.arange(3.0), "inserted": np.ones(3), "removed": np.zeros(3)}


@pytest.fixture
def flow_file(tmp_path):
    """A file of now with quantities that had other names."""
    stored = (
        *(q for q in header().stored_quantities if q.name in ("time", "max_relative_overlap")),
        StoredQuantity("contact_count", "1", ("partner",), "contacts", ("plate",)),
        StoredQuantity("piece_count", "1", ("place",), "pieces", tuple(FLOW)),
    )
    path = tmp_path / "flow.h5"
    with Writer.create(path, replace(header(), quantities=stored)) as writer:
        rows = {"time": np.arange(3.0), "max_relative_overlap": np.full(3, 1e-3)}
        rows |= {"contact_count": {"plate": np.array([0, 1, 2])}, "piece_count": FLOW}
        writer.append(rows, restart={"step": np.int64(1)})
    return path


def make_former(path):
    """Rewrite a file as the release before wrote it."""
    with h5py.File(path, "r+") as file:
        del file.attrs["format_version"]
        stored = json.loads(file.attrs["quantities"])
        for former, name in FORMER_QUANTITIES.items():
            if name in file:
                del file[former]
                file.move(name, former)
                next(q for q in stored if q["name"] == name)["name"] = former
        for former, label in FORMER_LABELS.items():
            del file[f"piece_count/{former}"]
            file.move(f"piece_count/{label}", f"piece_count/{former}")
        stored[-1]["labels"] = ["inside", *FORMER_LABELS]
        file.attrs["quantities"] = json.dumps(stored)


def test_a_file_of_the_release_before_is_read_under_the_names_of_now(flow_file):
    now = load_run(flow_file)
    make_former(flow_file)
    read = load_run(flow_file)
    assert collect_series(read).keys() == collect_series(now).keys()
    for name, array in collect_series(now).items():
        np.testing.assert_array_equal(collect_series(read)[name], array)
    with pytest.raises(RecordError, match="flow.h5 was begun by an earlier version"):
        load_restart(flow_file)


def test_former_names_of_datasets_lead_to_those_of_now(flow_file):
    run = load_run(flow_file)
    with pytest.warns(FormerNameWarning, match="Run.contacts is now contact_count"):
        assert run.contacts is run.contact_count
    with h5py.File(flow_file) as file:
        assert file["overlap"] == file["max_relative_overlap"]
        assert file["contacts/plate"][-1] == 2 and file["piece_count/taken_out"][-1] == 0


def test_a_file_of_a_later_format_is_refused(flow_file):
    with h5py.File(flow_file, "r+") as file:
        file.attrs["format_version"] = 3
    with pytest.raises(RecordError, match=r"format_version = 3; allowed: 1 to 2, others need"):
        load_run(flow_file)
