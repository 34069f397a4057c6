"""Bad input: exit code 2 and one line on stderr that names key, value and what is allowed; nothing
is written.
"""

import re
import subprocess
import sys
import time

import numpy as np
import pytest

import dem_jax
from dem_jax.__main__ import main
from dem_jax.runner import failure
from dem_jax.scene import parse_scene
from dem_jax.scene.sections.piece import Piece
from dem_jax.types import Sample

SET = [  # --set of plate-drop -> what the line must hold
    ("material.restituton=0.5", r"material\.restituton = 0\.5: unknown key; did you mean 'restitution'\? allowed: den"),
    ("matrial.restitution=0.5", r"matrial = .*: unknown key; did you mean 'material'\?"),
    ("speed=3", r"speed = 3: unknown key; allowed: name, material, run,"),
    ("piece.0.mass=3", r"piece\.0\.mass = 3: unknown key; .*allowed: shape, scale_factor"),
    ("piece.1.radius=3", r"piece\.1\.radius = 3: piece is a list; allowed: piece\.0\.KEY to piece\.0\.KEY"),
    ("piece.0=3", r"piece\.0 = 3: piece is a list"),
    ("motion.0.opening_start=1", r"motion\.0\.opening_start = 1: motion is a list; allowed: none"),
    ("name.x=3", r"name\.x = 3: unknown key; name is a value, not a table"),
    ("name=a/b", r'name = "a/b": allowed: a text that matches'),
    ("material=3", r"material = 3: allowed: a table \[material\]"),
    ("piece=3", r"piece = 3: allowed: tables \[\[piece\]\]"),
    ("material.restitution=0", r"material\.restitution = 0: allowed: a number > 0 and <= 1"),
    ("material.restitution=1.01", r"material\.restitution = 1\.01: allowed: a number > 0 and <= 1"),
    ("material.restitution=-0.1", r"material\.restitution = -0\.1: allowed: a number > 0 and <= 1"),
    ("material.restitution=high", r'material\.restitution = "high": allowed: a number > 0 and <= 1'),
    ("material.density=nan", r"material\.density = nan: allowed: a number > 0"),
    ("material.friction_wall=-1", r"material\.friction_wall = -1: allowed: a number >= 0"),
    ("material.separation_slope_ratio=1", r"material\.separation_slope_ratio = 1: allowed: a number >= 0 and < 1"),
    ("material.stiffness_length=width2", r"stiffness_length = .*width2.* allowed: equivalent-diameter"),
    ("run.time_step=-1.0", r'run\.time_step = -1\.0: allowed: "auto" or a number > 0'),
    ("run.time_step=automatic", r'run\.time_step = "automatic": allowed: "auto" or a number > 0'),
    ("run.time_step=1e-3", r"run\.time_step = 0\.001: allowed: at most 3\.\d+e-05 s, the linear stability limit"),
    ("run.duration=inf", r"run\.duration = inf: allowed: a number > 0"),
    ("run.duration=true", r"run\.duration = true: allowed: a number > 0"),
    ("run.precision=f16", r'run\.precision = "f16": allowed: "f32" or "f64"'),
    ("run.gravity=[0, -9.81]", r"run\.gravity = \[0, -9\.81\]: allowed: a list of 3, each a number"),
    ('run.gravity=[0, 0, "g"]', r'run\.gravity = \[0, 0, "g"\]: allowed: a list of 3, each a number'),
    ("run.track_energy=1", r"run\.track_energy = 1: allowed: true or false"),
    ("run.max_rebuild_interval=0", r"run\.max_rebuild_interval = 0: allowed: a whole number >= 1"),
    ("run.max_rebuild_interval=1.5", r"run\.max_rebuild_interval = 1\.5: allowed: a whole number >= 1"),
    ("run.domain_low=[0, 0, 5]", r"run\.domain_low = .*: allowed: below run\.domain_high"),
    ("run.domain_high=[1, 1, 0.1]", r"piece\.0\.position = .*: outside the domain"),
    ("piece.0.shape=ball", r'piece\.0\.shape = "ball": allowed: "chamfered-cuboid" or "cuboid" or "sphere"'),
    ("piece.0.size=[0.1, -0.1, 0.1]", r"piece\.0\.size = .* allowed: a list of 3, each a number > 0"),
    ("piece.0.scale_factor=0", r"piece\.0\.scale_factor = 0: allowed: a number > 0"),
    ("piece.0.sides=2", r"piece\.0\.sides = 2: allowed: a whole number >= 3"),
    ("piece.0.radius=0.1", r"piece\.0\.radius = 0\.1: not a key of shape 'chamfered-cuboid'; allowed: chamfer, size"),
    ("piece.0.shape=sphere", r"piece\.0\.radius: missing; shape 'sphere' needs it"),
    ("piece.0.shape=hull", r"piece\.0\.shape 'hull': points, stl: exactly one of the two"),
    ("piece.0.chamfer=0.1", r"piece\.0\.chamfer"),
    ("piece.0.position=[0, 0, 0]", r"piece 0 and wall group 'plate' overlap .* %.*; allowed: at most 0\.1 %"),
    ("piece.0.orientation=[0, 0, 0, 0]", r"piece\.0\.orientation = .*: allowed: a quaternion that is not zero"),
    ("wall.0.group='a b'", r'wall\.0\.group = "a b": allowed: a text that matches'),
    ("wall.0.thickness=-0.1", r"wall\.0\.thickness = -0\.1: allowed: a number > 0"),
    ("wall.0.corners=[[0,0,0],[1,0,0]]", r"corners of wall group 'plate'.*at least 3 corners"),
    ("wall.0.corners=[[0,0,0],[1,0,0],[1,1e-9,0]]", r"corners of wall group 'plate' corners 1 and 2 coincide"),
    ("wall.0.corners=[[0,0,0],[1,0,0],[0.5,1e-9,0]]", r"corners of wall group 'plate' has no area"),
    ("wall.0.corners=[[0,0,0],[1,0,0],[1,1,0.5],[0,1,0]]", r"corners of wall group 'plate' corner .* off its plane"),
    ("piece=[]", r"a scene needs \[portion\] or at least one \[\[piece\]\]"),
    ("run.duration", r"--set 'run\.duration': allowed: section\.key=value"),
]  # fmt: skip

EXTREME = [  # numbers that are finite but that nobody means; --set of plate-drop -> what the line
# must hold
    ("material.density=1e-31", r"density = 1e-31: allowed: numbers whose size is 1e-30 to 1e\+30, and 0 where that may be"),
    ("material.numerical_softening=1e300", r"softening = 1e\+300: allowed: numbers whose size is"),
    ("run.gravity=[0, 0, -1e31]", r"gravity = -1e\+31: allowed: numbers whose size is"),
    ("run.max_rebuild_interval=1000000000000", r"max_rebuild_interval = 1000000000000: allowed: a whole number >= 1 and <= 65536"),
    (f"piece.0.max_parts=1{400 * '0'}", r"max_parts = a large whole number: allowed"),
    ("material.density=1e-20", r"[\d.e+]+ steps of [\d.e-]+ s; allowed: at most 2\.1\d+e\+09; .* is material\.density = 1e-20"),
    ("run.duration=1e9", r"steps of .*furthest from what is usual is run\.duration = 1e\+09"),
    ("run.sample_interval=1e-20", r"steps of .*furthest from what is usual is run\.sample_interval = 1e-20"),
    ("piece.0.scale_factor=1e20", r"pieces\.mass is beyond the numbers of single precision; .* is piece\.0\.scale_factor = 1e\+20"),
    ("piece.0.size=[1e30, 0.02, 0.02]", r"no numbers to compute with \(.*\); .* is piece\.0\.size = 1e\+30"),
    ('piece=[{shape="cuboid", size=[1e-300, 1, 1], position=[0, 0, 9]}]', r"size\[0\] = 1e-300 must be .* cube is more than 0"),
    ("piece.0.sides=1000000", r"sides = 1000000: allowed: a whole number >= 3 and <= 1000"),
    ("wall.0.thickness=1e-30", r"wall.*thickness = 1e-30: allowed for a panel of 1\.41 m: 1\.4e-09 to 1\.4e\+09 m"),
    ("material=" + 50 * "[" + 50 * "]", r"nested too deep; allowed: 12 tables and lists in each other"),
    ("a.b.c.d.e.f.g.h.i.j.k.l.m=1", r"nested too deep"),
    ('name="a\\u001bb"', r'name = "a\\u001bb": allowed: a text that matches'),
    ('wall.0.group=".."', r'wall\.0\.group = "\.\.": allowed: a text that matches'),
]  # fmt: skip

TOML = [  # a scene file -> what the line must hold
    ("[run\nduration = 1", r"scene\.toml: not valid TOML"),
    ('base = "plate-drp"', r"'plate-drp': no such file, nor one of the stock scenes"),
    ('base = "scene.toml"', r"based on itself"),
    ("base = 3", r"base = 3: allowed: a stock scene's name or a path"),
    ("[run]\nduration = 1", r"a scene needs \[portion\] or at least one \[\[piece\]\]"),
    ("[[piece]]\nshape = 'cuboid'", r"piece\.0\.position: missing; it must be given: a list of 3, each a number"),
    ("[portion]", r"portion: region_low, region_high: missing"),
    ('base = "weigh-bucket"\n[portion]\nregion_low = [9,0,0]', r"portion: region_high: missing; allowed: both corners"),
    ("[portion]\nregion_low = [0,0,0]\nregion_high = [0.01,0.01,1]", r"region of 0\.01 x 0\.01 m is too narrow"),
    ("[portion]\ncount = 0", r"portion\.count = 0: allowed: a whole number >= 1"),
    ('base = "plate-drop"\n[[motion]]\ngroup = "plat"', r"motion\.group = 'plat': no wall has this group"),
    ('base = "plate-drop"\n[[motion]]\ngroup = "plate"\naxis = [0,0,0]', r"motion\.axis = .*: allowed: a vector that"),
    ('base = "plate-drop"\n[[motion]]\nopening_start = 1', r"motion\.0\.group: missing; it must be given: a text"),
    ('base = "plate-drop"\n[[wall]]\ngroup = "w"', r"wall 'w': corners, stl: exactly one of the two"),
    ('base = "plate-drop"\n[[wall]]\ngroup = "w"\nstl = "gone.stl"', r"wall\.0\.stl = '.*gone\.stl': there is no"),
    ('[[piece]]\nshape = "hull"\nposition = [0,0,1]\nstl = "open.stl"', r"piece\.0\.stl = '.*open\.stl' is an open m"),
    ('[[piece]]\nshape = "hull"\nposition = [0,0,1]\nstl = "bent.stl"', r"piece\.0\.stl = '.*bent\.stl' is not convex"),
    ('[[piece]]\nshape = "hull"\nposition = [0,0,1]\nstl = "text.stl"', r"piece\.0\.stl = '.*text\.stl'"),
    ('[[piece]]\nshape = "hull"\nposition = [0,0,1]\npoints = [[0,0,0],[1,0,0],[0,1,0],[1,1,0]]', r"piece\.0\.points"),
    ('[weigh_bucket]\nflap_angle_deg = 95\n[portion]', r"weigh_bucket\.flap_angle_deg = 95: allowed: .* > 0 and < 90"),
    ("x = " + 3000 * "[" + 3000 * "]", r"scene\.toml: not valid TOML|nested too deep"),
    ("x = " + 5000 * "1", r"scene\.toml: not valid TOML"),
    ('base = "weigh-bucket"\n[portion]\ntarget_weight = 1e9', r"pieces; allowed: .* 1e\+06; .* portion\.target_weight = 1e\+09"),
    ('base = "weigh-bucket"\n[portion]\nscale_factor = 1e-6', r"pieces; allowed: .* 1e\+06; .* portion\.scale_factor = 1e-06"),
    ('[weigh_bucket]\nopening_size = [0.1]\n[portion]', r"weigh_bucket\.opening_size = \[0\.1\]: allowed: a list of 2, each a"),
]  # fmt: skip

COMMANDS = [  # a command -> what the line must hold
    (["run"], r"either a SCENE or --resume FILE"),
    (["run", "plate-drop", "--resume", "x.h5"], r"either a SCENE or --resume FILE"),
    (["run", "nowhere.toml"], r"'nowhere\.toml': no such file, nor one of the stock scenes \(plate-drop"),
    (["run", "."], r"no such file"),
    (["run", "--resume", "gone.h5"], r"gone\.h5: there is no such file"),
    (["run", "--resume", "cut.h5"], r"cut\.h5"),
    (["run", "--resume", "text.stl"], r"text\.stl is not an HDF5 file"),
    (["run", "--resume", "x.h5", "--set", "run.time_step=1"], r"allowed beside it: --duration"),
    (["run", "plate-drop", "--out", "whole.h5"], r"whole\.h5 exists; allowed: another name by --out, or --overwrite to replace it"),
    (["run", "plate-drop", "--out", "x.csv"], r"--out x\.csv: results are HDF5; .* python -m dem_jax export makes \.csv"),
    (["export", "whole.h5", "--out", "x.txt"], r"x\.txt must end in one of: \.csv, \.xlsx"),
    (["run", "plate-drop", "--out", "no/where.h5"], r"no/where\.h5 cannot be written: there is no folder 'no'"),
    (["run", "plate-drop", "--seed", "-1"], r"--seed: '-1': allowed: a whole number of at least 0"),
    (["run", "plate-drop", "--duration", "-1"], r"run\.duration = -1\.0: allowed: a number > 0"),
    (["run", "plate-drop", "--speed", "3"], r"unrecognized arguments: --speed 3"),
    (["ensemble", "plate-drop", "--runs", "0"], r"--runs: '0': allowed: a whole number of at least 1"),
    (["ensemble", "plate-drop", "--runs", "many"], r"--runs: 'many': allowed"),
    (["ensemble", "plate-drop", "--runs", "1" + 30 * "0"], r"runs = 10+: allowed: a whole number from 1 to 1000000"),
    (["run", "plate-drop", "--seed", "9223372036854775808"], r"seed = 9223372036854775808: allowed: a whole number from 0 to"),
    (["scenes", "nothing"], r"'nothing': no such file, nor one of the stock scenes"),
    (["plot", "gone.h5"], r"gone\.h5: there is no such file"),
    (["plot", "cut.h5"], r"cut\.h5"),
    (["plot", "whole.h5", "--group", "wb"], r"--group wb: whole has no such group; allowed: plate"),
    (["report", "whole.h5", "--group", "wb"], r"--group wb: whole has no such group; allowed: plate"),
    (["plot", "whole.h5", "--out", "a.xls"], r"a\.xls must end in one of: \.png"),
    (["render", "gone.h5"], r"gone\.h5: there is no such file"),
    (["render", "whole.h5"], r"the run has no frames; set run\.frame_interval"),
    (["render", "whole.h5", "--run", "1"], r"--run 1: whole\.h5 holds a single run"),
    (["render", "whole.h5", "--strip", "a,b"], r"--strip: 'a,b': allowed: a number of instants"),
    (["vtk", "whole.h5"], r"the run has no frames"),
    (["walk"], r"invalid choice: 'walk'"),
    ([], r"the following arguments are required: COMMAND"),
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The file of a short run without frames."""
    path = tmp_path_factory.mktemp("whole") / "whole.h5"
    scene = {
        "piece": [{"shape": "sphere", "radius": 0.01, "position": [0, 0, 0.1]}],
        "run.duration": 1e-3,
        "run.frame_interval": 0,
    }
    dem_jax.simulate(dem_jax.load_scene("plate-drop", scene), out=path)
    return path


@pytest.fixture
def folder(tmp_path, whole):
    """A folder with broken and whole files."""
    import trimesh

    box = trimesh.creation.box((0.02, 0.02, 0.02))
    trimesh.Trimesh(box.vertices, box.faces[2:]).export(tmp_path / "open.stl")
    star = trimesh.creation.icosphere(1)
    star.vertices *= (0.01 + 0.01 * (np.arange(len(star.vertices)) % 2))[:, None]
    star.export(tmp_path / "bent.stl")
    (tmp_path / "text.stl").write_text("no triangles")
    (tmp_path / "whole.h5").write_bytes(whole.read_bytes())
    (tmp_path / "cut.h5").write_bytes(whole.read_bytes()[:3000])
    return tmp_path


def assert_refused(argv, expected, folder, capsys):
    before = {path: path.read_bytes() for path in folder.iterdir()}
    try:
        code = main(argv)
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert code == 2 and out == ""
    assert len(err.splitlines()) == 1, err
    assert re.search(expected, err), err
    assert {path: path.read_bytes() for path in folder.iterdir()} == before, "nothing is written"


@pytest.mark.parametrize(("setting", "expected"), SET)
def test_a_setting_that_cannot_be(setting, expected, tmp_path, capsys):
    assert_refused(["run", "plate-drop", "--quiet", "--set", setting], expected, tmp_path, capsys)


@pytest.mark.parametrize(("setting", "expected"), EXTREME)
def test_a_number_that_nobody_means(setting, expected, tmp_path, capsys):
    assert_refused(["run", "plate-drop", "--quiet", "--set", setting], expected, tmp_path, capsys)


@pytest.mark.parametrize(("text", "expected"), TOML)
def test_a_scene_file_that_cannot_be(text, expected, folder, capsys):
    (folder / "scene.toml").write_text(text)
    assert_refused(["run", "scene.toml", "--quiet"], expected, folder, capsys)


@pytest.mark.parametrize(("argv", "expected"), COMMANDS)
def test_a_command_that_cannot_be(argv, expected, folder, capsys):
    assert_refused(argv, expected, folder, capsys)


def test_pieces_that_overlap_at_the_start_are_both_named(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(
        'base = "plate-drop"\n[[piece]]\nposition = [0, 0, 0.1]\n[[piece]]\nposition = [0.01, 0, 0.112]\n'
    )
    expected = r"piece 1 and piece 0 overlap at the start by 25 % of the piece's width; allowed: at most 0\.1 %"
    assert_refused(["run", "scene.toml", "--quiet"], expected, tmp_path, capsys)


def test_as_a_process(tmp_path):
    command = [
        sys.executable,
        "-m",
        "dem_jax",
        "run",
        "plate-drop",
        "--set",
        "material.restitution=2",
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, env={"PYTHONPATH": ":".join(sys.path)}
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        done.stderr
        == "dem_jax: plate-drop: material.restitution = 2: allowed: a number > 0 and <= 1\n"
    )


def test_a_run_whose_numbers_overflow_stops(whole):
    """Energies of a contact that is next to nothing stiff are infinite; nothing else would show it."""
    scene = parse_scene(dem_jax.load_run(whole).scene)
    expected = r"at t = 3e-05 s: energy not finite; likely cause: .* usual is material\.numerical_softening = 1e-30"
    with pytest.raises(dem_jax.SimulationError, match=expected) as caught:
        dem_jax.simulate(
            scene.replace({"material.numerical_softening": 1e-30, "run.duration": 9e-5})
        )
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("runs", [(), (2,)])
def test_a_force_that_is_not_finite_is_found(runs):
    force = np.zeros((*runs, 5, 1, 3))
    force[..., 3:, 0, 2] = np.nan
    one = np.zeros((*runs, 5))
    sample = Sample(
        {
            "force": force,
            "own": one,
            "culprit": one.astype(int) - 1,
            "max_relative_overlap": one,
            "stride": one,
        }
    )
    assert failure.detect_failure(sample, 5) == (0, 3)
    assert failure.detect_failure(sample, 3) is None, "samples beyond count are none"
    assert failure.detect_failure(sample.replace(own=one + np.nan), 3) == (0, 0), (
        "a user's quantity is no exception"
    )


def test_frames_that_are_rarer_than_the_run_is_long(whole):
    scene = parse_scene(dem_jax.load_run(whole).scene)
    assert dem_jax.simulate(
        scene.replace({"run.frame_interval": 1e5, "run.duration": 9e-5})
    ).pieces.time.tolist() == [0.0]


def test_many_corners_are_checked_quickly():
    """A hull of ten thousand points, each looked at once: a few milliseconds of the processor, of
    which a hundred are allowed.
    """
    points = np.random.default_rng(0).random((10_000, 3)).tolist()
    times = []
    for _ in range(5):
        start = time.process_time()
        Piece(shape="hull", points=points, position=[0, 0, 0])
        times.append(time.process_time() - start)
    assert min(times) < 0.1
