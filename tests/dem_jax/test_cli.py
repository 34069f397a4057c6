"""The command line, in-process and as a real process: files, summary, pictures, help, exit codes."""

import os
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import jax
import numpy as np
import pytest

import dem_jax
from dem_jax.__main__ import main
from dem_jax.scene import describe_scene, load_scene, parse_scene, stock_scenes

SCENE = """
base = "plate-drop"
[[piece]]
shape = "sphere"
radius = 0.01
position = [0, 0, 0.012]
[run]
duration = 0.03
frame_interval = 2e-3
"""


@pytest.fixture(autouse=True)
def no_lasting_cache_settings():
    """The command line sets where compiled programs are kept; the tests' own choice is put back."""
    kept = {
        name: getattr(jax.config, name)
        for name in dir(jax.config)
        if "cache" in name and name.startswith("jax_")
    }
    yield
    for name, value in kept.items():
        jax.config.update(name, value)


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "ball.toml").write_text(SCENE)
    return "ball.toml"


def process(*arguments, **environment):
    settings = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
    }
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=settings | environment, capture_output=True, text=True)


def test_run_writes_file_and_figure_and_says_what_happened(scene, tmp_path, capsys):
    assert (
        main(
            [
                "run",
                scene,
                "--set",
                "material.restitution=0.3",
                "--set",
                "run.duration=0.06",
                "--seed",
                "4",
            ]
        )
        == 0
    )
    out, err = capsys.readouterr()
    for words in (
        "dt/dt_crit =", "quarter period, sphere of 4189 mm3 against a wall", "1 piece, 0.06 s", "s compiling",
        "peak PIF on plate:", "kg at t = 20.", "settled mass in plate at the end: 1.257 g", "duration of the impact:",
        "ms from first force to the last piece at rest", "wrote ball.h5, ball.png",
    ):  # fmt: skip
        assert words in out, words
    assert "100%" in err and "µs/step" in err, "the bar"
    run = dem_jax.load_run("ball.h5")
    assert run.seed == 4 and parse_scene(run.scene).material.restitution == 0.3
    assert (tmp_path / "ball.png").read_bytes().startswith(b"\x89PNG")


def test_peak_and_duration_in_the_summary_are_those_of_the_run(scene, capsys):
    from dem_jax.visualization.summary import impact_duration

    soft = ["--set", "material.restitution=0.3", "--set", "run.duration=0.06"]  # slower than 0.1
    # m/s after the impact
    assert main(["run", scene, *soft, "--quiet", "--no-plot", "--out", "x.h5"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    run = dem_jax.load_run("x.h5")
    pif = -run.mean_force["plate"][:, 2] / 9.81
    k = int(np.argmax(pif))
    assert f"peak PIF on plate: {pif[k]:.3g} kg at t = {1e3 * run.time[k]:.4g} ms" in out
    first = run.time[np.flatnonzero(pif > 0)[0]]
    assert first == pytest.approx(np.sqrt(2 * 0.002 / 9.81), abs=3e-5)
    mass = run.settled_mass["plate"]
    end = run.time[np.flatnonzero(mass < mass[-1])[-1] + 1]
    assert impact_duration(run, "plate", "plate") == pytest.approx(end - first, abs=1e-9)
    assert f"duration of the impact: {1e3 * (end - first):.4g} ms" in out


def test_a_run_goes_on_from_its_file(scene, capsys):
    assert main(["run", scene, "--quiet", "--duration", "0.01"]) == 0
    assert main(["run", "--resume", "ball.h5", "--duration", "0.03", "--quiet", "--no-plot"]) == 0
    whole = dem_jax.simulate(scene)
    np.testing.assert_array_equal(dem_jax.load_run("ball.h5").force["plate"], whole.force["plate"])
    assert "wrote ball.h5" in capsys.readouterr().out


def test_pictures_and_exports_of_a_file(scene, tmp_path, capsys):
    assert main(["run", scene, "--quiet", "--no-plot"]) == 0
    for command, file in (
        (["plot", "ball.h5"], "ball.png"),
        (["plot", "ball.h5", "--out", "a.svg", "--group", "plate", "--start", "0.02"], "a.svg"),
        (["plot", "ball.h5", "ball.h5", "--out", "both.png"], "both.png"),
        (["report", "ball.h5"], "ball-report.html"),
        (["export", "ball.h5"], "ball.csv"),
        (["render", "ball.h5"], "ball.gif"),
        (["render", "ball.h5", "--at", "0.01"], "ball-scene.png"),
        (
            ["render", "ball.h5", "--strip", "3", "--out", "strip.png", "--colour", "piece"],
            "strip.png",
        ),
        (["vtk", "ball.h5"], "ball-vtk/pieces.pvd"),
    ):
        assert main(command) == 0, capsys.readouterr().err
        assert file in capsys.readouterr().out and (tmp_path / file).stat().st_size > 500
    assert len(list((tmp_path / "ball-vtk" / "frames").glob("pieces_*.vtp"))) == 15


def test_an_ensemble_is_run_and_drawn(scene, capsys):
    assert (
        main(["ensemble", scene, "--runs", "2", "--seed", "5", "--duration", "0.025", "--quiet"])
        == 0
    )
    out = capsys.readouterr().out
    assert "2 runs of 1 piece" in out and "wrote ball-ensemble.h5, ball-ensemble.png" in out
    runs = dem_jax.load_run("ball-ensemble.h5")
    assert runs.run_count == 2 and runs.seed == (5, 6)
    assert main(["render", "ball-ensemble.h5", "--png", "--run", "1"]) == 0
    assert main(["render", "ball-ensemble.h5", "--png", "--run", "2"]) == 2
    assert "it has 0 to 1" in capsys.readouterr().err


def test_a_run_that_goes_wrong_exits_with_1_and_says_where_its_file_is(scene, capsys):
    assert main(["run", scene, "--quiet", "--set", "run.domain_low=[-1, -1, 0.011]"]) == 1
    out, err = capsys.readouterr()
    assert len(err.splitlines()) == 1 and out == ""
    assert (
        "ball: piece 0 at t =" in err
        and "below z = 0.011 m" in err
        and "earlier results are in ball.h5" in err
    )
    assert dem_jax.load_run("ball.h5").time[-1] == pytest.approx(
        np.sqrt(2 * 0.001 / 9.81), abs=6e-5
    )


def test_stock_scenes_are_listed_and_printed_with_every_key(capsys):
    assert main(["scenes"]) == 0
    listed = capsys.readouterr().out
    for name, text in stock_scenes().items():
        assert name in listed and text in listed
        assert main(["scenes", name]) == 0
        text = capsys.readouterr().out
        assert parse_scene(text) == load_scene(name), "what is printed is the scene"
        for words in (
            "# kg/m3, pieces; a number > 0",
            "settling_time = 0.5",
            "# m/s2; a list of 3, each a number",
        ):
            assert words in text


def test_values_that_differ_from_the_default_are_told():
    text = describe_scene(load_scene("plate-drop", {"run.duration": 0.7, "piece.0.sides": None}))
    assert "duration = 0.7" in text and "default: 0.2" in text


@pytest.mark.parametrize(
    "command",
    [[], ["run"], ["ensemble"], ["scenes"], ["plot"], ["report"], ["export"], ["render"], ["vtk"]],
)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0 and "usage: dem_jax" in capsys.readouterr().out


def test_as_a_process_it_keeps_compiled_programs_in_the_users_cache(scene, tmp_path):
    settings = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "JAX_COMPILATION_CACHE_DIR": ""}
    done = process("-m", "dem_jax", "run", scene, "--quiet", "--no-plot", **settings)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    kept = tmp_path / "cache" / "dem_jax" / "jax" / "dem_jax"
    assert sorted(path.name.split("-")[0] for path in kept.iterdir()) == ["program", "scratch"]


def test_nothing_heavy_is_imported_before_it_is_used():
    program = "import sys, dem_jax, dem_jax.__main__ as m; m.main(['scenes']); print(sorted(sys.modules), file=sys.stderr)"
    loaded = eval(process("-c", program).stderr)
    assert {"jax", "numpy", "scipy", "h5py", "matplotlib", "trimesh", "tqdm"}.isdisjoint(loaded)
    program = "import sys, dem_jax; dem_jax.simulate; print(sorted(sys.modules))"
    loaded = eval(process("-c", program).stdout)
    assert {"h5py", "matplotlib", "trimesh", "tqdm", "jax_md", "optax"}.isdisjoint(loaded)


ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_stands_once_in_the_code():
    assert "version" not in PROJECT and PROJECT["dynamic"] == ["version"]
    assert f"\nversion: {dem_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {dem_jax.__version__}\n" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_each_script_is_a_command_with_help(name, capsys):
    module, function = PROJECT["scripts"][name].split(":")
    with pytest.raises(SystemExit) as stop:
        getattr(import_module(module), function)(["--help"])
    assert stop.value.code == 0 and "usage:" in capsys.readouterr().out
