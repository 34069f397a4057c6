"""Commands in processes of their own: the bits of the command line, progress, cancel, crash."""

import asyncio
import os
import shlex
import signal
import subprocess
import sys
import time

import h5py
import pytest

from dem_jax.app.design import Design, name_run_command
from dem_jax.app.helper import Helper
from dem_jax.app.jobs import Job, JobRunner
from dem_jax.errors import RecordError

BAR = "settling:  34% |███▍      | 510/1500 ms [00:01 < 00:03, 12.3 µs/step]"


def test_progress_and_time_left_are_read_from_the_bar():
    job = Job(["dem-jax", "run", "x.toml"], state="running")
    for text in ("dt = 6e-06 s", BAR):
        job.read_progress(text)
    assert (job.share, job.message) == (0.34, "settling, 34 %, 00:03 left")
    assert job.errors == ["dt = 6e-06 s"]


def test_a_job_runs_what_its_command_says(tmp_path):
    async def run():
        runner = JobRunner(tmp_path)
        try:
            good = await runner.run(["dem-jax", "list", "scenes"])
            bad = await runner.run(["dem-jax", "run", "none.toml"])
            return good, bad
        finally:
            await runner.close()

    good, bad = asyncio.run(run())
    assert good.state == "done" and any(line.startswith("weigh-bucket") for line in good.lines)
    assert bad.state == "failed" and "none.toml" in bad.message
    with pytest.raises(KeyError):
        JobRunner(tmp_path).enter(["rm", "-rf", "x"])


def test_a_crash_and_a_cancel_are_told_and_the_next_job_runs(tmp_path):
    async def run():
        runner = JobRunner(tmp_path)
        try:
            crashed = runner.enter(["dem-jax", "run", "plate-drop"])
            task = asyncio.create_task(runner.follow(crashed))
            while crashed.process is None:
                await asyncio.sleep(0.01)
            os.kill(crashed.process.pid, signal.SIGKILL)
            await task
            waiting = runner.enter(["dem-jax", "list", "scenes"])
            runner.cancel(waiting)
            await runner.follow(waiting)
            return crashed, waiting, await runner.run(["dem-jax", "list", "buckets"])
        finally:
            await runner.close()

    crashed, cancelled, after = asyncio.run(run())
    assert crashed.state == "failed" and "signal 9 (SIGKILL)" in crashed.message
    assert cancelled.message == "cancelled: it had not begun"
    assert after.state == "done"


def test_the_helper_tells_a_reason_and_survives_its_death():
    async def ask():
        helper = Helper()
        try:
            with pytest.raises(RecordError, match="ValueError|invalid|literal"):
                await helper.ask(int, "x")
            with pytest.raises(RecordError, match="has ended"):
                await helper.ask(os._exit, 1)
            return await helper.ask(abs, -3)
        finally:
            helper.close()

    assert asyncio.run(ask()) == 3


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_the_loop_answers_while_a_job_runs(tmp_path):
    """Pauses of the event loop while another process computes: 100 ms are allowed, but for one in
    twenty, as a busy machine gives this process no time.
    """

    async def run():
        runner, pauses = JobRunner(tmp_path), []
        try:
            job = asyncio.create_task(runner.run(["dem-jax", "list", "buckets"]))
            while not job.done():
                before = time.perf_counter()
                await asyncio.sleep(0.01)
                pauses.append(time.perf_counter() - before - 0.01)
            return sorted(pauses)[int(0.95 * len(pauses))]
        finally:
            await runner.close()

    assert asyncio.run(run()) < 0.1


def test_a_drop_by_clicks_has_the_bits_of_the_command_that_is_shown(tmp_path):
    """The file that a job writes against the one of the same command in a process of its own."""
    ball = "[[piece]]\nshape = 'sphere'\nradius = 0.01\nposition = [0, 0, 0.02]\n"
    (tmp_path / "ball.toml").write_text(f"base = 'plate-drop'\n{ball}[run]\nduration = 0.1\n")

    async def run(argv):
        runner = JobRunner(tmp_path)
        try:
            return await runner.run(argv)
        finally:
            await runner.close()

    argv = [*name_run_command(Design(), "ball")]
    job = asyncio.run(run(argv))
    assert job.state == "done", job.message
    shown = job.command.replace("dem-jax", f"{sys.executable} -m dem_jax").replace(
        "ball.h5", "b.h5"
    )
    subprocess.run(shlex.split(shown), cwd=tmp_path, check=True, capture_output=True)
    with h5py.File(tmp_path / "ball.h5") as one, h5py.File(tmp_path / "b.h5") as other:
        names = []
        one.visititems(lambda name, item: names.append(name) if hasattr(item, "shape") else None)
        assert "mean_force/plate" in names
        for name in names:
            assert one[name][()].tobytes() == other[name][()].tobytes(), name
