"""The same on a GPU as on a CPU. Only with one: ``JAX_PLATFORMS=cuda,cpu python -m pytest
tests/dem_jax/test_gpu.py``.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import dem_jax

pytestmark = pytest.mark.skipif(jax.default_backend() == "cpu", reason="needs a GPU")

SEEDS = [3, 4]
DROP = {  # until some milliseconds after the first piece has landed
    "portion.settling_time": 0.1, "run.duration": 0.16, "run.precision": "f64", "material.numerical_softening": 0.001,
    "run.frame_interval": 0.0,
}  # fmt: skip
ROUNDING = 1e-6  # of the largest: of differences in the last bit, which collisions amplify

SIMULATE = """
import json, sys
import dem_jax
for seed in json.loads(sys.argv[1]):
    dem_jax.simulate(dem_jax.load_scene("quick-release", json.loads(sys.argv[2])), seed, sys.argv[3] + f"/{seed}.h5")
"""
DERIVATIVES = """
import json, sys
import jax
from tests.dem_jax.test_gpu import derivatives
jax.config.update("jax_enable_x64", True)
print(json.dumps(derivatives()))
"""


def on_a_cpu(script, *arguments):
    """What a script prints in a process that has no GPU."""
    home = str(Path(__file__).parents[2])
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join([home, *sys.path]),
    }
    words = [sys.executable, "-c", script, *map(str, arguments)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def of_cpu(tmp_path_factory):
    """Drops computed by a CPU."""
    folder = tmp_path_factory.mktemp("cpu")
    on_a_cpu(SIMULATE, json.dumps(SEEDS), json.dumps(DROP), folder)
    return [dem_jax.load_run(folder / f"{seed}.h5") for seed in SEEDS]


def assert_same_drop(of_gpu, of_cpu):
    """Traces agree to rounding, and are of something."""
    np.testing.assert_array_equal(of_gpu.time, of_cpu.time)
    for series in (
        lambda run: run.force["fb_flaps"],
        lambda run: run.force["wb_flaps"],
        lambda run: run.momentum,
    ):
        expected = series(of_cpu)
        scale = np.abs(expected).max()
        assert scale > 0
        np.testing.assert_allclose(series(of_gpu), expected, rtol=0, atol=ROUNDING * scale)


def test_a_drop(of_cpu):
    assert_same_drop(
        dem_jax.simulate(dem_jax.load_scene("quick-release", DROP), seed=SEEDS[0]), of_cpu[0]
    )


def test_drops_side_by_side(of_cpu):
    runs = dem_jax.ensemble(dem_jax.load_scene("quick-release", DROP), seed=SEEDS)
    for k, one in enumerate(of_cpu):
        assert_same_drop(runs.member(k), one)


def test_a_run_that_a_cpu_began_goes_on(of_cpu, tmp_path):
    on_a_cpu(SIMULATE, json.dumps(SEEDS[:1]), json.dumps(DROP | {"run.duration": 0.13}), tmp_path)
    assert_same_drop(dem_jax.resume(tmp_path / f"{SEEDS[0]}.h5", duration=0.16), of_cpu[0])


def derivatives():
    """Of a smooth peak by three numbers of the scene."""
    from tests.dem_jax.test_rollout import PARAMETERS, ball

    peak = lambda p: dem_jax.smooth_peak(-dem_jax.rollout(ball(), p).force["plate"][:, 2], 0.3)
    by = jax.jit(jax.grad(peak))(PARAMETERS)
    return {name: np.asarray(value).tolist() for name, value in by.items()}


def test_derivatives():
    expected = json.loads(on_a_cpu(DERIVATIVES))
    for name, value in derivatives().items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-9, atol=0, err_msg=name)
