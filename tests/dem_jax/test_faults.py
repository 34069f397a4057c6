"""What goes wrong with files: a full disk, no permission, a file that is deleted, one that has but
a beginning, one that lies.
"""

import os
import resource
import subprocess
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py
import numpy as np
import pytest

import dem_jax
from benchmarks.faults import mutated
from dem_jax.__main__ import main
from dem_jax.errors import RecordError, SceneError
from dem_jax.io import atomic_files, writer
from dem_jax.io.run_files import load_run
from dem_jax.runner import interface

SCENE = [
    "plate-drop",
    "--set",
    'piece=[{shape="sphere", radius=0.01, position=[0, 0, 0.0105]}]',
    "--set",
    "run.frame_interval=0",
]
SHORT = [*SCENE, "--set", "run.duration=0.03", "--quiet", "--no-plot"]
REPOSITORY = Path(__file__).resolve().parents[2]


@contextmanager
def room_for(size):
    """No file may grow beyond so many bytes: what writing a larger one raises is what a full disk
    does.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The file of a run that nothing went wrong with."""
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    assert main(["run", *SHORT, "--out", str(path)]) == 0
    return path


@pytest.fixture
def copy(whole, tmp_path):
    """A copy of it."""
    (tmp_path / "run.h5").write_bytes(whole.read_bytes())
    return tmp_path / "run.h5"


def assert_same(one, other):
    for name in ("time", "momentum", "max_relative_overlap"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def refused(argv, capsys):
    """The one line on stderr of a command that ends with 2."""
    capsys.readouterr()
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1, err
    return err


# --- a disk that is full, a folder that cannot be written, a file that is gone ---

FULL = f"""
import resource, sys
sys.path[:0] = [{str(REPOSITORY)!r}, {str(Path(__file__).parent)!r}]
from dem_jax.errors import RecordError, SceneError
from dem_jax.io.run_files import Writer
from test_record import header, samples
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
writer = Writer.create("run.h5", header(), interval=0)
try:
    for i in range(1000):
        writer.append(samples(100 * i, 100), restart={{"step": i}})
except RecordError as error:
    print(error)
"""


def test_a_full_disk_is_one_line_and_leaves_what_was_written():
    done = subprocess.run([sys.executable, "-c", FULL], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stderr == "", (
        "and HDF5 does not fall over it at the end either"
    )
    expected = "run.h5 cannot be written: File too large; it is as of the flush before, from which its run can go on (--resume)"
    assert done.stdout == expected + "\n"
    run = load_run("run.h5")
    assert (
        len(run.time) > 500
        and len(run.time) % 100 == 0
        and run.restart["step"] == len(run.time) // 100 - 1
    )
    assert [path.name for path in Path().iterdir()] == ["run.h5"]


def test_a_run_goes_on_from_a_full_disk(whole, capsys):
    with room_for(90_000):  # its beginning, not its samples
        assert "run.h5 cannot be written: File too large" in refused(
            ["run", *SHORT, "--out", "run.h5"], capsys
        )
    assert [path.name for path in Path().iterdir()] == ["run.h5"]
    assert main(["run", "--resume", "run.h5", "--quiet", "--no-plot"]) == 0
    assert_same(load_run("run.h5"), load_run(whole))


@pytest.fixture
def computing_nothing(monkeypatch):
    """Fails if anything is computed."""
    monkeypatch.setattr(interface.loop, "run_loop", lambda *_: pytest.fail("it began to compute"))


@pytest.mark.usefixtures("computing_nothing")
def test_what_cannot_be_written_is_found_before_computing(copy, capsys, monkeypatch):
    long = f"{'x' * 253}.h5"
    beside = f"{'x' * 252}.h5"  # whose figure's name is too long
    Path("loop.h5").symlink_to("loop.h5")
    reasons = {
        long: "File name too long",
        "/proc/run.h5": "No such file",
        "loop.h5": "Too many levels of symbolic links",
    }
    for out, reason in reasons.items():
        for command in ("run", "ensemble"):
            line = refused([command, *SHORT, "--out", out], capsys)
            assert f"{out} cannot be written: {reason}" in line
    assert ".png cannot be written: File name too long" in refused(
        ["run", *SHORT[:-1], "--out", beside], capsys
    )
    goes_on = ["run", "--resume", str(copy), "--duration", "0.04", "--quiet"]
    with room_for(1000):
        assert "cannot be written: File too large" in refused(
            ["run", *SHORT, "--out", "new.h5"], capsys
        )
        assert "cannot be written: File too large" in refused(goes_on, capsys)
    monkeypatch.setattr(atomic_files.os, "access", lambda *_: False)  # as root, who may run the
    # tests, all can be written
    assert "run.h5 cannot be written: Permission denied" in refused(goes_on, capsys)
    assert "run.h5 cannot be written: Permission denied" in refused(
        ["run", *SHORT, "--out", str(copy), "--overwrite"], capsys
    )
    assert sorted(path.name for path in Path().iterdir()) == ["loop.h5", "run.h5"]


def test_a_run_goes_on_without_a_reader_of_its_bar(whole, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    pipe = open(write, "w", buffering=1)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", pipe)
        assert main(["run", *SHORT[:-2], "--no-plot", "--out", "run.h5"]) == 0
    with suppress(BrokenPipeError):
        pipe.close()
    assert_same(load_run("run.h5"), load_run(whole))


def test_a_summary_is_printed_although_the_figure_cannot_be_written(capsys, monkeypatch):
    def full(*_):
        raise RecordError("run.png cannot be written: No space left on device")

    monkeypatch.setattr("dem_jax.visualization.run_figure.plot_run", full)
    assert main(["run", *SHORT[:-1], "--out", "run.h5"]) == 2
    out, err = capsys.readouterr()
    assert "wrote run.h5\n" in out
    assert err.endswith(
        "No space left on device; the run is whole: python -m dem_jax plot run.h5 draws it\n"
    )


def test_an_output_that_is_full_is_one_line(capsys, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["scenes", "plate-drop"]) == 2
    monkeypatch.undo()
    assert capsys.readouterr().err == "dem_jax: output: No space left on device\n"


def test_a_file_that_is_deleted_meanwhile_is_missed_at_once(whole):
    made = writer.Writer.create("run.h5", load_run(whole).header)
    Path("run.h5").unlink()
    with pytest.raises(RecordError, match=r"run\.h5 was deleted or moved while its run went on"):
        made.write_restart({"step": 1})
    assert not list(Path().iterdir())


# --- a file that has but a beginning ---


def beginning_of(path):
    """Make a file as it is before its first flush."""
    with h5py.File(path, "r+") as file:
        for name in list(file):
            del file[name]


def test_a_run_killed_before_its_first_flush_begins_anew(whole, copy):
    beginning_of(copy)
    with pytest.raises(RecordError, match="holds no samples"):
        load_run(copy)
    assert main(["run", "--resume", str(copy), "--quiet", "--no-plot"]) == 0
    assert_same(load_run(copy), load_run(whole))
    assert dem_jax.load_run(copy).header.seed == dem_jax.load_run(whole).header.seed


def test_a_file_with_but_a_beginning_is_overwritten_if_asked(copy, capsys):
    beginning_of(copy)
    assert "run.h5 exists; allowed: another name by --out, or --overwrite" in refused(
        ["run", *SHORT, "--out", str(copy)], capsys
    )
    assert main(["run", *SHORT, "--out", str(copy), "--overwrite"]) == 0


# --- files that lie ---


def put(path, value, dtype=None, shape=None, **how):
    """A change of a file: a dataset anew."""

    def change(file):
        old = file[path] if path in file else None
        units = None if old is None else dict(old.attrs)
        if old is not None:
            del file[path]
        made = file.create_dataset(path, data=value, dtype=dtype, shape=shape, **how)
        made.attrs.update(units or {})

    return change


def said(name, value):
    """A change of a file: an attribute."""
    return lambda file: file.attrs.__setitem__(name, value)


def within_itself(file):
    file["restart/again"] = file["restart"]


LIES = [  # a change -> what the line must hold, on being read if it says so
    ("read", put("time", None, "f8", (2**40,), chunks=(1024,)), r"'force/plate' of form .* does not fit 1099511627776"),
    ("read", put("max_relative_overlap", None, "f8", (2**40,)), r"'max_relative_overlap' of form \(1099511627776,\) does not fit 1000"),
    ("read", put("max_relative_overlap", None, "f4", (1000,)), r"'max_relative_overlap' of form \(1000,\) claims more than the file holds"),
    ("read", put("max_relative_overlap", b"deep" * 10), r"'max_relative_overlap' of form \(\) does not fit"),
    ("read", put("max_relative_overlap", np.array([b"deep"] * 1000)), r"'max_relative_overlap' holds no numbers"),
    ("read", put("momentum", np.zeros((1000, 4))), r"'momentum' of form \(1000, 4\) does not fit 1000 x 3"),
    ("read", within_itself, r"its group 'again' is within itself|group 'restart/again' is within itself"),
    ("read", said("dt", -1e-6), r"its attribute dt = -1e-06; allowed: a number > 0"),
    ("read", said("dt", "soon"), r"its attribute dt = 'soon'; allowed: a number > 0"),
    ("read", said("precision", "f16"), r"its attribute precision = 'f16'; allowed: \"f32\" or \"f64\""),
    ("read", said("gravity", [0.0, np.nan, 0.0]), r"its attribute gravity = .* allowed: three finite numbers"),
    ("read", said("groups", [1, 2]), r"its attribute groups = \[1, 2\]; allowed: names"),
    ("read", said("piece_count", -3), r"its attribute piece_count = -3; allowed: a whole number of at least 1"),
    ("read", said("seed", [1, 2]), r"it has 2 seeds for a single run"),
    ("read", said("seed", h5py.Empty("f8")), r"its attribute seed"),
    ("read", said("run_count", 7), r"does not fit"),
    ("read", said("info", "[" * 5000), r"its attribute info is not JSON"),
    ("read", said("info", '{"elapsed": "long"}'), r"its attribute info\.elapsed = 'long'; allowed: a number"),
    ("read", said("quantities", "[3]"), r"its attribute quantities; allowed: name, unit"),
    ("resume", said("scene", "x" * 100), r"its scene, its seed or the state|not valid TOML"),
    ("resume", said("seed", 3), r"its scene, its seed or the state to go on from is not what was written"),
    ("resume", put("restart/skin", np.float32(2**31)), r"restart/skin = \[2147483648\.0\] \(float32\): allowed: .* <= "),
    ("resume", put("restart/skin", np.float32(np.nan)), r"restart/skin = \[nan\] \(float32\): allowed"),
    ("resume", put("restart/skin", np.zeros(3)), r"restart/skin = \[0\.0\] \(float64\): allowed"),
    ("resume", put("restart/step", np.int32(-(2**31))), r"restart/step = -2147483648: allowed: a multiple of"),
    ("resume", put("restart/step", np.int32(2**30)), r"restart/step = 1073741824: allowed: a multiple of"),
    ("resume", put("restart/touching", np.int32(2**31 - 1)), r"restart/touching = 2147483647: allowed: a whole numbers? from 0"),
    ("resume", put("restart/capacity/plates", np.array([2**31 - 1] * 2)), r"restart/capacity/plates = .*: allowed"),
    ("resume", put("restart/motion/position", np.zeros((3, 10**6), "f4")), r"restart/motion/position is float32\[3, 1000000\]"),
    ("resume", put("restart/motion/position", None, "f4", (3, 2**40)), r"'restart/motion/position' of form .* claims more"),
]  # fmt: skip


@pytest.mark.parametrize(("way", "change", "expected"), LIES)
def test_a_file_that_lies_is_one_clear_line(way, change, expected, copy):
    with h5py.File(copy, "r+") as file:
        change(file)
        if "restart/" in expected:  # as of a file from before there were checksums
            file["restart"].attrs.pop("checksum", None)
    with pytest.raises((RecordError, dem_jax.SceneError), match=expected) as caught:
        load_run(copy) if way == "read" else dem_jax.resume(copy, duration=0.04)
    assert "\n" not in str(caught.value)


def test_a_file_of_before_is_read_and_gone_on_with(whole, copy):
    """Files had no checksums, neither of their data nor of the state to go on from."""
    with h5py.File(whole) as file, h5py.File(copy, "w") as old:
        old.attrs.update(file.attrs)
        file.visititems(
            lambda name, item: (
                old.__setitem__(name, item[()]) if isinstance(item, h5py.Dataset) else None
            )
        )
        count = len(file["time"])
        for name in (
            name
            for name in file
            if isinstance(file[name], h5py.Dataset)
            and name in ("time", "max_relative_overlap", "momentum")
        ):
            del old[name]
            old.create_dataset(
                name, data=file[name][()], maxshape=(None, *file[name].shape[1:]), chunks=True
            )
    assert_same(load_run(copy), load_run(whole))
    assert dem_jax.resume(copy).time.shape == (count,)


def test_a_bit_that_flips_is_found(whole, copy):
    with h5py.File(whole) as file:
        offsets = [
            file[name].id.get_chunk_info(0).byte_offset
            for name in ("force/plate", "restart/motion/position")
        ]
        assert file["restart/motion/position"].fletcher32 and file["force/plate"].fletcher32
    content = bytearray(whole.read_bytes())
    for offset, read in zip(offsets, (load_run, dem_jax.resume), strict=True):
        flipped = content.copy()
        flipped[offset + 5] ^= 16
        copy.write_bytes(flipped)
        with pytest.raises(RecordError, match=r"run\.h5 is damaged or cut short"):
            read(copy)


# --- files that something has changed: a share of benchmarks.faults ---


@pytest.mark.parametrize("kind", [kind for kind in mutated.KINDS if not kind.startswith("hdf5")])
def test_mutated_files_are_read_or_refused_in_one_line(kind, tmp_path):
    seen = {seed: mutated.outcome(mutated.Case(kind, seed, str(tmp_path))) for seed in range(60)}
    assert not {seed: what for seed, what in seen.items() if what[0] not in mutated.GOOD}


def test_mutated_results_are_what_was_saved_or_one_line(whole, tmp_path):
    (tmp_path / "run.h5").write_bytes(whole.read_bytes())
    seen = {seed: mutated.outcome(mutated.Case("hdf5", seed, str(tmp_path))) for seed in range(60)}
    assert not {seed: what for seed, what in seen.items() if what[0] not in mutated.GOOD}
    assert "one line" in {what for what, _ in seen.values()}


def test_what_silently_is_nonsense_is_seen(monkeypatch, tmp_path):
    """Of a table whose times do not rise, of a reader that trips, and of numbers that nobody saved."""
    case = mutated.Case("csv of a motion", 3, str(tmp_path))
    many = SceneError("a\nb")
    for wrong, expected in (
        ("times that do not rise", "nonsense"),
        (KeyError("x"), "traceback"),
        (many, "many lines"),
    ):

        def read(*_, wrong=wrong):
            if isinstance(wrong, Exception):
                raise wrong
            return wrong

        monkeypatch.setitem(mutated.READERS, "csv of a motion", read)
        assert mutated.outcome(case)[0] == expected
    one = {"force": np.zeros(3)}
    assert (
        mutated._unlike({"force": np.array([0.0, 0.0, 1e-9])}, one) == "force is not what was saved"
    )
    assert mutated._unlike(one, one) is None
