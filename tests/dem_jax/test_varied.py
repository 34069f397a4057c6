"""Ensembles over parameters: each run is that of its own scene, in one program, and what cannot be
one is said.
"""

import dataclasses
import operator

import h5py
import jax
import numpy as np
import pytest
from scipy import stats

import dem_jax
from calibrate import targets
from dem_jax import assembly
from dem_jax.assembly.ensemble_capacity import find_ensemble_capacity
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.errors import RecordError, SceneError, SimulationError
from dem_jax.io import run_files, series
from dem_jax.runner import executors, job_setup, parameter_sweep, programs
from dem_jax.scene import load_scene, parse_scene
from dem_jax.visualization.metadata import collect_facts, portion_weights
from dem_jax.visualization.summary import summarize_run

BALLS = {
    "portion": {
        "shape": "sphere", "radius": 0.01, "count": 2, "arrangement": "scattered",
        "region_low": [-0.05, -0.05, 0.0], "region_high": [0.05, 0.05, 0.1],
    },
    "piece": [], "name": "balls", "run.precision": "f64", "run.duration": 0.02, "run.sample_interval": 2e-5, "run.frame_interval": 7e-4,
}  # fmt: skip
PARAMETERS = {
    "material.restitution": [0.2, 0.5, 0.5],  # of another time step too
    "material.friction_wall": [0.1, 0.3, 0.3],
    "portion.region_high": [[0.05, 0.05, 0.1], [0.04, 0.04, 0.08], [0.04, 0.04, 0.08]],
}
SEEDS = (7, 7, 9)


def balls(**changes):
    return dem_jax.load_scene(
        "plate-drop", BALLS | {key.replace("__", "."): value for key, value in changes.items()}
    )


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    path = tmp_path_factory.mktemp("varied") / "three.h5"
    return dem_jax.ensemble(balls(), seed=SEEDS, parameters=PARAMETERS, out=path), path


def test_each_run_has_the_bits_of_its_own_scene_by_itself(three):
    found, _ = three
    assert found.run_count == 3 and found.seed == SEEDS
    for k in range(3):
        own = balls().replace({key: values[k] for key, values in PARAMETERS.items()})
        member, alone = found.member(k), dem_jax.simulate(own, seed=SEEDS[k])
        assert np.abs(alone.force["plate"]).max() > 0.01, "the balls have landed"
        assert (
            parse_scene(member.scene, "run") == parse_scene(alone.scene, "run")
            and member.seed == SEEDS[k]
            and not member.parameters
        )
        np.testing.assert_array_equal(member.force["plate"], alone.force["plate"])
        np.testing.assert_array_equal(member.pieces.position, alone.pieces.position)


def test_all_runs_share_one_program():
    programs.EXECUTABLES.clear()
    dem_jax.ensemble(balls(), seed=SEEDS, parameters=PARAMETERS)
    assert len(programs.EXECUTABLES) == 1


COUNTS = [2, 3, 2]


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    path = tmp_path_factory.mktemp("counted") / "counted.h5"
    programs.EXECUTABLES.clear()
    dem_jax.ensemble(balls(), seed=SEEDS, parameters={"portion.count": COUNTS}, out=path)
    assert len(programs.EXECUTABLES) == 1
    return path


def test_runs_of_different_numbers_of_pieces_share_a_program_and_have_the_bits_of_their_own_scenes(
    counted,
):
    found = run_files.load_run(counted)
    assert found.piece_counts.tolist() == COUNTS and found.header.piece_count == 3
    for k in (0, 2):
        count, member = COUNTS[k], found.member(k)
        alone = dem_jax.simulate(balls(), seed=SEEDS[k])
        assert np.abs(alone.force["plate"]).max() > 0.01, "the balls have landed"
        assert (
            parse_scene(member.scene, "run") == parse_scene(alone.scene, "run")
            and member.header.piece_count == count
        )
        assert (
            member.info["piece_masses"] == alone.info["piece_masses"]
            and member.info["moving"] == alone.info["moving"]
        )
        assert member.dt == alone.dt and member.piece_counts.tolist() == [count]
        np.testing.assert_array_equal(member.pieces.position, alone.pieces.position)
        for one, other in (
            (member.force["plate"], alone.force["plate"]),
            (member.energy["total"], alone.energy["total"]),
        ):
            np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-14)  # sums of more terms,
            # which are 0
    assert (
        np.isnan(found.pieces.position[[0, 2], :, 2]).all()
        and np.isfinite(found.pieces.position[1]).all()
    )


def test_an_ensemble_over_the_number_of_pieces_is_gone_on_with_and_described(counted, tmp_path):
    whole = run_files.load_run(counted)
    half = tmp_path / "half.h5"
    dem_jax.ensemble(
        balls(run__duration=0.01), seed=SEEDS, parameters={"portion.count": COUNTS}, out=half
    )
    gone_on = dem_jax.resume(half, duration=0.02)
    np.testing.assert_array_equal(gone_on.force["plate"], whole.force["plate"])
    lines = summarize_run(whole)
    assert "portion.count: 2 to 3 (2 values)" in lines and any(
        line.startswith("3 runs of 2 to 3 pieces") for line in lines
    )
    weights = portion_weights(whole)
    each = [portion_weights(whole.member(k))[0] for k in range(3)]
    assert weights == pytest.approx(each, rel=1e-12) and weights[0] < weights[1] > weights[2]
    said = f"2 to 3 pieces, {1e3 * weights.min():.4g} to {1e3 * weights.max():.4g} g"
    assert ("in the runs", said) in collect_facts(whole)["Product"]
    assert [target.pieces for target in targets.read(counted)] == COUNTS
    with h5py.File(counted, "a") as file:
        file.attrs["info"] = file.attrs["info"].replace("[2, 3, 2]", "[2, 4, 2]")
    with pytest.raises(
        RecordError, match="piece_counts of its attribute info; allowed: 3 numbers of at most 3"
    ):
        run_files.load_run(counted)


def test_room_is_made_for_the_shapes_of_the_run_with_most():
    """Hulls of pieces that differ in size have rows in a table: as many in each run, so that one
    program serves all.
    """
    scene = dem_jax.load_scene(
        "weigh-bucket", {"product": "almond", "portion.piece_weight_spread": 0.1}
    )
    scenes, reuse = (
        parameter_sweep.build_run_scenes(scene, {"portion.count": [3, 5]}, 2),
        assembly.AssemblyCache(),
    )
    room = find_ensemble_capacity(scenes, reuse)
    built = [assembly.assemble_system(each, 0, None, reuse, room) for each in scenes]
    assert parameter_sweep.program_signature(built[0]) == parameter_sweep.program_signature(
        built[1]
    )
    assert (
        [int(each.system.present.sum()) for each in built]
        == [3, 5]
        == [len(each.piece_set.shapes) for each in built]
    )
    by_weight = parameter_sweep.build_run_scenes(scene, {"portion.target_weight": [0.005, 0.02]}, 2)
    assert (
        find_ensemble_capacity(by_weight, reuse).pieces
        == len(build_piece_set(by_weight[1]).shapes)
        > len(build_piece_set(by_weight[0]).shapes)
    )
    assert find_ensemble_capacity(scenes[:1] * 2, reuse) is None


def test_poses_of_runs_whose_pieces_have_other_body_frames_are_each_in_their_own():
    random = np.random.default_rng(2)
    poses = random.standard_normal((2, 4, 13, 3))
    frames = random.standard_normal((2, 3, 4))
    frames /= np.linalg.norm(frames, axis=-1, keepdims=True)
    both = series.frames_from_poses(poses, frames, np.arange(4.0))
    for k in range(2):
        alone = series.frames_from_poses(poses[k], frames[k], np.arange(4.0))
        for name in ("position", "orientation", "velocity", "angular_velocity"):
            np.testing.assert_array_equal(both[name][k], alone[name])


def test_pieces_that_come_and_go_are_not_filled_up():
    scene = dem_jax.load_scene("weigh-bucket", {"portion.count": 3, "outlet": {}})
    assert (
        find_ensemble_capacity(
            [scene, scene.replace({"portion.count": 4})], assembly.AssemblyCache()
        )
        is None
    )


def test_uncertain_numbers_are_drawn_for_each_run_of_one_program():
    """Between their ends; keys that are given are not drawn, and each run is that of its own scene."""
    ranges = {
        "material.restitution": (0.2, 0.6),
        "material.friction_wall": (0.1, 0.3),
        "material.friction_piece": (0.1, 0.2),
    }
    scene = balls(uncertain=[{"key": key, "range": list(ends)} for key, ends in ranges.items()])
    programs.EXECUTABLES.clear()
    found = dem_jax.ensemble(
        scene, seed=SEEDS, parameters={"material.friction_piece": [0.3] * 3}, uncertain=True
    )
    assert (
        len(programs.EXECUTABLES) == 1
        and found.parameters["material.friction_piece"].tolist() == [0.3] * 3
    )
    for key in ("material.restitution", "material.friction_wall"):
        low, high = ranges[key]
        assert (
            len({*found.parameters[key]}) == 3
            and (low < found.parameters[key]).all()
            and (found.parameters[key] < high).all()
        )
    alone = dem_jax.simulate(
        scene.replace({key: values[1] for key, values in found.parameters.items()}), seed=SEEDS[1]
    )
    np.testing.assert_array_equal(found.member(1).force["plate"], alone.force["plate"])
    assert (
        summarize_run(found)[-1]
        == "2 unknown numbers: their shares of the scatter need at least 9 runs that come to rest"
    )
    with pytest.raises(SceneError, match=r"uncertain = \[\]: no number of the scene has a range"):
        dem_jax.ensemble(balls(), runs=2, uncertain=True)


def test_what_is_alike_is_built_once(monkeypatch):
    built, build_one = [], job_setup.assemble_scene
    monkeypatch.setattr(
        job_setup, "assemble_scene", lambda *arguments: built.append(1) or build_one(*arguments)
    )
    job_setup.prepare_job(balls(), range(20), 20)
    assert len(built) == 1
    job_setup.prepare_job(balls(), SEEDS, 3, parameters=PARAMETERS)
    assert len(built) == 1 + 2


def test_the_file_knows_the_parameters_and_is_gone_on_with_bit_for_bit(three, tmp_path):
    whole, path = three
    kept = run_files.load_run(path)
    assert kept.parameters.keys() == PARAMETERS.keys()
    for key, values in PARAMETERS.items():
        np.testing.assert_array_equal(kept.parameters[key], values)
    half = tmp_path / "half.h5"
    dem_jax.ensemble(balls(run__duration=0.01), seed=SEEDS, parameters=PARAMETERS, out=half)
    gone_on = dem_jax.resume(half, duration=0.02)
    for run in (kept, gone_on):
        np.testing.assert_array_equal(run.force["plate"], whole.force["plate"])


def test_runs_that_differ_are_stepped_together_as_on_a_gpu(three, monkeypatch):
    whole, _ = three
    monkeypatch.setattr(executors, "run_threaded", executors.run_on_devices)
    together = dem_jax.ensemble(balls(), seed=SEEDS, parameters=PARAMETERS)
    scale = np.abs(whole.mean_force["plate"]).max()
    np.testing.assert_allclose(
        together.mean_force["plate"], whole.mean_force["plate"], atol=1e-6 * scale, rtol=0
    )
    assert np.ptp(np.abs(together.force["plate"]).max(axis=(1, 2))) > 0.01 * scale, (
        "the runs differ"
    )


def test_distributions_are_drawn_from_with_the_seed():
    spread = {"material.friction_wall": stats.uniform(0.1, 0.4)}
    one, again, other = (
        dem_jax.ensemble(balls(), 3, seed, parameters=spread).parameters for seed in (4, 4, 5)
    )
    (key,) = spread
    np.testing.assert_array_equal(one[key], again[key])
    assert (
        len(set(one[key])) == 3
        and not set(one[key]) & set(other[key])
        and np.all((one[key] > 0.1) & (one[key] < 0.5))
    )


def test_the_run_that_fails_is_named_with_its_parameters():
    thrown = {
        "material.restitution": [0.3, 0.4],
        "piece.0.velocity": [[0.0, 0.0, -1.0], [0.0, 0.0, 500.0]],
    }
    listed = [{"shape": "sphere", "radius": 0.01, "position": [x, 0.0, 0.05]} for x in (0.0, 0.03)]
    scene = dem_jax.load_scene("plate-drop", BALLS | {"portion": None, "piece": listed})
    said = r"run 1 \(seed 1, material.restitution = 0.4, piece.0.velocity = .*left the domain"
    with pytest.raises(SimulationError, match=said) as e:
        dem_jax.ensemble(scene, parameters=thrown)
    assert e.value.member == 1


@pytest.mark.parametrize(
    ("parameters", "more", "said"),
    [
        (
            {"contact.law": ["walton-braun", "linear-dashpot"]},
            {},
            r'run 1 \(contact.law = "linear-dashpot"\) needs another program than run 0, by .*allowed',
        ),
        (
            {"run.sample_interval": [2e-5, 3e-5]},
            {},
            "run.sample_interval: allowed: run.time_step, and keys that are not of run",
        ),
        ({"wall.0.stl": ["a.stl", "b.stl"]}, {}, "wall.0.stl: allowed: keys that name no file"),
        (
            {"material.restitution": [0.1, 0.2], "drop.height": [0.1]},
            {},
            "drop.height has 1 values; allowed: 2",
        ),
        ({"material.restitution": [0.1, 2.0]}, {}, "material.restitution = 2"),
        (
            {"material.restitution": [0.1, 0.2]},
            {"seed": [1, 2, 3]},
            "material.restitution has 2 values; allowed: 3",
        ),
        ({}, {"seed": [1, 2, 3], "runs": 2}, "seed: 3 of them; allowed: one, or one for each of 2"),
        ({}, {"seed": []}, "seed: 0 of them"),
    ],
)
def test_what_cannot_be_one_ensemble_is_said(parameters, more, said):
    with pytest.raises(SceneError, match=said):
        dem_jax.ensemble(balls(), parameters=parameters, **more)


def test_a_file_has_room_for_the_seeds_of_many_runs(three, tmp_path):
    """HDF5 before 1.8 has 64 kB for an attribute."""
    _, path = three
    header, *_ = run_files.load_restart(path)
    many = dataclasses.replace(header, seed=tuple(range(20_000)), run_count=20_000)
    run_files.Writer.create(tmp_path / "many.h5", many).close()
    assert run_files.load_restart(tmp_path / "many.h5")[0].seed == many.seed


CHANGES = {  # of each section of a scene: keys that change arrays, places, numbers of pieces or the
# program
    "weigh-bucket": [
        {"material.restitution": 0.3}, {"material.density": 310.0}, {"material.numerical_softening": 0.02}, {"material.friction_wall": 0.0},
        {"material.stiffness_length": "width"}, {"material.pull_off": 0.01}, {"material.wall_youngs_modulus": 1e9},
        {"drop.height": 0.25}, {"weigh_bucket.flap_angle_deg": 50.0}, {"weigh_bucket.load_cell": {}},
        {"feed_bucket.opening_time": 0.1},
        {"portion.scale_factor": 0.9}, {"portion.count": 3}, {"portion.size_spread": 0.1}, {"portion.piece_weight": 5e-3},
        {"portion.arrangement": "scattered"}, {"portion.settling_time": 0.3}, {"run.gravity": [0.0, 1.0, -9.0]}, {"run.time_step": 3e-6},
        {"run.precision": "f64"}, {"run.sample_interval": 6e-5}, {"contact.law": "linear-dashpot"}, {"run.domain_low": [-2.0, -2.0, -2.0]},
    ],
    "weighing-cycles": [{"material.restitution": 0.3}, {"inlet.interval": 0.06}, {"feeder.frequency": 40.0}, {"portion.count": 5}],
    "plate-drop": [
        {"piece.0.position": [0.0, 0.01, 0.1]}, {"piece.0.shape": "cuboid", "piece.0.size": [0.02, 0.02, 0.03]},
        {"wall.0.thickness": 0.02},
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_what_is_built_after_another_scene_is_what_is_built_alone(name):
    """After the stock scene, and before it again: no step of building is shared whose inputs
    differ.
    """
    base, reuse = assembly.inline_files(load_scene(name)), assembly.AssemblyCache()
    own = assembly.assemble_system(base)
    for change in CHANGES[name]:
        scene = base.replace(change)
        alone = assembly.assemble_system(scene)
        for found, wanted in (
            (assembly.assemble_system(base, reuse=reuse), own),
            (assembly.assemble_system(scene, reuse=reuse), alone),
        ):
            assert (
                found.step == wanted.step
                and found.samples == wanted.samples
                and found.numbers == wanted.numbers
            ), change
            assert parameter_sweep.program_signature(found) == parameter_sweep.program_signature(
                wanted
            ), change
            trees = ((found.system, wanted.system), (found.state, wanted.state))
            for one, other in (
                pair for tree in trees for pair in zip(*map(jax.tree.leaves, tree), strict=True)
            ):
                np.testing.assert_array_equal(one, other, err_msg=str(change))


def test_runs_that_differ_in_their_material_share_most_of_their_building(monkeypatch):
    """Shapes, walls, hulls and the first state are made once for a hundred values, not for each."""
    in_system = [
        f"system.{name}"
        for name in (
            "lay_out_walls",
            "build_panel_arrays",
            "_build_hulls",
            "build_initial_state",
            "place_pieces",
        )
    ]
    made = dict.fromkeys(
        ("piece_arrays.build_piece_set", *in_system), 0
    )  # the first also where the room of all
    # runs is found

    def counted(name, function):
        def call(*arguments):
            made[name] += 1
            return function(*arguments)

        return call

    for name in made:
        monkeypatch.setattr(
            f"dem_jax.assembly.{name}", counted(name, operator.attrgetter(name)(assembly))
        )
    scene = load_scene("weigh-bucket", {"run.frame_interval": 0.0})
    job = job_setup.prepare_job(
        scene,
        [0] * 100,
        100,
        parameters={"material.restitution": np.linspace(0.1, 0.5, 100).tolist()},
    )
    assert job.sweep.leaves and made.pop("system.place_pieces") == 1 + 100, (
        "once, and for the seed of each run"
    )
    assert set(made.values()) == {1}, made


def test_runs_that_differ_in_material_alone_share_all_other_arrays():
    """No hull, wall or place is computed again for another density or restitution."""
    scene, reuse = load_scene("weigh-bucket", {"portion.count": 3}), assembly.AssemblyCache()
    changes = (
        {},
        {"material.density": 400.0},
        {"material.density": 400.0, "material.restitution": 0.3},
    )
    first, heavy, lively = (
        assembly.assemble_system(scene.replace(change), 0, reuse=reuse).system for change in changes
    )
    assert heavy.hulls is first.hulls and heavy.walls is first.walls and heavy.parts is first.parts
    # single precision
    np.testing.assert_allclose(heavy.pieces.mass, first.pieces.mass * 4 / 3, rtol=1e-6)
    assert heavy.pieces.width is first.pieces.width and heavy.materials is first.materials
    assert (
        lively.pieces is heavy.pieces
        and lively.materials.youngs_modulus is heavy.materials.youngs_modulus
    )
    np.testing.assert_allclose(lively.materials.restitution, 0.3, rtol=1e-6)
