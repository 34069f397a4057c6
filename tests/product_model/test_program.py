"""How the programs end: one line on stderr and an exit code, whatever happens to their output, and
at once on Ctrl-C.
"""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from product_model import program
from product_model.__main__ import main
from product_model.program import QuietStream, run_program, temporary_file


class Full(io.StringIO):
    """An output that takes nothing."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def flush(self):
        raise self.error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            OSError(28, "No space left on device"),
            2,
            "p: standard output: No space left on device\n",
        ),
        (BrokenPipeError(32, "Broken pipe"), 0, ""),
    ],
)
def test_an_output_that_takes_nothing_is_one_line(error, code, said, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", Full(error))
    assert run_program("p", lambda: print("x"), ()) == code
    assert capsys.readouterr().err == said


def test_a_bar_that_nobody_sees_falls_silent():
    output = Full(OSError(32, "Broken pipe"))
    bar = QuietStream(output)
    bar.flush()
    output.close()
    assert bar.write("x") == 1


def test_a_closed_output_leads_to_nowhere(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["table"]) == 0
    assert sys.stdout.name == os.devnull


def test_letters_that_the_output_lacks_are_replaced(monkeypatch):
    output = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", output)
    assert main(["table"]) == 0
    assert b"| dt_impact | ?t_impact | s |" in output.buffer.getvalue()


def test_an_interrupt_in_a_session_is_one_line(capsys):
    def interrupted():
        raise KeyboardInterrupt

    assert run_program("p", interrupted, ()) == 130
    assert capsys.readouterr().err == "p: interrupted\n"


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_out_of_range_is_one_line(seed, capsys):
    assert main(["simulate", "--seed", str(seed)]) == 2
    assert (
        capsys.readouterr().err
        == f"product_model: seed = {seed}: must be a whole number from 0 to 2147483647\n"
    )


def test_a_missing_device_is_one_line(monkeypatch, capsys):
    """JAX says so by a RuntimeError, or by an AssertionError without words."""
    import jax

    def fail(*_):
        raise AssertionError

    monkeypatch.setattr(jax, "devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    assert run_program("p", fail, ()) == 2
    assert (
        "p: JAX_PLATFORMS = cuda: JAX finds no such device; allowed: cpu" in capsys.readouterr().err
    )
    monkeypatch.undo()
    with pytest.raises(AssertionError):  # any other is a fault
        run_program("p", fail, ())


def test_a_file_appears_when_it_is_complete_and_a_link_is_followed(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with pytest.raises(ValueError), temporary_file(tmp_path / "link.txt") as part:
        part.write_text("half")
        raise ValueError
    assert (tmp_path / "real.txt").read_text() == "old"
    with temporary_file(tmp_path / "link.txt") as part:
        part.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    assert (
        sorted(p.name for p in tmp_path.iterdir()) == ["link.txt", "real.txt"]
        and not program._unfinished
    )


ASLEEP = """
import sys, pathlib, hashlib
sys.argv = ["/bin/calibrate"]
from product_model import program
program.begin_program()
program._unfinished.add(pathlib.Path("half.part"))
pathlib.Path("half.part").write_text("x")
print("printed before")
pathlib.Path("ready").touch()
hashlib.pbkdf2_hmac('sha256', b'', b'', 10**8)
"""


@pytest.mark.skipif(os.name != "posix", reason="of signals of POSIX")
@pytest.mark.parametrize(
    ("number", "words", "code"),
    [(signal.SIGINT, "interrupted", 130), (signal.SIGTERM, "terminated", 143)],
)
def test_a_signal_ends_a_program_at_once_while_it_computes(number, words, code):
    """In a call that does not return to Python for a minute, as into XLA."""
    process = subprocess.Popen(
        [sys.executable, "-c", ASLEEP], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while not Path("ready").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.1)
    begun = time.monotonic()
    process.send_signal(number)
    out, error = process.communicate(timeout=20)
    assert (process.returncode, out, error) == (code, "printed before\n", f"calibrate: {words}\n")
    assert time.monotonic() - begun < 10 and not Path("half.part").exists()


@pytest.mark.skipif(os.name != "posix", reason="of signals of POSIX")
@pytest.mark.parametrize("name", ["product_model", "calibrate"])
def test_ctrl_c_while_a_program_begins_is_one_line(name):
    """While it imports JAX."""
    process = subprocess.Popen(
        [sys.executable, "-v", "-m", name, "--help"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    for line in process.stderr:  # -v tells of each import
        if "import 'numpy" in line:
            process.send_signal(signal.SIGINT)
            break
    said = process.stderr.read()
    assert f"{name}: interrupted\n" in said and "Traceback" not in said and process.wait(20) == 130
