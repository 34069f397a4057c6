"""Commands in processes of their own: the bits of the command line, progress, cancel, crash."""

import asyncio
import os
import signal
import sys
import time

import pytest

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
            good = await runner.run(["dem-jax", "scenes"])
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
            waiting = runner.enter(["dem-jax", "scenes"])
            runner.cancel(waiting)
            await runner.follow(waiting)
            return crashed, waiting, await runner.run(["dem-jax", "buckets"])
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
    """The longest pause of the event loop while another process computes; 100 ms are allowed."""

    async def run():
        runner, longest = JobRunner(tmp_path), 0.0
        try:
            job = asyncio.create_task(runner.run(["dem-jax", "buckets"]))
            while not job.done():
                before = time.perf_counter()
                await asyncio.sleep(0.01)
                longest = max(longest, time.perf_counter() - before - 0.01)
            return longest
        finally:
            await runner.close()

    assert asyncio.run(run()) < 0.1
