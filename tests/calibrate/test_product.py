"""From a product to a report: forces over time, judgement, progress, what is refused, and the whole
with drops that are there.
"""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

import dem_jax
from calibrate import BadInput, models
from calibrate.__main__ import main
from calibrate.curves import Curves, average, load_cell, measure_curves, received
from calibrate.judgement import describe_comparison, judge, number
from calibrate.models import FittedModel, ParameterRow
from calibrate.overall_progress import OverallProgress, Stage
from calibrate.product import (
    ProductRequest,
    calibrate_product,
    choose_duration,
    find_difference,
    load_product_scene,
    plan_files,
    portion_masses,
)

SAMPLE, LENGTH, WEIGHT = 1e-3, 400, 9.81 * 0.05


def step_curves(count=1, start=100):
    """A force that is the weight from sample `start` on."""
    force = np.zeros((count, LENGTH))
    force[:, start:] = WEIGHT
    return Curves(SAMPLE * np.arange(1, LENGTH + 1), force, np.full(count, 0.05), 9.81)


def portions(count, seed, peak=20.0):
    """Pulses of 10 ms of about `peak` times the weight that begin at 200 to 210 ms, with the
    momentum of 0.2 s of fall.
    """
    random = np.random.default_rng(seed)
    curves = step_curves(count, 210)
    force = curves.force.copy()
    for row, first in zip(force, random.integers(200, 210, count), strict=True):
        row[first : first + 10] = peak * WEIGHT * random.uniform(0.9, 1.1)
    return replace(curves, force=force)


def test_a_load_cell_swings_as_a_damped_oscillator():
    """Step response 1 - exp(-ζωt) (cos ω't + ζω/ω' sin ω't), exactly."""
    curves, rate, damping = step_curves(), 2 * np.pi * 40.0, 0.05
    own, t = rate * np.sqrt(1 - damping**2), np.maximum(curves.time - 0.1, 0.0)
    expected = 0.05 * (
        1 - np.exp(-damping * rate * t) * (np.cos(own * t) + damping * rate / own * np.sin(own * t))
    )
    assert load_cell(curves)[0] == pytest.approx(expected, abs=1e-13)


def test_means_and_momentum_are_exact_on_other_grids():
    """Of a force that sets in 100.4 ms after the release: 0.6 of the weight in that millisecond."""
    curves = step_curves()
    curves.force[0, 100] *= 0.6
    assert average(curves, 0.1, 2e-3, 2)[0] == pytest.approx([0.8 * WEIGHT, WEIGHT], rel=1e-12)
    assert received(curves, 0.0, 0.05, 4)[0] == pytest.approx(
        WEIGHT * np.array([0, 0, 0.0496, 0.0996]), abs=1e-12
    )


def test_numbers_of_a_pulse():
    """10 ms of 21 times the weight, then the weight: all momentum of the fall of 0.2 s has landed
    10 ms after the first impact.
    """
    curves = step_curves(start=200)
    curves.force[0, 200:210] = 21 * WEIGHT
    found = {name: float(row.values[0]) for name, row in measure_curves(curves).items()}
    assert found["peak_1ms"] == pytest.approx(21 * 0.05, rel=1e-9) and found[
        "peak_10ms"
    ] == pytest.approx(21 * 0.05, rel=1e-9)
    assert found["early_momentum"] == pytest.approx(100 * 0.21 / 0.2, rel=1e-9)
    assert found["late_force"] == pytest.approx(100.0, rel=1e-9)
    assert found["landing_time"] == pytest.approx(9.0, abs=1e-6)  # 0.9 (200 + n) ms <= 21 n ms
    # first holds for n = 9


def fitted(model, p=0.4, absurd=()):
    row = ParameterRow("a", "α", "a length", "mm", 2.0, 1.0, 3.0, True)
    content = {"parameters": {"a": {"value": 0.002}}}
    return FittedModel(
        "stub",
        "Stub",
        [row],
        p,
        {"peaks": p},
        [],
        list(absurd),
        lambda count, seed: model(count, seed),
        content,
    )


def test_equal_drops_and_model_do_not_differ_and_a_higher_peak_is_told():
    data, alike = portions(64, 1), portions(256, 2)
    same = judge(fitted(portions), data, alike)
    assert not same.differing and "do not contradict" in same.verdict
    assert same.reasons == ["None of the numbers compared differs by more than chance."]
    high = judge(fitted(portions, p=0.001), data, portions(256, 2, peak=30.0))
    (peak,) = [row for row in high.differing if row.name == "peak_1ms"]
    assert peak.change == pytest.approx(0.5, abs=0.06)  # three standard deviations of medians of 64
    # and 256 values, 0.02
    assert "kg in the drops (" in describe_comparison(peak) and "more)" in describe_comparison(peak)
    assert "is rejected" in high.verdict and "Tests that reject it: peaks." in high.reasons
    assert any("--drops 256" in line for line in high.advice)  # half of 1 to 3 mm is half of 2 mm


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (1234.4, "1234"), (0.01234, "0.0123"), (-2.346, "-2.35")]
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


def test_the_time_left_is_that_of_the_pace_and_of_the_stages_to_come(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("calibrate.overall_progress.time.perf_counter", lambda: clock[0])
    progress = OverallProgress([Stage("drops", 40.0), Stage("fit", 20.0)], shown=False)
    progress.begin("drops")
    assert progress.left == 60.0
    clock[0] = 10.0
    progress.tell("running", 0.5)  # by its pace 20 s, as expected 40 s: half of each, less the 10 s
    # spent
    assert progress.left == pytest.approx(20.0 + 20.0)
    progress.tell("running", 1.0)
    assert progress.left == 20.0
    progress.begin("fit")
    assert progress.left == 20.0


def test_the_scene_of_a_product():
    scene = load_product_scene(ProductRequest("marshmallow"))
    assert (
        scene.name,
        scene.run.duration,
        scene.run.frame_interval,
        scene.run.sample_interval,
    ) == ("marshmallow", 0.42, 0.0, 30e-6)
    assert portion_masses(scene).sum() == pytest.approx(9 * 5.832e-3, rel=1e-12)
    request = ProductRequest(
        "hazelnut", "5.4-litre", 0.1, settings={"material.restitution": 0.5, "run.duration": 0.3}
    )
    scene = load_product_scene(request)
    assert (scene.portion.target_weight, scene.material.restitution, scene.run.duration) == (
        0.1,
        0.5,
        0.3,
    )
    assert (
        scene.weigh_bucket
        == dem_jax.load_scene("weigh-bucket", {"bucket": "5.4-litre"}).weigh_bucket
    )
    assert portion_masses(scene).sum() == pytest.approx(0.1, rel=0.01)  # within half a piece of 1.1
    # g


def test_a_product_file_may_have_all_sections_of_one(tmp_path):
    """Those that `dem-jax list products marshmallow-soft` prints: also [contact] and [evidence]."""
    from dem_jax.scene.library import PRODUCTS

    text = (PRODUCTS / "marshmallow-soft.toml").read_text(encoding="utf-8")
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    scene = load_product_scene(ProductRequest(str(path)))
    assert "[contact]" in text and "[evidence." in text
    assert scene.contact.law == "densifying" and scene.uncertain


def test_a_file_is_a_product_or_a_whole_scene(tmp_path):
    (tmp_path / "ball.toml").write_text(
        '[portion]\nshape = "sphere"\nradius = 0.01\n[material]\ndensity = 500.0\n'
    )
    (tmp_path / "own.toml").write_text(
        'base = "quick-release"\nproduct = "ball.toml"\n[drop]\nheight = 0.2\n'
    )
    for source in ("ball.toml", "own.toml"):
        scene = load_product_scene(ProductRequest(source))
        assert portion_masses(scene)[0] == pytest.approx(500 * 4 / 3 * np.pi * 1e-6, rel=1e-12)
    assert scene.drop.height == 0.2 and choose_duration(scene) < 0.42
    with pytest.raises(BadInput, match="scene = quick-release: no effect beside own.toml"):
        load_product_scene(ProductRequest("own.toml", scene="quick-release"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["marshmalow"], "product = 'marshmalow': no such product; did you mean 'marshmallow'"),
        (["gone.toml"], "product = gone.toml: cannot be read (No such file or directory)"),
        (["hazelnut", "--bucket", "pail"], "bucket = 'pail': no such bucket"),
        (["hazelnut", "--bucket", "pail.stl"], "bucket = pail.stl: no such file"),
        (["hazelnut", "--target", "0"], "target = 0: must be greater than 0 (kg)"),
        (["hazelnut", "--target", "nan"], "target = nan: must be greater than 0 (kg)"),
        (["hazelnut", "--drops", "3"], "drops = 3: must be a whole number from 4"),
        (["hazelnut", "--seed", "-1"], "seed = -1: must be a whole number from 0"),
        (["hazelnut", "--model", "best"], "model = 'best': must be one of paper"),
        (
            ["hazelnut", "--scene", "weighing-station"],
            "scene = weighing-station: has [feeder]; allowed: a scene in which",
        ),
        (["hazelnut", "--out", "no/such/place"], "out = no/such/place: the folder cannot be made"),
        (
            ["hazelnut", "--out", "fit.txt"],
            "out = fit.txt: must be a folder, or a file that ends in .json",
        ),
        (["hazelnut", "--set", "material.bounce=1"], "material.bounce"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys):
    assert main(["product", *arguments]) == 2
    said = capsys.readouterr()
    assert message in said.err and said.err.count("\n") == 1 and said.out == ""


def write_drops(path, scene, drops, data):
    """A file of an ensemble of `scene` with these forces."""
    with h5py.File(path, "w") as file:
        file["time"] = data.time
        file["mean_force/wb_flaps"] = np.stack(
            [0 * data.force, 0 * data.force, -data.force], axis=-1
        )
        masses = portion_masses(scene).tolist()
        info = json.dumps({"piece_masses": masses})
        seeds, version = np.arange(drops), dem_jax.__version__
        values = {
            "scene": scene.to_toml(),
            "seed": seeds,
            "version": version,
            "info": info,
            "piece_count": len(masses),
        }
        file.attrs.update(values)


def test_drops_that_are_there_are_reused_and_all_is_written(tmp_path, monkeypatch):
    settings = {"portion.count": 4, "run.duration": LENGTH * SAMPLE, "run.sample_interval": SAMPLE}
    request = ProductRequest("hazelnut", drops=8, settings=settings, model="stub", out="nuts")
    scene, files, said = load_product_scene(request), plan_files(request), []
    write_drops(files.ensemble, scene, 8, portions(8, 3))
    monkeypatch.setitem(
        models.MODELS, "stub", lambda targets, seed, progress, force: fitted(portions, p=0.01)
    )
    found = calibrate_product(request, said.append)
    assert (
        "4 pieces (" in said[0]
        and said[1] == "drops: nuts/drops.h5 holds them already; reused, not computed anew"
    )
    tree = json.loads(files.fit.read_text())
    assert (
        tree["product"]["verdict"] == found.judgement.verdict
        and tree["product"]["rejected"] is True
    )
    page = files.html.read_text()
    assert (
        found.judgement.verdict in page and page.count("data:image/png") == 3 and "://" not in page
    )
    assert files.pdf.read_bytes().count(b"/Type /Page ") == 1
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in files.figures.values())
    with pytest.raises(
        BadInput, match="nuts/fit.json exists; allowed: another --out, or --overwrite"
    ):
        plan_files(request)
    again = replace(request, overwrite=True)
    assert find_difference(files.ensemble, scene, again) is None  # replaced are results, not equal
    # drops
    for path in files.results:
        path.unlink()
    other = {
        "8 drops from seed 0, asked for are 16 from seed 0": replace(request, drops=16),
        "portion.count = 4, asked for is 5": replace(
            request, settings=settings | {"portion.count": 5}
        ),
    }
    for words, changed in other.items():
        with pytest.raises(BadInput, match=f"holds other drops .{words}.; allowed"):
            calibrate_product(changed)


def test_absurd_parameters_are_not_written_unless_forced(tmp_path, monkeypatch, capsys):
    settings = {"portion.count": 4, "run.duration": LENGTH * SAMPLE, "run.sample_interval": SAMPLE}
    request = ProductRequest("hazelnut", drops=8, settings=settings, model="stub", out="nuts")
    write_drops(plan_files(request).ensemble, load_product_scene(request), 8, portions(8, 3))
    monkeypatch.setitem(
        models.MODELS, "stub", lambda *_: fitted(portions, absurd=["a = 2 km; allowed are less"])
    )
    sets = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
    assert (
        main(["product", "hazelnut", "--drops", "8", "--model", "stub", "--out", "nuts", *sets])
        == 1
    )
    assert "nothing is written: a = 2 km; allowed are less; --force" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "nuts").iterdir()] == ["drops.h5"]
