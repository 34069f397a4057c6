"""How a process ends: by signals, without readers, with others at its files; and files that it must
not touch.
"""

import fcntl
import gc
import io
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dem_jax import process, xla_flags
from dem_jax.__main__ import main
from dem_jax.cli import simulation_options
from dem_jax.cluster import compile_cache
from dem_jax.errors import PlatformError, RecordError, SimulationError
from dem_jax.io import atomic_files
from dem_jax.io.run_files import Writer, load_run
from dem_jax.runner import loop, programs, sinks
from dem_jax.runner.chunk_result import ChunkResult
from dem_jax.runner.job_setup import prepare_job
from dem_jax.runner.progress import Progress
from dem_jax.study import results_file as study_file
from dem_jax.visualization.run_figure import save_figure
from tests.dem_jax.test_record import header, samples

# --- signals: of a command that computes, in Python or, as XLA does while it compiles, outside of
# it ---

COMMAND = """
import hashlib, signal, sys, time
signal.signal(signal.SIGINT, signal.{handler})  # whatever it was where the tests were started
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the tests run under nohup
from pathlib import Path
from dem_jax import process
from dem_jax.cli import main, scenes

def in_python():
    try:
        time.sleep(60)
    finally:
        Path("unwound").touch()

def outside():  # holds the main thread for a minute, without Python's lock and without looking at signals
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**8)

def while_writing():
    with process.defer_signals():
        time.sleep(0.2)
        Path("whole").touch()
    outside()

def save():
    Path("saved").touch()
    return "what was computed before is in drop.h5"

def scenes_command(_):
    with process.save_on_interrupt(save):
        print("ready", flush=True)
        globals()[sys.argv.pop()]()

scenes.show_scenes = scenes_command
sys.exit(main.main())
"""


def begun(where, handler="default_int_handler"):
    """The command as a process; handler: of SIGINT, that it is started with."""
    command = [sys.executable, "-c", COMMAND.replace("{handler}", handler), "scenes", where]
    search = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        command, env=search, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def interrupted(where, number):
    """Exit code, stderr and how long it took (s) after a signal to a command."""
    with begun(where) as started:
        assert started.stdout.readline() == "ready\n"
        time.sleep(0.1)
        begin = time.monotonic()
        started.send_signal(number)
        _, err = started.communicate(timeout=30)
    return started.returncode, err, time.monotonic() - begin


@pytest.mark.parametrize(
    ("where", "number", "code", "word", "leaves"),
    [
        ("in_python", signal.SIGINT, 130, "interrupted", {"saved", "unwound"}),
        ("outside", signal.SIGINT, 130, "interrupted", {"saved"}),
        ("outside", signal.SIGTERM, 143, "terminated", {"saved"}),
        ("while_writing", signal.SIGHUP, 129, "hung up", {"saved", "whole"}),
    ],
)
def test_a_signal_ends_a_command_within_a_second_and_saves_what_was_computed(
    where, number, code, word, leaves
):
    ended, err, took = interrupted(where, number)
    assert (ended, err) == (code, f"dem_jax: {word}; what was computed before is in drop.h5\n")
    assert {path.name for path in Path().iterdir()} == leaves
    assert took < 5.0  # process.GRACE is 0.25 s; the rest is for a machine that is loaded.
    # Uninterrupted it takes a minute


def test_a_signal_that_was_ignored_from_the_start_stays_so():
    """As ``nohup`` and background jobs of a script have it."""
    with begun("in_python", "SIG_IGN") as started:
        assert started.stdout.readline() == "ready\n"
        started.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            started.wait(0.7)  # s, longer than process.GRACE
        started.kill()


def test_ctrl_c_while_xla_compiles_ends_the_command():
    settings = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_ENABLE_COMPILATION_CACHE": "0",
    }
    command = [sys.executable, "-c", TOLD, "run", "plate-drop", "--out", "drop.h5"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=settings, **pipes) as started:
        assert started.stdout.readline() == "compiling\n"
        started.send_signal(signal.SIGINT)
        _, err = started.communicate(timeout=60)
    assert started.returncode == 130
    assert err.splitlines()[-1] == "dem_jax: interrupted; no file of results was written"
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("before", "written"),
    [
        ("compiling: 0%", "compiling: 0%\nended\n"),  # a bar that stands, closed meanwhile or not
        ("a note\n", "a note\nended\n"),
        ("\rbar\r   \r", "\rbar\r   \rended\n"),  # a bar that was wiped away
        ("", "ended\n"),
    ],
)
def test_the_last_line_is_a_line_of_its_own(before, written):
    under = io.StringIO()
    stream = process.SilentStream(under)
    stream.write(before)
    stream.write_last("ended\n")
    stream.write("late\n")
    assert under.getvalue() == written


TOLD = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import jax.stages
compile = jax.stages.Lowered.compile
def told(self, *more):
    if "chunk" in self.as_text()[:500]:
        print("compiling", flush=True)
    return compile(self, *more)
jax.stages.Lowered.compile = told
from dem_jax.cli.main import main
sys.exit(main())
"""


def test_what_is_pending_is_saved_once_when_a_run_is_interrupted(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    monkeypatch.setattr(process._STATE, "said", [])
    with pytest.raises(KeyboardInterrupt):
        with sinks.FileSink(path, lambda: Writer.create(path, header(), interval=3600)) as file:
            file.append(samples(0, 10), restart={"step": np.int64(1)})
            raise KeyboardInterrupt
    np.testing.assert_array_equal(load_run(path).time, samples(0, 10)["time"])
    assert f"is in {path}; python -m dem_jax run --resume {path}" in process.describe_interrupt()
    with atomic_files.lock_file(path):  # and it can be gone on with
        pass


def test_what_is_appended_while_another_thread_flushes_is_in_the_next_flush_as_a_whole(
    run_file, monkeypatch
):
    """An interrupt flushes in a thread of its own: a restart state must not be ahead of the
    samples.
    """
    from dem_jax.io import writer as module

    writer = Writer.resume(run_file, interval=3600)
    writer.append(samples(10, 5), restart={"step": np.int64(15)})
    extend, late = (
        module.extend_dataset,
        [lambda: writer.append(samples(15, 5), restart={"step": np.int64(20)})],
    )

    def extended(*given):
        while late:
            late.pop()()
        extend(*given)

    monkeypatch.setattr(module, "extend_dataset", extended)
    writer.flush()
    run = load_run(run_file)
    assert (len(run.time), run.restart["step"]) == (15, 15)
    writer.close()
    run = load_run(run_file)
    assert (len(run.time), run.restart["step"]) == (20, 20)


# --- the progress bar, and streams that are closed ---


class Bare(SimpleNamespace):
    """Which can be referred to weakly."""


def bare_job():
    return Bare(
        sample_index=lambda state: 0, state=None, samples=10, clock=SimpleNamespace(compile=0.0),
        scene=SimpleNamespace(run=SimpleNamespace(sample_interval=1e-3)), steps_per_sample=1, runs=None,
    )  # fmt: skip


def test_the_thread_of_the_bar_has_nothing_of_the_run_and_ends_with_it(capsys):
    before, job = set(threading.enumerate()), bare_job()
    gone = weakref.ref(job)
    with Progress(job, True) as shown:
        (clock,) = [
            thread
            for thread in threading.enumerate()
            if thread not in before and thread.name.startswith("Thread")
        ]
        shown._job = None
        del job
        gc.collect()
        assert gone() is None and clock.is_alive()
    assert not clock.is_alive()
    assert "running" in capsys.readouterr().err


def done_chunk(first, count, settled=False):
    """What a progress bar asks of a chunk."""
    return ChunkResult(first, count, *[None] * 5, (), None, settled=settled)


class Broken:
    """A stream whose reader is gone."""

    def write(self, _):
        raise BrokenPipeError(32, "Broken pipe")

    flush = isatty = lambda self: self.write("")


def test_a_bar_whose_reader_is_gone_falls_silent(monkeypatch):
    stream = Broken()
    stream.isatty = lambda: False
    monkeypatch.setattr(sys, "stderr", stream)
    with Progress(bare_job(), True) as shown:
        shown.show_compiling()
        shown.show_note("a note")
        shown.show_chunk(done_chunk(0, 10))
        assert shown._bar.n == 10


def test_a_function_is_told_of_progress_instead_of_a_bar(capsys):
    told = []
    with Progress(bare_job(), lambda phase, share: told.append((phase, share))) as shown:
        shown.show_compiling()
        shown.show_chunk(done_chunk(0, 4))
        # at rest: what is left need not be computed
        shown.show_chunk(done_chunk(4, 1, settled=True))
    assert told == [("compiling", 0.0), ("running", 0.4), ("running", 1.0)]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_closed_streams_are_as_dev_null(closed):
    search = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = f'exec "{sys.executable}" -m dem_jax scenes {closed}'
    done = subprocess.run(command, shell=True, env=search, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    assert bool(done.stdout) is (closed == "2>&-")


@pytest.mark.parametrize("error", [RuntimeError("Unable to initialize backend"), AssertionError()])
def test_a_platform_that_jax_does_not_have_is_one_line(error, monkeypatch, capsys):
    def without(*_):
        raise error

    monkeypatch.setattr(jax, "devices", without)
    with pytest.raises(
        PlatformError, match="^JAX_PLATFORMS = .*: JAX finds no such device; allowed: cpu"
    ):
        prepare_job("plate-drop", (0,), None)
    monkeypatch.setattr("dem_jax.cli.scenes.show_scenes", without)  # as of a command that does not
    # ask first
    assert main(["scenes"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


# --- files that are not this process's alone ---


@pytest.fixture
def run_file(tmp_path):
    path = tmp_path / "run.h5"
    with Writer.create(path, header()) as writer:
        writer.append(samples(0, 10), restart={"step": np.int64(1)})
    return path


def test_of_two_processes_that_go_on_with_a_file_one_stops(run_file):
    one, other = (Writer.resume(run_file, interval=0) for _ in range(2))
    one.append(samples(10, 5))
    with pytest.raises(
        RecordError, match=r"run\.h5 was written by another process meanwhile; this one stops"
    ):
        other.append(samples(10, 5))
    one.append(samples(15, 5))
    np.testing.assert_array_equal(load_run(run_file).time, samples(0, 20)["time"])


def test_a_thread_that_saves_at_an_interrupt_is_not_taken_for_another_process(
    run_file, monkeypatch
):
    replaced = threading.Event()

    def replace_slowly(path, content):
        known = atomic_files.replace_file(path, content)
        replaced.set()
        time.sleep(0.2)  # the writer does not know yet that the new file is its own
        return known

    writer = Writer.resume(run_file, interval=60)
    writer.append(samples(10, 5))
    monkeypatch.setattr("dem_jax.io.writer.replace_file", replace_slowly)
    saving = threading.Thread(target=writer.flush)
    saving.start()
    assert replaced.wait(10)
    writer.append(samples(15, 5))  # by the main thread, which goes on meanwhile
    saving.join()
    writer.flush()
    np.testing.assert_array_equal(load_run(run_file).time, samples(0, 20)["time"])


def test_of_two_processes_that_begin_a_file_one_stops(tmp_path):
    path = tmp_path / "run.h5"
    Writer.create(path, header())
    one, other = (Writer.create(path, header(), overwrite=True, interval=0) for _ in range(2))
    one.append(samples(0, 5))
    with pytest.raises(RecordError, match="written by another process"):
        other.append(samples(0, 7))
    assert len(load_run(path).time) == 5


def test_a_file_is_written_by_one_process_at_a_time(run_file, monkeypatch, capsys):
    Path("link.h5").symlink_to(run_file)
    monkeypatch.chdir(run_file.parent)
    before = run_file.read_bytes()
    with atomic_files.lock_file("run.h5"):
        for name in (run_file, "../" + run_file.parent.name + "/run.h5", "link.h5"):
            with (
                pytest.raises(RecordError, match="cannot be written: another process writes it"),
                atomic_files.lock_file(name),
            ):
                pass
        monkeypatch.setattr(
            "dem_jax.runner.loop.run_loop", lambda *_: pytest.fail("it began to compute")
        )
        assert (
            main(["run", "plate-drop", "--out", "run.h5", "--overwrite", "--quiet", "--no-plot"])
            == 2
        )
        assert capsys.readouterr().err.count("another process writes it") == 1
        with atomic_files.lock_file("other.h5"):  # is another file
            pass
    with atomic_files.lock_file("run.h5"):
        pass
    assert run_file.read_bytes() == before


@pytest.mark.parametrize("unnamed", [True, False])
def test_nobody_elses_file_is_touched_on_the_way(run_file, unnamed, monkeypatch):
    """Whether or not the file system has files without a name."""
    if not unnamed:
        monkeypatch.delattr(os, "O_TMPFILE", raising=False)
    mine, pipe = Path("run.h5.part"), Path(".run.h5.part")
    mine.write_text("mine")
    os.mkfifo(pipe)
    run_file.chmod(0o640)
    with Writer.resume(run_file, interval=0) as writer:
        writer.append(samples(10, 5))
    assert mine.read_text() == "mine" and pipe.is_fifo()
    assert run_file.stat().st_mode & 0o777 == 0o640
    assert sorted(path.name for path in Path().iterdir()) == [
        ".run.h5.part",
        "run.h5",
        "run.h5.part",
    ]


def test_what_is_no_file_is_not_replaced(run_file, capsys):
    os.mkfifo("pipe.csv")
    assert main(["export", str(run_file), "--out", "pipe.csv"]) == 2
    assert "pipe.csv cannot be written: it is not a regular file" in capsys.readouterr().err
    assert Path("pipe.csv").is_fifo()


def test_a_link_is_followed(run_file):
    content = run_file.read_bytes()
    Path("there").mkdir()
    Path("link.h5").symlink_to("there/new.h5")  # which is not there yet
    atomic_files.write_atomically("link.h5", content)
    assert Path("link.h5").is_symlink() and Path("there/new.h5").read_bytes() == content
    load_run("link.h5").save("link.h5", overwrite=True)
    assert Path("link.h5").is_symlink() and len(load_run("there/new.h5").time) == 10


def test_a_writer_writes_where_it_began(run_file, monkeypatch):
    writer = Writer.resume("run.h5")
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    writer.append(samples(10, 5))
    writer.close()
    assert len(load_run(run_file).time) == 15 and not list(Path().iterdir())


def test_a_file_that_is_open_in_another_program_is_told_from_a_damaged_one(run_file, capsys):
    with open(run_file, "rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)  # as HDF5 does for who writes
        for read in (load_run, study_file.load_results):
            with pytest.raises(
                RecordError, match=r"run\.h5 cannot be read: it is open in another program"
            ):
                read(run_file)
        for argv in (
            ["plot", "run.h5"],
            ["run", "--resume", "run.h5"],
            ["run", "plate-drop", "--out", "run.h5", "--overwrite"],
        ):
            assert main(argv) == 2
            out, err = capsys.readouterr()
            assert "it is open in another program" in err and len(err.splitlines()) == 1
        fcntl.flock(other, fcntl.LOCK_SH)  # as for who reads
        assert len(load_run(run_file).time) == 10


# --- other outputs ---


def test_a_figure_that_cannot_be_finished_leaves_the_one_before(monkeypatch):
    from matplotlib.figure import Figure

    save_figure(Figure(), Path("figure.png"))
    before = Path("figure.png").read_bytes()
    assert before.startswith(b"\x89PNG")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic_files.os, "replace", full)
    with pytest.raises(
        RecordError, match=r"figure\.png cannot be written: No space left on device"
    ):
        save_figure(Figure(figsize=(1, 1)), Path("figure.png"))
    assert Path("figure.png").read_bytes() == before and len(list(Path().iterdir())) == 1


@pytest.mark.parametrize(
    "command", ["export", "plot", "report", "gltf", "render", "collisions", "weigh"]
)
def test_the_file_that_is_read_is_not_written_over(run_file, command, capsys):
    ending = {"export": ".csv", "report": ".html", "gltf": ".glb"}.get(command, ".png")
    name = f"results{ending}"
    run_file.rename(name)
    before = Path(name).read_bytes()
    Path(f"link{ending}").symlink_to(name)
    picture = ["--png"] if command == "render" else []
    assert main([command, name, "--out", f"link{ending}", *picture]) == 2
    assert "is the file that is read; allowed: another name" in capsys.readouterr().err
    assert Path(name).read_bytes() == before


def test_a_study_is_not_written_into_its_table_nor_a_persons_file(capsys, monkeypatch):
    monkeypatch.setattr(
        "dem_jax.study.batches.run_batch", lambda *_: pytest.fail("it began to compute")
    )
    assert main(["study", "restitution", "--out", "restitution.csv"]) == 2
    assert "results are HDF5; allowed: a name that ends in .h5" in capsys.readouterr().err
    Path("mine.h5.batch").write_text("mine")
    assert main(["study", "restitution", "--quick", "--quiet", "--out", "mine.h5"]) == 2
    assert (
        "mine.h5.batch is in the way, where the study keeps drops that take long"
        in capsys.readouterr().err
    )
    assert Path("mine.h5.batch").read_text() == "mine"


def test_no_table_is_written_if_one_of_them_cannot_be(run_file, capsys):
    name = f"{'y' * 246}.csv"  # of 250 bytes; with -numbers it is too long
    assert main(["export", str(run_file), "--out", name]) == 2
    assert "-numbers.csv cannot be written: File name too long" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["run.h5"]


def test_a_working_folder_that_is_gone_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir("gone")
    (tmp_path / "gone").rmdir()
    assert main(["run", "plate-drop", "--quiet"]) == 2
    assert (
        capsys.readouterr().err
        == "dem_jax: the working folder was removed: No such file or directory\n"
    )


# --- compiled programs ---


def test_a_kept_program_that_was_cut_short_is_removed(tmp_path):
    """JAX would warn at each start, and never write it again."""
    for name in ("jit__chunk-1-cache", "jit__chunk-2-cache", "jit_stage-1-cache"):
        (tmp_path / name).touch()
    shown = []
    said = "Error reading persistent compilation cache entry for 'jit__chunk': error: incomplete or truncated stream"
    for message in (
        said,
        "Error writing persistent compilation cache entry for 'x'",
        "another warning",
    ):
        compile_cache._show_warning(shown.append, tmp_path, message)
    assert shown == ["another warning"]
    assert [path.name for path in tmp_path.iterdir()] == ["jit_stage-1-cache"]


def test_a_process_keeps_the_programs_that_it_used_last(monkeypatch):
    monkeypatch.setattr(programs, "EXECUTABLES", {})
    monkeypatch.setattr(programs, "MOST_EXECUTABLES", 3)
    for key in (1, 2, 3, 1, 4, 5):
        programs._store_executable(key, str)
    assert list(programs.EXECUTABLES) == [1, 4, 5]


def test_a_program_that_is_not_kept_is_freed():
    function = lambda x: x + 3
    gone = weakref.ref(function)
    compiled = xla_flags.jit_for_backend(function, "cpu").lower(1.0).compile()
    assert float(compiled(1.0)) == 4.0
    del function, compiled
    gc.collect()
    assert gone() is None


def test_notes_on_a_scene_are_shown_before_its_first_step(monkeypatch):
    def stop(*_):
        raise SimulationError("before the first step")

    shown = []
    monkeypatch.setattr(loop, "iterate_chunks", stop)
    job = SimpleNamespace(notes=("a bucket is overfull",), reruns=())
    with pytest.raises(SimulationError):
        loop._run_chunks(job, None, SimpleNamespace(show_note=shown.append))
    assert shown == ["a bucket is overfull"]


def test_an_interrupt_after_the_last_sample_says_where_the_results_are(monkeypatch, tmp_path):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(process._STATE, "said", [])
    monkeypatch.setattr("dem_jax.visualization.summary.summarize_run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        simulation_options.finish_run(
            SimpleNamespace(force={}), tmp_path / "drop.h5", SimpleNamespace(no_plot=True)
        )
    assert process.describe_interrupt().endswith(f"all results are in {tmp_path / 'drop.h5'}")
