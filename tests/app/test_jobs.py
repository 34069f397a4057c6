"""Commands in processes of their own: the bits of the command line, progress, cancel, crash."""

import asyncio
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from http.client import HTTPConnection
from urllib.parse import urlsplit

import h5py
import pytest

from dem_jax.app import facts
from dem_jax.app.design import Design, name_run_command
from dem_jax.app.helper import Helper
from dem_jax.app.jobs import Job, JobRunner
from dem_jax.app.workers import Drop, Worker
from dem_jax.errors import RecordError

BAR = "settling:  34% |███▍      | 510/1500 ms [00:01 < 00:03, 12.3 µs/step]"


def test_progress_and_time_left_are_read_from_the_bar():
    job = Job(["dem-jax", "run", "x.toml"], state="running")
    for text in ("dt = 6e-06 s", BAR):
        job.read_progress(text)
    assert (job.share, job.message) == (0.34, "settling, 34 %, 00:03 left")
    assert job.errors == ["dt = 6e-06 s"] and job.notes == []
    job.read_progress("note: 2 of 16 drops did not settle")
    assert job.notes == ["2 of 16 drops did not settle"]


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


BALL = """base = 'plate-drop'
[[piece]]
shape = 'sphere'
radius = 0.01
position = [0, 0, 0.02]
[run]
duration = 0.1
[[uncertain]]
key = 'material.youngs_modulus'
range = [1e6, 1e8]
distribution = 'log-uniform'
[[uncertain]]
key = 'material.restitution'
range = [0.1, 0.4]
"""


def read_arrays(path):
    """Name -> bytes of each array of a file of results."""
    with h5py.File(path) as file:
        found = {}
        file.visititems(
            lambda name, item: (
                found.update({name: item[()].tobytes()}) if hasattr(item, "shape") else None
            )
        )
        return found


@pytest.mark.parametrize("runs", [1, pytest.param(16, marks=pytest.mark.long)])
def test_a_prepared_drop_has_the_bits_of_the_command_that_is_shown(tmp_path, runs):
    """The file of a job in a process that has compiled before, against the one of the same command
    in a process of its own; of several drops each with numbers of its own, whose shares are shown.
    """
    (tmp_path / "ball.toml").write_text(BALL)
    drop = Drop(BALL, 0, runs, "ball", runs > 1)
    command = name_run_command(Design(runs=runs, uncertain=True), "ball")

    async def run():
        runner = JobRunner(tmp_path)
        try:
            runner.expect(drop)
            while not runner._spare.is_ready:
                assert runner._spare.process.poll() is None
                await asyncio.sleep(0.05)
            process = runner._spare.process
            job = runner.enter(command, drop)
            task = asyncio.create_task(runner.follow(job))
            await asyncio.sleep(0)
            assert job.process is process, "the one that had prepared"
            return await task
        finally:
            await runner.close()

    job = asyncio.run(run())
    assert job.state == "done", job.message
    argv = shlex.split(job.command.replace("ball.h5", "b.h5"))
    shown = [sys.executable, "-m", "dem_jax", *argv[1:]]
    subprocess.run(shown, cwd=tmp_path, check=True, capture_output=True)
    ours, theirs = read_arrays(tmp_path / "ball.h5"), read_arrays(tmp_path / "b.h5")
    assert "mean_force/plate" in ours and ours == theirs
    shares = facts.describe_shares(str(tmp_path / "ball.h5"))
    assert (shares is None) == (runs == 1)
    assert shares is None or (
        shares.picture and shares.lines[-1].startswith("measure first: youngs_modulus (")
    )


def test_a_process_that_compiles_for_another_drop_does_not_let_one_wait(tmp_path):
    """One that is ready may serve for other scenes, but not for many drops if it compiled for one:
    the compiler has other flags then.
    """
    one = Drop(BALL, 0, 1, "ball")
    worker = Worker(tmp_path)
    try:
        worker.prepare(one)
        assert worker.suits(one._replace(seed=3)) and not worker.is_ready
        assert not worker.suits(one._replace(program="cube"))
        worker._answered = worker._asked
        assert worker.suits(one._replace(program="cube"))
        assert not worker.suits(one._replace(program="cube", runs=16))
    finally:
        worker.kill()
    assert not worker.suits(one), "it has ended"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_server_answers_when_it_says_where_and_leaves_no_process(tmp_path, number):
    command = [sys.executable, "-m", "dem_jax", "app", str(tmp_path), "--no-browser"]
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    with open(tmp_path / "said.txt", "w") as said:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said, text=True, env=own)
    try:
        address = [server.stdout.readline() for _ in range(2)][1].strip()
        where = urlsplit(address)
        asked = HTTPConnection(where.netloc, timeout=60)
        asked.request("GET", f"/?{where.query}")
        assert asked.getresponse().status == 303, "to the page without the token"
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", where.port), timeout=5)  # any other address
        children = list_descendants(server.pid)
        assert len(children) >= 3, "the helper, and the process of the next drop, and their parent"
    finally:
        server.send_signal(number)
        server.wait(30)
    for _ in range(100):
        left = [child for child in children if os.path.exists(f"/proc/{child}/exe")]
        if not left:
            break
        time.sleep(0.1)
    assert not left
    if number == signal.SIGTERM:
        assert (tmp_path / "said.txt").read_text() == ""


def list_descendants(ancestor):
    """Numbers of the processes that a process has started, and of those that they have."""
    parents = {}
    for name in filter(str.isdecimal, os.listdir("/proc")):
        with suppress(OSError), open(f"/proc/{name}/stat") as file:
            parents[int(name)] = int(file.read().rpartition(")")[2].split()[1])
    found = {ancestor}
    while more := {child for child, of in parents.items() if of in found} - found:
        found |= more
    return found - {ancestor}


def test_a_cancelled_drop_says_where_its_results_are(tmp_path):
    (tmp_path / "ball.toml").write_text(BALL.replace("duration = 0.1", "duration = 100.0"))

    async def run():
        runner = JobRunner(tmp_path)
        try:
            job = runner.enter(["dem-jax", "run", "ball.toml", "--out", "ball.h5", "--no-plot"])
            task = asyncio.create_task(runner.follow(job))
            while not job.share and not task.done():  # samples are there
                await asyncio.sleep(0.05)
            assert not task.done(), task.result().errors
            runner.cancel(job)
            assert job.state == "ending" and not job.is_over
            return await task
        finally:
            await runner.close()

    job = asyncio.run(run())
    assert job.state == "cancelled" and "is in ball.h5" in job.message
