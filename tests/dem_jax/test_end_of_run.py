"""What is said of runs that ended before all was at rest, of a load cell that swings, and of what a
peak rests on.
"""

from dataclasses import replace

import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.errors import SceneError
from dem_jax.scene import library, load_scene
from dem_jax.study import analysis
from dem_jax.study.config import validate_study
from dem_jax.study.outputs import evaluate_outputs
from dem_jax.study.results_file import DONE, StudyResults
from dem_jax.visualization.cell_oscillation import find_cell_oscillation
from dem_jax.visualization.metadata import find_peak_factors
from dem_jax.visualization.metrics import compute_metrics, format_metric
from dem_jax.visualization.report_page import NamedRun, compose_sheets
from dem_jax.visualization.run_figure import draw_run_figure
from dem_jax.visualization.summary import impact_duration, summarize_run
from dem_jax.visualization.table_export import numbers_table
from dem_jax.visualization.time_to_rest import find_rest
from tests.dem_jax.stored import PIECES, SCENE, G, stored

FOUR = SCENE.replace(piece=[{**PIECES[1], "position": [0.03 * k, 0.0, 0.1]} for k in range(4)])
BALL = 300 * 4 / 3 * np.pi * 0.01**3  # kg


def four(speeds, settled=1, cut=0.127):
    """Four balls, one after the other at rest from 0.1 s on, of which some move at these speeds
    (m/s) when the run ends.
    """
    run = stored(scene=FOUR, frames=0)
    keep = run.time <= cut
    cut_off = {
        name: {"plate": array["plate"][keep]}
        for name, array in run.series.items()
        if name != "settled_mass"
    }
    mass = settled * BALL * (run.time[keep] > 0.1)
    header = replace(
        run.header, piece_count=4, info={"moving": {"plate": sum(speed >= 0.1 for speed in speeds)}}
    )
    return replace(
        run, header=header, time=run.time[keep], series=cut_off | {"settled_mass": {"plate": mass}}
    )


def number(run, name):
    (found,) = [n for n in compute_metrics(run) if n.name == name]
    return found


def test_a_run_that_ended_too_early_has_no_time_to_rest():
    run = four([0.0, 0.5, 0.3, 0.2])
    bound = "> 106.9 ms: 3 of 4 pieces not at rest at the end"  # from 20.1 ms, the first sample
    # with a force, to 127 ms
    rest = find_rest(run, "plate", "plate")
    assert rest.moving_count.tolist() == [3] and np.isnan(rest.duration[0])
    assert np.isnan(impact_duration(run, "plate", "plate"))
    lines = summarize_run(run)
    assert f"duration of the impact: {bound}" in lines
    assert (
        "settled mass in plate at the end: 1.257 g; 3 of 4 pieces not at rest at the end" in lines
    )
    assert (
        format_metric(number(run, "time to rest")) == bound
        and number(run, "pieces not at rest at the end").median == 3
    )
    rows = {row[0]: row[2] for row in numbers_table(run).rows}
    assert rows["time to rest"] == bound and rows["pieces not at rest at the end"] == 3.0
    assert "3 of 4 pieces not at rest at the end" in draw_run_figure(run).get_suptitle()
    assert any(
        "3 of 4 pieces not at rest" in str(words)
        for sheet in compose_sheets([NamedRun("drop", run)])
        for words in sheet.words
    )


def test_a_run_that_ended_at_rest_has_one():
    run = four([0.0, 0.09, 0.0, 0.0], settled=4)
    assert impact_duration(run, "plate", "plate") == pytest.approx(0.08, abs=1e-9)
    assert not [line for line in summarize_run(run) if "not at rest" in line]


def test_a_piece_that_lies_beside_the_block_is_at_rest():
    assert find_rest(four([0.0, 0.0, 0.0, 0.0]), "plate", "plate").moving_count.tolist() == [0]


def test_without_speeds_what_has_not_settled_is_counted_by_its_mass():
    for settled, moving in ((1, 3), (4, 0)):
        run = four([0.0] * 4, settled)
        run = replace(run, header=replace(run.header, info={}))
        assert find_rest(run, "plate", "plate").moving_count.tolist() == [moving]


def test_a_run_counts_what_moves_when_it_ends():
    """Two balls of which one has landed: single, of an ensemble, in memory and in its members."""
    import dem_jax

    pieces = [
        {**PIECES[1], "position": [0.0, 0.0, 0.0101]},
        {**PIECES[1], "position": [0.1, 0.0, 0.2]},
    ]
    scene = SCENE.replace(
        piece=pieces, run={"duration": 0.05, "sample_interval": 1e-3, "frame_interval": 0.0}
    )
    run = dem_jax.simulate(scene)
    assert run.info["moving"] == {"plate": 1} and find_rest(
        run, "plate", "plate"
    ).moving_count.tolist() == [1]
    both = dem_jax.ensemble(
        scene, parameters={"piece.1.position": [[0.1, 0.0, 0.2], [0.1, 0.0, 0.0101]]}
    )
    assert both.info["moving"] == {"plate": [1, 0]} and find_rest(
        both, "plate", "plate"
    ).moving_count.tolist() == [1, 0]
    assert [find_rest(both.member(k), "plate", "plate").moving_count.tolist() for k in (0, 1)] == [
        [1],
        [0],
    ]
    lines = summarize_run(both)
    assert any(
        line.endswith("; 1 of 2 runs ended before all pieces were at rest, which are left out")
        for line in lines
    )


@pytest.mark.parametrize(("slow_for", "slowed"), [(0.001, 3), (0.020, 3), (0.021, 0)])
def test_a_piece_that_is_slow_for_an_instant_is_not_at_rest(slow_for, slowed):
    """Three of four balls become slow shortly before the end. At the top of a bounce one is slow
    for 2 * 0.1 / g = 20.4 ms.
    """
    run = four([0.0] * 4, settled=4)
    mass = BALL * (1 + 3 * (run.time > 0.127 - slow_for + 1e-9))
    run = replace(run, series=run.series | {"settled_mass": {"plate": mass}})
    rest = find_rest(run, "plate", "plate")
    assert rest.slow_count.tolist() == rest.moving_count.tolist() == [slowed]
    assert np.isnan(rest.duration[0]) == bool(slowed)
    why = "3 of 4 pieces not at rest at the end (3 slower than 0.1 m/s there, but for less than 20 ms)"
    assert rest.describe() == (why if slowed else "")
    assert (f"duration of the impact: > 106.9 ms: {why}" in summarize_run(run)) == bool(slowed)


def test_pieces_that_are_slow_for_an_instant_are_counted_beside_those_that_are_fast():
    """As four cuboids of 5.832 g cut at 0.34 s: one is fast; of the others, slow for 5 to 16 ms,
    all move further.
    """
    run = four([0.0, 0.0, 0.193, 0.0], settled=3)
    after = np.array([0.0051, 0.0159, 0.0093])
    mass = BALL * (run.time > 0.127 - after[:, None] + 1e-9).sum(axis=0)
    run = replace(run, series=run.series | {"settled_mass": {"plate": mass}})
    rest = find_rest(run, "plate", "plate")
    assert rest.moving_count.tolist() == [4] and rest.slow_count.tolist() == [3]
    assert evaluate_outputs(run, ["not_at_rest"])["not_at_rest"] == 4


def test_outputs_of_a_study_have_no_number_that_needs_rest():
    names = [
        "peak",
        "peak_10ms",
        "time_to_rest",
        "peak_over_static",
        "impact_time",
        "time_to_weigh",
        "settled",
        "not_at_rest",
    ]
    early, late = four([0.0, 0.5, 0.3, 0.2], cut=0.3), four([0.0] * 4, settled=4, cut=0.3)
    found, whole = evaluate_outputs(early, names), evaluate_outputs(late, names)
    for name in ("time_to_rest", "peak_over_static", "impact_time", "time_to_weigh"):
        assert np.isnan(found[name]).all(), name
    assert found["not_at_rest"] == 3 and found["settled"] == pytest.approx(1e3 * BALL)
    assert whole["time_to_rest"] == pytest.approx(80.0) and whole[
        "peak_over_static"
    ] == pytest.approx(2.0 / (4 * BALL))
    assert whole["peak_10ms"] == pytest.approx(number(late, "peak force, mean over 10 ms").median)


def test_a_study_counts_the_drops_that_ended_too_early():
    study = validate_study(
        {
            "name": "s",
            "title": "S",
            "scene": "plate-drop",
            "seeds": 4,
            "outputs": ["peak", "time_to_rest"],
        },
        "s.toml",
    )
    values = {
        "peak": np.array([1.0, 2.0, 3.0, 4.0]),
        "time_to_rest": np.array([100.0, 120.0, np.nan, np.nan]),
    }
    found = StudyResults(study, np.full(4, DONE, np.int8), values)
    assert analysis.tabulate_points(found)[1] == [
        ["4", "2.5 (1.15 to 3.85)", "110 (101 to 119) [2 of 4]"]
    ]
    words = "2 of 4 drops have no time_to_rest: pieces still moved when their run ended"
    assert any(line.startswith(words) for line in analysis.list_findings(found))
    peaks = "peaks are those of E = 100 MPa, NSF = 0.01, an assumed modulus"
    assert any(line.startswith(peaks) for line in analysis.list_findings(found))


def swinging(frequency=25.0, amplitude=6.8e-3, mass=52.49e-3, duration=0.5):
    """A load cell of 1 kg whose reading swings about what lies on it."""
    scene = load_scene(
        "weigh-bucket", {"weigh_bucket.load_cell": {"mass": 1.0, "natural_frequency": frequency}}
    )
    run = stored(scene=FOUR, frames=0)
    time = 1e-4 * np.arange(1, round(duration / 1e-4) + 1)
    omega = 2 * np.pi * frequency * np.sqrt(1.0 / (1.0 + mass))
    weight = mass + amplitude * np.cos(omega * (time - time[-1]) + np.pi)
    force = {"wb_flaps": np.outer(weight, (0.0, 0.0, -G))}
    series = {"force": force, "mean_force": force, "settled_mass": {"wb": np.full(len(time), mass)}}
    series["load_cell"] = {"weight": weight}
    header = replace(
        run.header, scene=scene.to_toml(), groups=("wb_flaps",), blocks=("wb",), piece_count=9
    )
    return replace(run, header=header, time=time, series=series)


def test_a_load_cell_that_swings_reads_its_mean_over_whole_periods():
    run = swinging()
    found = find_cell_oscillation(run)
    assert (
        found.last[0] == pytest.approx(45.69e-3)
        and found.is_oscillating.all()
        and found.periods.tolist() == [3]
    )
    assert found.mean[0] == pytest.approx(52.49e-3, rel=2e-3)  # a period is 410.4 samples
    assert found.amplitude[0] == pytest.approx(6.8e-3, rel=1e-3)
    (line,) = [line for line in summarize_run(run) if line.startswith("load cell")]
    assert (
        "g, mean over its last 3 periods (41 ms each); still swings by ± 6.8 g at the end, at most"
        in line
    )
    assert number(run, "load cell at the end").median == pytest.approx(52.49, rel=2e-3)
    assert number(run, "force at the end").median == pytest.approx(52.49, rel=2e-3)


def test_a_load_cell_at_rest_reads_what_it_did():
    (line,) = [
        line for line in summarize_run(swinging(amplitude=0.0)) if line.startswith("load cell")
    ]
    assert line.startswith("load cell: 52.49 g at the end, at most")


def test_a_period_longer_than_the_run_has_no_mean():
    (line,) = [
        line for line in summarize_run(swinging(frequency=1.0)) if line.startswith("load cell")
    ]
    assert "still swings by ±" in line and "longer than the run, which has no mean" in line


def test_the_band_of_a_peak_is_that_of_the_product_s_own_modulus():
    """Of hazelnuts, 20 MPa softened to 2 MPa, known within 5 and 50 MPa; walls of 100 GPa hardly
    count.
    """
    scene = load_scene("weigh-bucket", {"product": "hazelnut"})
    low, high = find_peak_factors(scene)
    assert (low, high) == pytest.approx((np.sqrt(2.5), 5.0), rel=1e-2)  # the walls are softened as
    # well: 1 % of 2 MPa on 10 GPa
    hertz = scene.replace({"contact.law": "hertz-mindlin"})
    assert find_peak_factors(hertz)[1] == pytest.approx(25**0.4, rel=1e-2)
    assert find_peak_factors(scene.replace({"material.youngs_modulus": 1e7})) is None, (
        "a range is that of the modulus below it"
    )
    named = {
        "material.youngs_modulus": 1e7,
        "material.youngs_modulus_range": [1e7, 4e7],
        "material.numerical_softening": 1.0,
    }
    assert find_peak_factors(scene.replace(named)) == pytest.approx((1.0, 2.0), rel=1e-3)
    assert find_peak_factors(load_scene("weigh-bucket")) is None
    assert all(
        find_peak_factors(load_scene("weigh-bucket", {"product": name}))
        for name in library.list_products()
    )
    with pytest.raises(
        SceneError, match=r"youngs_modulus_range = \[2.*, 1.*\]: allowed: low, high"
    ):
        scene.replace({"material.youngs_modulus_range": [2e7, 1e7]})


def test_the_summary_says_what_a_peak_rests_on():
    assumed = "the peak rests on an assumed modulus (material.youngs_modulus_range is not given): with twice the modulus one impact"
    assert any(
        line.startswith(f"{assumed} is 1.41 times as high") for line in summarize_run(stored())
    )
    known = SCENE.replace({"material.youngs_modulus_range": [1e6, 4e6]})
    lines = summarize_run(stored(scene=known))
    assert (
        "band of the peak: 2 to 4 kg, as of one impact with a modulus of 1 MPa to 4 MPa without softening (NSF = 1)"
        in lines
    )
    rows = {row[0]: row[2] for row in numbers_table(stored(scene=known)).rows}
    assert rows["peak force without softening, least modulus"] == pytest.approx(2.0, rel=1e-3)
    assert rows["peak force without softening, greatest modulus"] == pytest.approx(4.0, rel=1e-3)
    assert any("over 10 ms 0.257 kg" in line for line in lines)


@pytest.mark.parametrize(
    ("scene", "changes", "words"),
    [
        (
            "plate-drop",
            {"run.sample_interval": 1.0},
            r"run: sample_interval = 1: longer than run\.duration = 0\.3; allowed: at most the duration",
        ),
        (
            "plate-drop",
            {"run.duration": 1e-5},
            r"sample_interval = 3e-05: longer than run\.duration = 1e-05",
        ),
        (
            "weigh-bucket",
            {"run.sample_interval": 0.6},
            r"run\.sample_interval = 0\.6: longer than portion\.settling_time = 0\.5",
        ),
        (
            "weighing-cycles",
            {"run.sample_interval": 0.1},
            r"run\.sample_interval = 0\.1: longer than inlet\.interval",
        ),
    ],
)
def test_a_sample_is_no_longer_than_what_is_counted_in_samples(scene, changes, words):
    with pytest.raises(SceneError, match=words):
        load_scene(scene, changes)


def test_times_that_are_rounded_are_noted():
    from dem_jax.runner.job_setup import prepare_job

    notes = lambda changes: prepare_job(load_scene("plate-drop", changes), [0], None).notes
    assert not notes({})
    *_, said_of = notes(
        {"run.duration": 1e-3, "run.sample_interval": 4e-4, "run.frame_interval": 0.0}
    )
    assert (
        said_of
        == "run.duration = 0.001 s is no multiple of run.sample_interval = 0.0004 s: the run has 2 samples and ends at 0.0008 s"
    )
    (said_of,) = notes({"run.frame_interval": 2.0})
    assert (
        said_of
        == "run.frame_interval = 2 s is longer than run.duration = 0.3 s: only the first pose is stored"
    )
    (said_of,) = notes({"run.frame_interval": 1e-5})
    assert (
        said_of
        == "run.frame_interval = 1e-05 s is no multiple of run.sample_interval = 3e-05 s: poses are stored every 3e-05 s"
    )
    (said_of,) = notes(
        {"run.time_step": 7e-6, "run.sample_interval": 6e-6, "run.frame_interval": 0.0}
    )
    assert said_of.startswith(
        "run.time_step = 7e-06 s is longer than run.sample_interval = 6e-06 s: no step is longer than a sample"
    )


def test_seeds_are_whole_numbers(tmp_path):
    import dem_jax

    scene = load_scene("plate-drop")
    for seed in (1.5, -1, True, 2**63, np.float64(2.0), "1"):
        with pytest.raises(
            SceneError, match="seed = .*: allowed: a whole number from 0 to 9223372036854775807"
        ):
            dem_jax.simulate(scene, seed=seed, out=tmp_path / "run.h5")
        with pytest.raises(SceneError, match="seed = .*: allowed: a whole number"):
            dem_jax.rollout(scene, {}, seed=seed)
    for seed in ([0.2, 0.9], 0.5, [0, -3]):
        with pytest.raises(SceneError, match="seed = .*: allowed: a whole number"):
            dem_jax.ensemble(scene, 2, seed=seed, out=tmp_path / "runs.h5")
    assert not list(tmp_path.iterdir())
    assert assembly.assemble_system(scene, np.int64(3)).samples > 0


def test_the_band_of_runs_of_different_moduli_is_that_of_the_modulus_of_each():
    """Peaks of 2 and 4 kg at 1 and 4 MPa: without softening each is that of the ends of the range.

    Tolerance: walls in series.
    """
    scene = SCENE.replace(
        {
            "material.youngs_modulus": 2e6,
            "material.youngs_modulus_range": [1e6, 4e6],
            "material.numerical_softening": 1.0,
        }
    )
    made = stored(peaks=(2.0, 4.0), frames=0, scene=scene)
    drawn = {"material.youngs_modulus": [1e6, 4e6], "material.restitution": [0.2, 0.4]}
    info = {"parameters": drawn, "steps": [5e-6, 5e-6]}
    run = replace(made, header=replace(made.header, info=info))
    least, greatest = (
        number(run, f"peak force without softening, {end} modulus") for end in ("least", "greatest")
    )
    np.testing.assert_allclose(least.values, [2.0, 2.0], rtol=1e-3)
    np.testing.assert_allclose(greatest.values, [4.0, 4.0], rtol=1e-3)
    lines = summarize_run(run)
    assert any("E = 1 MPa to 4 MPa (each run has its own), NSF = 1:" in line for line in lines)
    assert any(line.startswith("band of the median peak: 2 to 4 kg") for line in lines)
    one = replace(
        run,
        header=replace(
            run.header,
            info=info
            | {"parameters": {"material.youngs_modulus": drawn["material.youngs_modulus"]}},
        ),
    ).member(1)
    assert any(line.startswith("band of the peak: 2 to 4 kg") for line in summarize_run(one))
