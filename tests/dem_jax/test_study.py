"""Studies: every drop is the run of its own scene, nothing is computed twice, and what is said
follows from the drops.
"""

from html import escape
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.special import erf

import dem_jax
from dem_jax.cli.main import main
from dem_jax.errors import RecordError, SceneError
from dem_jax.runner import job, loop
from dem_jax.study import analysis, batches, results_file, reweighting, study_runner
from dem_jax.study.config import load_study, stock_studies, validate_study
from dem_jax.study.design import list_points
from dem_jax.study.outputs import OUTPUTS, OutputTraces, evaluate_outputs, select_drop_outputs

BALL = {  # a heavier and a lighter fall of one ball onto a plate, at three restitutions
    "name": "ball", "title": "A ball on a plate", "scene": "plate-drop", "seeds": 2, "traces": True,
    "set": {
        "portion": {
            "shape": "sphere", "radius": 0.01, "count": 1, "arrangement": "scattered",
            "region_low": [-0.05, -0.05, 0.0], "region_high": [0.05, 0.05, 0.06],
        },
        "piece": [], "run.precision": "f64", "run.duration": 0.08, "run.sample_interval": 1e-4, "run.frame_interval": 0.0,
        "run.track_energy": False,
    },
    "parameter": {"material.numerical_softening": {"low": 0.01, "high": 0.1, "log": True}, "material.restitution": {"values": [0.3, 0.6]}},
    "points": 2, "outputs": [
        "peak", "peak_1ms", "time_of_peak", "peak_duration", "impact_time", "first_at_rest", "time_to_rest", "time_to_weigh",
        "settled", "step", "pieces",
    ],
}  # fmt: skip


def ball(**changes):
    return validate_study(BALL | changes, "ball.toml")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "ball.h5"
    return study_runner.run_study(ball(), path), path


def test_a_grid_takes_each_value_with_each(done):
    found, _ = done
    assert list_points(found.study) == [
        {"material.numerical_softening": a, "material.restitution": b}
        for a in (0.01, 0.1)
        for b in (0.3, 0.6)
    ]
    assert found.state.tolist() == [results_file.DONE] * 8


def test_every_drop_is_the_run_of_its_own_scene(done):
    found, _ = done
    for member in (1, 6):
        scene = found.study.base_scene().replace(list_points(found.study)[member // 2])
        alone = dem_jax.simulate(scene, seed=member % 2)
        for name in select_drop_outputs(found.study.outputs):
            np.testing.assert_array_equal(
                found.outputs[name][member], evaluate_outputs(alone, (name,))[name][0], err_msg=name
            )
        np.testing.assert_array_equal(found.force[member], alone.pif_kg("plate").astype(np.float32))
    assert np.ptp(found.outputs["peak"]) > 0.05


def test_a_file_that_varies_is_read_for_each_point():
    square = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
    for name, height in (("near.stl", 0.0), ("far.stl", -0.02)):
        trimesh.Trimesh(square + [0.0, 0.0, height], [[0, 1, 2], [0, 2, 3]]).export(name)
    changes = BALL["set"] | {"wall": [{"group": "plate", "stl": "near.stl"}]}
    files = {"wall.0.stl": {"values": ["near.stl", "far.stl"]}}
    found = study_runner.run_study(
        ball(set=changes, parameter=files, seeds=1, points=1, outputs=["peak", "time_of_peak"])
    )
    assert found.state.tolist() == [results_file.DONE] * 2
    near, far = found.outputs["time_of_peak"]
    assert far > near + 1e-3
    for member, scene in enumerate(
        found.study.base_scene().replace(point) for point in list_points(found.study)
    ):
        np.testing.assert_array_equal(
            found.force[member], dem_jax.simulate(scene).pif_kg("plate").astype(np.float32)
        )


def test_a_second_burst_is_told_from_ripples():
    time, sigma = 1e-4 * np.arange(1, 1001), 5e-3
    bursts = lambda *rows: sum(h * np.exp(-0.5 * ((time - t) / sigma) ** 2) for h, t in rows)
    force = np.array(
        [bursts((4.0, 0.03), (2.0, 0.06)), bursts((4.0, 0.03), (0.6, 0.06)), bursts((3.0, 0.04))]
    )
    force = force * (1 + 0.05 * np.sin(2 * np.pi * time / 2.5e-3))
    made = OutputTraces(SimpleNamespace(sample=1e-4), time, force, force, np.zeros_like(force))
    height, later = (OUTPUTS[name].evaluate(made) for name in ("second_peak", "second_peak_after"))
    # of a mean over 5 ms at the top of a burst
    flat = np.sqrt(2 * np.pi) * sigma / 5e-3 * erf(0.5 * 5e-3 / (np.sqrt(2) * sigma))
    assert height[0] == pytest.approx(2 * flat, rel=0.02)
    assert later[0] == pytest.approx(30, abs=0.5)
    assert np.isnan([*height[1:], *later[1:]]).all()


def test_a_study_that_was_stopped_does_only_what_is_left_and_ends_with_the_same_bits(
    done, tmp_path, monkeypatch
):
    whole, _ = done
    monkeypatch.setattr(batches, "BATCH_SIZE", 2)
    real, computed = batches.run_batch, []

    def stopped_after_two(batch, *more):
        if len(computed) == 2:
            raise KeyboardInterrupt
        computed.append(batch.members)
        return real(batch, *more)

    monkeypatch.setattr(batches, "run_batch", stopped_after_two)
    with pytest.raises(KeyboardInterrupt):
        study_runner.run_study(ball(), "half.h5")
    assert (results_file.load_results("half.h5").state == results_file.DONE).sum() == 4
    monkeypatch.setattr(
        batches,
        "run_batch",
        lambda batch, *more: computed.append(batch.members) or real(batch, *more),
    )
    found = study_runner.run_study(ball(), "half.h5")
    assert sorted(m for members in computed for m in members) == list(range(8))
    for name, values in whole.outputs.items():
        np.testing.assert_array_equal(found.outputs[name], values)
    np.testing.assert_array_equal(results_file.load_results("half.h5").force[5], whole.force[5])


def test_a_batch_that_takes_long_is_gone_on_with_where_it_was(done, monkeypatch, capsys):
    whole, _ = done
    monkeypatch.setattr(batches, "LONG_BATCH_TIME", 0.0)
    monkeypatch.setattr(job, "CHUNK_TIME", 0.005)
    real, begun = loop.compute_chunk, []

    def stopped(*arguments):
        if len(begun) == 3:
            raise KeyboardInterrupt
        begun.append(arguments[3])
        return real(*arguments)

    monkeypatch.setattr(loop, "compute_chunk", stopped)
    with pytest.raises(KeyboardInterrupt):
        study_runner.run_study(ball(), "long.h5")
    begun_with = results_file.load_results("long.h5")
    assert not (begun_with.state == results_file.DONE).any() and begun_with.elapsed > 0
    assert dem_jax.load_run("long.h5.batch").force["plate"].shape[0] == 8
    monkeypatch.setattr(
        loop, "compute_chunk", lambda *arguments: begun.append(arguments[3]) or real(*arguments)
    )
    found = study_runner.run_study(ball(), "long.h5", progress=True)
    said = capsys.readouterr().err
    assert "running: 100%" in said and "\x1b" not in said, "a log has no lines to go up to"
    assert found.elapsed > begun_with.elapsed
    assert len(begun) > 5 and begun == sorted(set(begun)), "no sample is computed twice"
    for name, values in whole.outputs.items():
        np.testing.assert_array_equal(found.outputs[name], values)
    assert [path.name for path in Path().glob("long*")] == ["long.h5"]


def test_a_file_of_another_batch_is_not_gone_on_with(done, monkeypatch):
    whole, _ = done
    monkeypatch.setattr(batches, "LONG_BATCH_TIME", 0.0)
    dem_jax.ensemble(ball().base_scene(), seed=[5, 6], out="other.h5.batch")
    found = study_runner.run_study(ball(), "other.h5")
    for name, values in whole.outputs.items():
        np.testing.assert_array_equal(found.outputs[name], values)


def test_another_study_in_the_file_is_not_touched(done):
    _, path = done
    before = path.read_bytes()
    with pytest.raises(
        RecordError, match="holds another study .ball.; allowed: another name, or overwrite"
    ):
        study_runner.run_study(ball(seeds=3), path)
    assert path.read_bytes() == before


def test_drops_that_go_wrong_are_lost_and_said_and_the_others_stand(done):
    whole, _ = done
    # the second box is too narrow
    thrown = {"portion.region_high": {"values": [[0.05, 0.05, 0.06], [-0.04, 0.05, 0.06]]}}
    found = study_runner.run_study(ball(parameter=thrown, seeds=1))
    assert found.state.tolist() == [results_file.DONE, results_file.LOST]
    (why,) = found.failure_reasons.values()
    assert "region" in why or "room" in why
    assert any("1 of the drops went wrong" in line for line in analysis.describe_results(found))


def test_a_drop_that_fails_leaves_the_rest_of_its_batch():
    """A run of the three is thrown out of the domain."""
    listed = {"piece": [{"shape": "sphere", "radius": 0.01, "position": [0.0, 0.0, 0.05]}]}
    rows = {
        "piece.0.velocity": {"values": [[0.0, 0.0, -1.0], [0.0, 0.0, 3000.0], [0.0, 0.0, -2.0]]}
    }
    base = (
        {key: value for key, value in BALL["set"].items() if key != "portion"}
        | listed
        | {"portion": None}
    )
    table = {key: value for key, value in BALL.items()} | {
        "set": base,
        "parameter": rows,
        "seeds": 1,
        "traces": False,
    }
    found = study_runner.run_study(validate_study(table, "x.toml"))
    assert (
        found.state.tolist() == [results_file.DONE, results_file.LOST, results_file.DONE]
        and "left the domain" in found.failure_reasons[1]
    )
    assert found.outputs["peak"][0] < found.outputs["peak"][2]


def test_the_power_law_of_a_linear_spring_is_found():
    """A sphere on a linear spring: peak over the square root of its stiffness (VALIDATION, section
    2).
    """
    one = {"material.numerical_softening": {"low": 0.01, "high": 1.0, "log": True}}
    thrown = {
        "shape": "sphere",
        "radius": 0.01,
        "position": [0.0, 0.0, 0.02],
        "velocity": [0.0, 0.0, -1.0],
    }
    short = {"run.gravity": [0.0, 0.0, 0.0], "run.sample_interval": 1e-5, "run.duration": 0.03}
    changes = BALL["set"] | {"portion": None, "piece": [thrown]} | short
    found = study_runner.run_study(
        ball(
            parameter=one,
            points=5,
            seeds=1,
            set=changes,
            outputs=["peak_every_step", "step"],
            traces=False,
        )
    )
    powers = {name: (p, half) for name, _, p, half in analysis.fit_power_laws(found)}
    assert powers["peak_every_step"][0] == pytest.approx(0.5, abs=1e-3)
    assert powers["step"][0] == pytest.approx(-0.5, abs=0.06)


def test_designs_that_are_drawn_fill_their_ranges():
    ranges = {
        "material.numerical_softening": {"low": 0.01, "high": 1.0, "log": True},
        "material.restitution": {"low": 0.1, "high": 0.9},
    }
    for design in ("latin-hypercube", "sobol"):
        points = list_points(ball(parameter=ranges, design=design, points=16))
        softening, restitution = (np.array([p[key] for p in points]) for key in ranges)
        assert len(points) == 16 and points == list_points(
            ball(parameter=ranges, design=design, points=16)
        )
        for u in (np.log10(softening) / 2 + 1, (restitution - 0.1) / 0.8):
            assert np.histogram(u, 4, (0, 1))[0].tolist() == [4, 4, 4, 4]


def test_influences_are_those_of_a_known_function():
    """y = 3 a + b: a has nine tenths of the variance."""
    ranges = {
        "drop.height": {"low": 0.0, "high": 1.0},
        "material.restitution": {"low": 0.0, "high": 1.0},
    }
    study = ball(
        parameter=ranges, design="sobol", points=256, seeds=1, outputs=["peak"], traces=False
    )
    found = results_file.StudyResults.create_empty(study)
    a, b = (np.array([p[key] for p in list_points(study)]) for key in ranges)
    found.outputs["peak"][:], found.state[:] = 3 * a + b, results_file.DONE
    shares = {i.parameter: i.value for i in analysis.find_influences(found) if i.is_share}
    # of 256 points of the ranges
    assert shares == pytest.approx({"drop.height": 0.9, "material.restitution": 0.1}, abs=1e-3)


def test_few_points_have_correlations_of_ranks():
    """y rises with a, and b is nothing to it."""
    ranges = {
        "drop.height": {"low": 0.0, "high": 1.0},
        "material.restitution": {"low": 0.0, "high": 1.0},
    }
    found = results_file.StudyResults.create_empty(
        ball(parameter=ranges, design="sobol", points=32, seeds=1, outputs=["peak"], traces=False)
    )
    found.outputs["peak"][:], found.state[:] = (
        [np.exp(p["drop.height"]) for p in list_points(found.study)],
        results_file.DONE,
    )
    a, b = analysis.find_influences(found)
    assert a.value == pytest.approx(1.0) and a.low > 0.99 and not a.is_share
    assert b.low < 0 < b.high
    assert (
        "peak, correlation of ranks: drop.height 1.00 (1.00 to 1.00), material.restitution"
        in "\n".join(analysis.describe_results(found))
    )


def test_a_reference_is_within_or_a_contradiction(done):
    found, _ = done
    rows = [
        {"output": name, "low": low, "high": low, "source": "theirs"}
        for name, low in (("pieces", 1.0), ("peak", 90.0))
    ]
    study = ball(reference=rows)
    verdicts = [
        row.verdict
        for row in analysis.compare_references(
            results_file.StudyResults(study, found.state, found.outputs)
        )
    ]
    assert verdicts == ["our median is within theirs", "contradiction"]


def test_numbers_of_pieces_are_those_of_table_2_and_need_no_drop(monkeypatch):
    monkeypatch.setattr(batches, "run_batch", None)  # nothing falls
    table = load_study("piece-count").model_dump(exclude_none=True)
    sizes = {"portion.scale_factor": {"values": [0.3, 0.7, 1.0]}}  # not all: each is built, to see
    # what goes together
    reference = [
        row for row in table["reference"] if row["at"]["portion.scale_factor"] in (0.3, 0.7, 1.0)
    ]
    found = study_runner.run_study(
        validate_study(table | {"parameter": sizes, "reference": reference}, "piece-count")
    )
    np.testing.assert_array_equal(found.outputs["pieces"], [37, 3, 1])  # 1 / SF^3, rounded (eq. 16)
    # eq. 23
    np.testing.assert_allclose(
        found.outputs["piece_weight"], 5.832 * np.array([0.3, 0.7, 1.0]) ** 3, rtol=1e-12
    )
    np.testing.assert_allclose(
        found.outputs["portion_weight"],
        found.outputs["pieces"] * found.outputs["piece_weight"],
        rtol=1e-12,
    )


def test_notes_of_runs_are_those_of_the_study(tmp_path):
    """Balls that are released while they still fall, in one batch for each diameter."""
    changes = BALL["set"] | {
        "portion.arrangement": "settled", "portion.settling_time": 0.03, "run.duration": 0.01,
        "portion.region_high": [0.05, 0.05, 0.3], "portion.region_low": [-0.05, -0.05, 0.2],
    }  # fmt: skip
    table = ball(set=changes, parameter={"portion.count": {"values": [1, 2]}}, seeds=2)
    found = study_runner.run_study(table, tmp_path / "s.h5")
    assert found.notes and all("do not rest in the feed bucket yet" in n for n in found.notes)
    assert results_file.load_results(tmp_path / "s.h5").notes == found.notes
    said = analysis.describe_results(found)
    assert [line for line in said if line.startswith("note: ")] == [
        f"note: {n}" for n in found.notes
    ]


@pytest.mark.parametrize("longest, until_settled", [(0.1, False), (0.6, True)])
def test_a_heap_is_the_same_whatever_it_is_released_into(longest, until_settled):
    """Balls that settle at restitution 0.1 and start from there with all others; also if they are
    at rest before the time for it is over.
    """
    base = BALL["set"] | {
        "portion.arrangement": "settled",
        "portion.settling_time": longest,
        "portion.region_high": [0.05, 0.05, 0.03],
        "run.until_settled": until_settled,
    }
    base |= {"run.frame_interval": 1e-3, "run.duration": 0.01}
    table = ball(
        set=base,
        heap={"material.restitution": 0.1},
        parameter={"material.restitution": {"values": [0.1, 0.7]}},
        seeds=1,
    )
    (batch,) = batches.list_batches(table)
    run, members, failed = batches.run_batch(batch, table)
    assert members == (0, 1) and not failed
    first = run.pieces.position[:, 0]
    np.testing.assert_array_equal(first[0], first[1])
    own = dem_jax.simulate(table.base_scene().replace({"material.restitution": 0.1}))
    np.testing.assert_array_equal(own.pieces.position, run.pieces.position[0])


def known(name, of, reference, noise=0.1, **changes):
    """A study of 256 points in the unit square whose output ``of`` (a, b) is known but for noise."""
    ranges = {
        "drop.height": {"low": 0.0, "high": 1.0},
        "material.restitution": {"low": 0.0, "high": 1.0},
    }
    rows = [
        {"output": "peak", "low": reference - 0.02, "high": reference + 0.02, "source": "theirs"}
    ]
    study = ball(
        name=name,
        parameter=ranges,
        design="sobol",
        points=256,
        seeds=8,
        outputs=["peak"],
        traces=False,
        reference=rows,
        **changes,
    )
    found = results_file.StudyResults.create_empty(study)
    a, b = (np.repeat([p[key] for p in list_points(study)], 8) for key in ranges)
    found.outputs["peak"][:] = of(a, b) + noise * np.random.default_rng(1).normal(size=len(a))
    found.state[:] = results_file.DONE
    return found


def test_what_is_likely_of_parameters_is_where_the_number_comes_from():
    """y = a + 0.1 noise is 0.3: a normal of 0.3 and 0.1, to the width of the reference, and nothing
    of b.
    """
    found = known("one", lambda a, b: a, 0.3)
    a, b = reweighting.compute_marginals([found], reweighting.compute_weights([found]))
    wide = np.hypot(0.1, 0.02) * 1.645
    np.testing.assert_allclose(a.posterior, [0.3 - wide, 0.3, 0.3 + wide], atol=0.035)
    np.testing.assert_allclose(b.posterior, b.prior, atol=0.1)


def test_studies_of_the_same_points_say_more_together():
    """a = 0.3 from one, a + b = 1 from the other: b is 0.7."""
    both = [known("one", lambda a, b: a, 0.3, 0.05), known("two", lambda a, b: a + b, 1.0, 0.05)]
    weights = reweighting.compute_weights(both)
    _, b = reweighting.compute_marginals(both, weights)
    assert b.posterior[1] == pytest.approx(0.7, abs=0.04) and b.posterior[2] - b.posterior[0] < 0.35
    assert effective_of_each(both) > reweighting.effective_sample_size(weights) > 2
    assert "drop.height: 0.3" in "\n".join(reweighting.describe_posterior(both))


def effective_of_each(studies):
    return min(
        reweighting.effective_sample_size(reweighting.compute_weights([one])) for one in studies
    )


def test_a_number_that_no_point_gives_is_a_contradiction():
    found = known("one", lambda a, b: a, 5.0)
    assert "contradicts all points" in reweighting.describe_posterior([found])[-1]


def test_what_cannot_be_weighed_together_is_said():
    one = known("one", lambda a, b: a, 0.3)
    with pytest.raises(SceneError, match="two: other points than one; allowed"):
        reweighting.compute_weights([one, known("two", lambda a, b: a, 0.3, design_seed=1)])
    with pytest.raises(SceneError, match="ball: no reference to weigh points by"):
        reweighting.compute_weights([results_file.StudyResults.create_empty(ball())])


@pytest.mark.parametrize("name", stock_studies())
@pytest.mark.parametrize("quick", [False, True])
def test_stock_studies_are_sound(name, quick):
    study = load_study(name, quick)
    base = study.base_scene()
    for point in list_points(study):
        base.replace(point)
    assert not quick or len(list_points(study)) * study.seeds <= 16


def test_every_output_has_a_unit_and_words():
    assert all(
        output.words and output.unit in ("", "kg", "g", "ms", "us") for output in OUTPUTS.values()
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"outputs": ["weight"]}, "'weight': no such output; allowed: peak"),
        ({"seedz": 3}, "seedz = 3: unknown key; did you mean 'seed"),
        ({"parameter": {"drop.height": {"low": 1.0}}}, "allowed: values, or both low and high"),
        ({"parameter": {"drop.height": {"low": 2.0, "high": 1.0}}}, "allowed: low < high"),
        (
            {"compare": {"drop.height": 1.0}},
            "'drop.height' in compare or reference.at: allowed: a parameter",
        ),
        ({"design": "random"}, 'design = "random": allowed'),
    ],
)
def test_what_cannot_be_a_study_is_said_in_one_line(changes, said):
    with pytest.raises(SceneError, match=said):
        ball(**changes)


def test_a_study_is_made_of_another_scene(capsys):
    main(["study", "piece-count", "--scene", "quick-release", "--no-plot", "--quiet"])
    found = results_file.load_results("piece-count-quick-release.h5")
    assert found.study.base_scene().feed_bucket == dem_jax.load_scene("quick-release").feed_bucket
    with open("flat.toml", "w") as mine:
        mine.write('base = "quick-release"\n[portion]\npiece_weight = 0.01\n')
    main(["study", "piece-count", "--scene", "flat.toml", "--no-plot", "--quiet"])
    assert (
        results_file.load_results("piece-count-flat.h5").study.base_scene().portion.piece_weight
        == 0.01
    )
    assert main(["study", "piece-count", "--scene", "nowhere", "--quiet"]) == 2
    assert "scene 'nowhere': no such file, nor one of the stock scenes" in capsys.readouterr().err


def test_the_command_lists_studies_and_says_what_it_does_not_know(capsys):
    assert main(["study"]) == 0
    assert "softening" in capsys.readouterr().out
    assert main(["study", "nowhere", "--quiet"]) == 2
    assert "no such file, nor one of the stock studies (" in capsys.readouterr().err


def test_studies_are_conducted_one_after_the_other(capsys):
    for name in "abc":
        Path(f"{name}.toml").write_text(
            f'title = "Of {name}"\nscene = "weigh-bucket"\nseeds = 1\noutputs = ["pieces"]\n'
        )
    assert main(["study", "a.toml", "b.toml", "--no-plot", "--quiet"]) == 0
    said = capsys.readouterr().out
    assert (
        said.index("Of a")
        < said.index("wrote a.h5, a.csv")
        < said.index("Of b")
        < said.index("wrote b.h5, b.csv")
    )
    assert (
        said.splitlines()[-1]
        == f"2 studies, {sum(results_file.load_results(f'{name}.h5').elapsed for name in 'ab'):.0f} s"
    )
    # seen before the first is begun
    assert main(["study", "c.toml", "nowhere", "--quiet"]) == 2 and not Path("c.h5").exists()
    assert main(["study", "c.toml", "./c.toml", "--quiet"]) == 2 and not Path("c.h5").exists()
    assert (
        "study c.toml ./c.toml: 'c' twice, in one file; allowed: each name once"
        in capsys.readouterr().err
    )
    assert main(["study", "all", "--out", "x.h5"]) == 2
    assert (
        f"--out x.h5: {len(stock_studies())} studies; allowed: of one by itself"
        in capsys.readouterr().err
    )


def test_the_table_and_the_figure_are_made(done, tmp_path):
    from dem_jax.study.study_figure import plot_study

    found, _ = done
    said = "\n".join(analysis.describe_results(found))
    assert (
        "A ball on a plate" in said
        and "two independent drops, material.numerical_softening = 0.01" in said
    )
    ends = (
        "1 MPa (material.numerical_softening = 0.01) to 10 MPa (material.numerical_softening = 0.1)"
    )
    assert f"peaks are those of moduli E NSF of each point, from {ends}" in said
    rows = analysis.write_csv(found, tmp_path / "ball.csv").read_text().splitlines()
    assert len(rows) == 9 and rows[0].startswith(
        "material.numerical_softening,material.restitution,seed,peak (kg)"
    )
    assert float(rows[6].split(",")[3]) == pytest.approx(found.outputs["peak"][5], rel=1e-8)
    assert plot_study(found, tmp_path / "ball.png").stat().st_size > 10_000


def test_a_study_is_plotted_and_reported_from_its_file(done, capsys, monkeypatch):
    found, path = done
    monkeypatch.chdir(path.parent)
    monkeypatch.setattr(
        "dem_jax.study.study_figure.plot_study", lambda results, out: (results.study.name, str(out))
    )
    assert main(["report", path.name]) == 0 and main(["plot", path.name, "--out", "again.png"]) == 0
    assert capsys.readouterr().out.splitlines() == ["ball-report.html", "('ball', 'again.png')"]
    page = (path.parent / "ball-report.html").read_text()
    assert "default-src 'none'" in page and page.count("<tr>") == 5 and "A ball on a plate" in page
    assert all(escape(line) in page for line in analysis.list_findings(found))
    head, rows = analysis.tabulate_points(found)
    assert all(f"<td class=value>{escape(cell)}</td>" in page for row in rows for cell in row)
    assert main(["report", path.name, "other.h5"]) == 2
    assert "is a file of a study; allowed: a single file of a study" in capsys.readouterr().err
