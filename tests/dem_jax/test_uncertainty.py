"""Chance and unknown numbers: shares of functions that are known, numbers of pieces that stay,
studies of ranges.
"""

import numpy as np
import pytest
from scipy.stats import qmc

from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
from dem_jax.cli.main import main
from dem_jax.errors import SceneError
from dem_jax.runner.uncertain_draws import draw_uncertain_numbers, hold_portion
from dem_jax.scene import load_scene, parse_scene
from dem_jax.scene.material_properties import build_material_table
from dem_jax.scene.ranges import draw_values, evaluate_cdf, evaluate_quantile
from dem_jax.scene.sections.uncertain_number import UncertainNumber
from dem_jax.study import analysis
from dem_jax.study.config import validate_study
from dem_jax.study.design import list_points
from dem_jax.study.results_file import DONE, StudyResults
from dem_jax.study.uncertain_parameters import fill_parameters, split_outputs, within_point_share
from dem_jax.visualization.metrics import Metric
from dem_jax.visualization.variance_decomposition import (
    choose_first_number,
    describe_held_portion,
    describe_splits,
    draw_variance_shares,
    normal_scores,
    split_scatter,
    split_variance,
)

MODULUS = UncertainNumber(
    key="material.youngs_modulus", range=(1e6, 1e8), distribution="log-uniform"
)
FRICTION = UncertainNumber(key="material.friction_wall", range=(0.2, 0.4))


def test_values_are_drawn_evenly_from_their_ranges():
    """Of a Latin hypercube each K-th of a range, or of its logarithm, contains one value."""
    drawn = draw_values([MODULUS, FRICTION], 8, seed=3)
    for row in (MODULUS, FRICTION):
        places = evaluate_cdf(row, drawn[row.key])
        assert sorted(np.floor(8 * places)) == list(range(8))
        assert evaluate_quantile(row, places) == pytest.approx(np.array(drawn[row.key]), rel=1e-12)
    assert evaluate_quantile(MODULUS, [0, 0.5, 1]) == pytest.approx(np.array([1e6, 1e7, 1e8]))
    assert draw_values([MODULUS, FRICTION], 8, seed=3) == drawn


def splits_of_a_known_function(count):
    """y = 2 P1(a) + (3 P2(a) + P1(b)) / sqrt(10) + 2 chance, of five numbers: variances 4.9, 0.1
    and 4.
    """
    random = np.random.default_rng(0)
    for _ in range(count):
        u = qmc.LatinHypercube(5, rng=random).random(64)
        a, b = 2 * u[:, 0] - 1, 2 * u[:, 1] - 1
        bent = np.sqrt(5) * (3 * a**2 - 1) / 2
        y = 2 * np.sqrt(3) * a + (3 * bent + np.sqrt(3) * b) / np.sqrt(10) + random.normal(0, 2, 64)
        yield split_variance(u, list("abcde"), Metric("y", "kg", y))


def test_shares_are_those_of_a_known_function_and_intervals_contain_them():
    """200 ensembles of 64: means within three standard errors, but for shares near zero, which
    cannot be negative; of 90 % intervals at least 85 % (three standard deviations of the count
    below).
    """
    found = list(splits_of_a_known_function(200))
    shares = {
        name: np.array([next(p for p in s.parts if p.name == name)[1:] for s in found])
        for name in "abc"
    }
    total = np.array([s.numbers[1:] for s in found])
    for exact, rows in ((5.0 / 9.0, total), (4.9 / 9.0, shares["a"])):
        assert rows[:, 0].mean() == pytest.approx(
            exact, abs=3 * rows[:, 0].std() / np.sqrt(200) + 0.01
        )
        assert ((rows[:, 1] <= exact) & (exact <= rows[:, 2])).mean() > 0.85
    assert shares["c"][:, 0].mean() < 0.03 and (shares["c"][:, 1] > 0).mean() < 0.12, (
        "5 % by chance"
    )
    assert choose_first_number(found[:1]).name == "a"


def test_a_sum_without_chance_is_split_exactly():
    """Shares of 0.8 and 0.2 of y = 2 P1(a) + P1(b) on a grid on which both have that variance, up
    to its width.
    """
    grid = (np.arange(40) + 0.5) / 40
    u = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    split = split_variance(u, ["a", "b"], Metric("y", "", 4.0 * u[:, 0] + 2.0 * u[:, 1]))
    assert split.numbers[1:] == pytest.approx((1, 1, 1), abs=5e-4)  # the interval ends at F = 1e6
    assert [p.value for p in split.parts] == pytest.approx([0.8, 0.2], rel=1e-6)


def test_a_single_outlier_does_not_decide_the_shares():
    """Of ranks: one value of a thousand times the others is the largest, no more."""
    random = np.random.default_rng(4)
    u = random.random((64, 2))
    y = u[:, 0] + 0.1 * random.normal(size=64)
    far = np.where(np.arange(64) == y.argmax(), 1e3, y)
    one, other = (split_scatter(u, ["a", "b"], Metric("y", "ms", values)) for values in (y, far))
    assert (
        one.numbers == other.numbers and one.numbers.low > 0.7 and other.answer.values.max() == 1e3
    )
    assert split_variance(u, ["a", "b"], Metric("y", "", far)).numbers.low < 0.2
    scores = normal_scores(np.array([3.0, np.nan, 1.0, 2.0]))
    assert scores == pytest.approx(
        np.array([0.967422, np.nan, -0.967422, 0.0]), abs=1e-6, nan_ok=True
    )


def test_too_few_runs_or_equal_answers_have_no_split():
    """One coefficient for each of five numbers and the mean, three runs for each: 18."""
    random = np.random.default_rng(1)
    u, y = random.random((18, 5)), random.random(18)
    assert split_variance(u, list("abcde"), Metric("y", "", y)) is not None
    assert split_variance(u[:17], list("abcde"), Metric("y", "", y[:17])) is None
    assert split_variance(u, list("abcde"), Metric("y", "", np.append(y[:17], np.nan))) is None
    assert split_variance(u, list("abcde"), Metric("y", "", np.ones(18))) is None


def test_the_picture_and_the_words_have_every_share():
    splits = list(splits_of_a_known_function(2))
    first, *_, last = describe_splits(splits)
    assert (
        first.startswith("y ")
        and "of its scatter is due to unknown numbers (a " in first
        and "chance of the fall" in first
    )
    assert last.startswith("measure first: a (")
    bars = draw_variance_shares(splits).axes[0].patches
    widths = np.array([bar.get_width() for bar in bars]).reshape(2, 6)
    assert widths.sum(axis=1) == pytest.approx([100, 100]) and (widths >= 0).all()


def test_the_share_within_is_that_of_the_analysis_of_variance():
    """Rows (1, 3) and (5, 7) and (9, 11): mean squares 2 within and 32 between, F = 16, (16 - 1) /
    (16 + 1) between.
    """
    assert within_point_share(np.array([[1.0, 3.0], [5.0, 7.0], [9.0, 11.0]]))[0] == pytest.approx(
        2 / 17
    )
    random = np.random.default_rng(2)
    rows = [
        within_point_share(random.normal(size=(32, 1)) + random.normal(size=(32, 2)))
        for _ in range(300)
    ]
    estimate, low, high = np.array(rows).T
    assert estimate.mean() == pytest.approx(0.5, abs=0.02)
    assert ((low <= 0.5) & (high >= 0.5)).mean() == pytest.approx(0.9, abs=0.052)  # three standard
    # deviations of the count


MIXED = """base = "weigh-bucket"
[portion]
target_weight = 0.03
[[portion.product]]
product = "hazelnut"
share = 2
[[portion.product]]
product = "gummy-bear"
"""


def test_a_portion_of_one_product_keeps_its_weight_whatever_its_density():
    """20 g of kernels of about 1 g: within half of the lightest piece of each density."""
    scene = load_scene("weigh-bucket", {"product": "hazelnut", "portion.target_weight": 0.02})
    held, drawn = draw_uncertain_numbers(scene, 8, 0, {"drop.height": [0.2, 0.3] * 4})
    assert drawn["drop.height"] == [0.2, 0.3] * 4 and len(drawn) == 1 + len(scene.uncertain)
    counts = []
    for density in drawn["material.density"]:
        own = held.replace({"material.density": density})
        masses = compute_masses(build_piece_set(own), build_material_table(own))
        assert masses.sum() == pytest.approx(0.02, abs=0.6 * masses.mean())
        counts.append(len(masses))
    assert min(counts) == 18 and max(counts) == 23
    assert describe_held_portion(held, drawn)[0].startswith("portions: each has the weight asked")
    assert describe_held_portion(held, ["material.restitution"]) == []
    fixed = hold_portion(scene.replace({"portion.count": 7}))
    assert fixed.portion.count == 7 and "same number" in describe_held_portion(fixed, drawn)[0]


def test_the_numbers_of_pieces_of_a_mixture_do_not_depend_on_a_drawn_density():
    scene = parse_scene(MIXED)
    held, drawn = draw_uncertain_numbers(scene, 4, 0, {})
    key = next(key for key in drawn if key.endswith("density"))
    own = build_piece_set(scene)
    for value in (0.5 * drawn[key][0], 2.0 * drawn[key][0]):
        assert build_piece_set(held.replace({key: value})).materials == own.materials
    assert len(build_piece_set(scene.replace({key: 2.0 * drawn[key][0]})).materials) < len(
        own.materials
    )
    plate = load_scene("plate-drop")
    assert hold_portion(plate) == plate


def test_a_scene_without_ranges_is_refused_in_one_line(capsys):
    assert main(["ensemble", "weigh-bucket", "--uncertain", "--out", "none.h5"]) == 2
    assert (
        "uncertain = []: no number of the scene has a range; allowed: a product with ranges"
        in capsys.readouterr().err
    )


CHEESE = {
    "name": "cheese", "title": "Cheese", "scene": "weigh-bucket", "uncertain": True, "points": 32, "seeds": 2,
    "outputs": ["peak", "time_to_rest"], "set": {"product": "cheese-cube", "portion.target_weight": 0.02},
}  # fmt: skip


def test_a_study_of_ranges_takes_them_from_the_scene():
    study = fill_parameters(validate_study(CHEESE, "cheese.toml"))
    assert study.design == "sobol" and study.parameter["material.youngs_modulus"].log
    assert (
        study.parameter["material.restitution"].low,
        study.parameter["material.restitution"].high,
    ) == (0.1, 0.35)
    assert study.base_scene().portion.count is None and fill_parameters(study) is study
    assert [study.member_seed(k) for k in (0, 1, 63)] == [0, 1, 63], (
        "drops of different points share no seed"
    )
    with pytest.raises(SceneError, match="uncertain = true: allowed without parameters"):
        validate_study(
            CHEESE | {"parameter": {"drop.height": {"values": [0.2, 0.3]}}}, "cheese.toml"
        )
    with pytest.raises(SceneError, match=r"uncertain = \[\]: no number of the scene has a range"):
        fill_parameters(validate_study(CHEESE | {"set": {}}, "cheese.toml"))


def test_a_study_of_ranges_says_what_is_chance_and_what_is_not_known():
    """Of outputs that are made up: the peak is the logarithm of the modulus, the time to rest is
    chance.
    """
    study = fill_parameters(validate_study(CHEESE, "cheese.toml"))
    found = StudyResults.create_empty(study)
    moduli = np.repeat([point["material.youngs_modulus"] for point in list_points(study)], 2)
    found.outputs["peak"][:] = np.log(moduli)
    found.outputs["time_to_rest"][:] = np.random.default_rng(5).normal(300, 50, 64)
    found.state[:] = DONE
    by_output = {split.answer.name: split for split in split_outputs(found)}
    assert (
        by_output["peak"].parts[0].name == "material.youngs_modulus"
        and by_output["peak"].numbers.value > 0.9
    )
    assert by_output["time_to_rest"].numbers.low == 0.0
    lines = analysis.list_findings(found)
    assert any(line.startswith("measure first: youngs_modulus (") for line in lines)
    assert any(
        line.startswith("peak: drops with equal numbers have 0 % (0 to 0 %) of the scatter")
        for line in lines
    )
