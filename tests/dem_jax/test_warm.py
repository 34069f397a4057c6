"""dem-jax warm: programs that are compiled ahead are found by the commands after it."""

import os
import re
import subprocess
import sys

import pytest

from dem_jax.cli.main import main


def test_a_program_is_compiled_once_and_found_by_a_drop(tmp_path):
    cache = tmp_path / "cache"
    own = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "XDG_CACHE_HOME": str(cache)}

    def call(*argv):
        argv = (sys.executable, "-m", "dem_jax", *argv)
        done = subprocess.run(argv, cwd=tmp_path, env=own, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done

    settings = ("--set", "run.sizes=classes", "--set", "run.duration=0.001")
    settings += ("--set", "portion.settling_time=0.001")
    warm = ("warm", "round-candy", "--grams", "20", "25", "--workers", "1", "--quiet", *settings)
    assert re.fullmatch(r"2 scenes need 1 program; compiled: 1 in \d+ s\n", call(*warm).stdout)
    assert re.fullmatch(r"2 scenes need 1 program; compiled: 0 in \d+ s\n", call(*warm).stdout)
    drop = ("--set", "product=round-candy", "--set", "portion.target_weight=0.022")
    done = call("run", "weigh-bucket", *drop, *settings, "--no-plot")
    assert "compiling" not in done.stderr, "it was found"
    assert len(list(cache.rglob("program-*"))) == 1


@pytest.mark.parametrize(
    "argv, words",
    [
        (["--grams", "0"], "--grams 0: allowed: numbers above 0"),
        (["hazel"], "product = 'hazel'"),
        (["--scene", "no-such"], "no-such"),
        (["--set", "run.size=classes"], "run.size"),
    ],
)
def test_what_cannot_be_compiled_is_told_in_one_line(argv, words, capsys):
    assert main(["warm", *argv]) == 2
    assert words in (said := capsys.readouterr().err) and said.count("\n") == 1
