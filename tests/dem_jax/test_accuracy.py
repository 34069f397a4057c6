"""``run.accuracy``: an impact errs by less than the scene accepts, with a step that is no finer
than that needs.
"""

from functools import cache

import jax
import numpy as np
import pytest

from benchmarks import accuracy
from dem_jax import assembly, load_scene, scene, simulate, validation
from dem_jax.contact_laws import walton_braun_accuracy
from dem_jax.errors import SceneError
from dem_jax.runner.job_setup import prepare_job
from dem_jax.study.config import validate_study
from dem_jax.visualization import summary

KINDS = {"sphere": accuracy.SPHERE, "marshmallow": accuracy.PIECE}
COMPUTED = ["sphere", pytest.param("marshmallow", marks=pytest.mark.long)]


def step_of(kind, asked, restitution=0.1, precision="f64", **settings):
    """The choice of the time step of an impact with ``run.accuracy``."""
    settings = {"accuracy": asked, "precision": precision, "sample_interval": 1e-3} | settings
    return assembly.assemble_system(
        validation.plate_scene(KINDS[kind], run=settings, restitution=restitution)
    ).step


@cache
def reference(name, restitution):
    """Impacts that are to be repeated, and their fine result: six phases, or six orientations that
    strike once.
    """
    kind = KINDS[name]
    window = (
        None
        if name == "sphere"
        else 2e-4 + accuracy.quarter_period(kind["shape"], 0.01) * (1 + restitution)
    )
    begin = accuracy.starts(kind, 6 if name == "sphere" else 16, apart=3e-3)
    fine = accuracy.exact(kind, begin, restitution, window=window)
    if name != "sphere":
        chosen = np.flatnonzero(fine.once)[:6]
        assert len(chosen) == 6
        fine, begin = fine.of(chosen), [begin[k] for k in chosen]
    return begin, fine, window


@pytest.mark.parametrize("name", COMPUTED)
@pytest.mark.parametrize("restitution", [0.1, 0.5])
@pytest.mark.parametrize(
    "asked",
    [{"restitution": 0.1}, {"restitution": 0.01}, {"peak_force": 2e-3}, {"peak_force": 1e-4}],
)
def test_impacts_err_by_less_than_is_accepted(name, restitution, asked):
    """With steps as large as they may be."""
    begin, fine, window = reference(name, restitution)
    kind, step = KINDS[name], step_of(name, asked, restitution).critical
    number = accuracy.quarter_period(kind["shape"], 0.01) / step
    found = accuracy.impacts(kind, begin, number, "f64", restitution, window=window)
    errors = dict(zip(("peak_force", "restitution"), found.errors(fine).max(axis=1), strict=False))
    for quantity, limit in asked.items():
        assert errors[quantity] < limit


@pytest.mark.parametrize(
    ("name", "asked", "part"),
    [("sphere", 1e-4, 0.6), pytest.param("marshmallow", 5e-3, 0.3, marks=pytest.mark.long)],
)
def test_the_bound_is_not_far_above_the_error(name, asked, part):
    """With a part of the steps for an accuracy the sphere errs by more than that; so does one of
    six marshmallows.
    """
    begin, fine, window = reference(name, 0.1)
    kind = KINDS[name]
    number = (
        part
        * accuracy.quarter_period(kind["shape"], 0.01)
        / step_of(name, {"restitution": asked}).critical
    )
    found = accuracy.impacts(kind, begin, number, "f64", 0.1, window=window)
    assert found.errors(fine)[1].max() > asked


@pytest.mark.parametrize("name", KINDS)
def test_laxer_accuracy_takes_larger_steps_within_stability(name):
    default = step_of(name, None).critical
    bound = walton_braun_accuracy.SPHERE if name == "sphere" else walton_braun_accuracy.POLYTOPE
    finest = max(bound.finest["f64"]["restitution"], 1e-6)
    steps = [step_of(name, {"restitution": r}) for r in (0.2, 0.1, 0.03, 0.01, finest)]
    critical = [s.critical for s in steps]
    assert critical == sorted(critical, reverse=True) and critical[0] > 1.5 * default > critical[-1]
    assert all(s.dt <= s.critical <= s.stable for s in steps)
    both = step_of(name, {"restitution": 0.1, "peak_force": 1e-4})
    assert both.critical == step_of(name, {"peak_force": 1e-4}).critical < critical[1]


def test_the_bounds_and_the_steps_are_each_others_inverse():
    for bound in (walton_braun_accuracy.SPHERE, walton_braun_accuracy.POLYTOPE):
        for restitution in (0.05, 0.1, 0.7):
            for asked in (
                {"restitution": 1e-5},
                {"peak_force": 3e-5},
                {"restitution": 1e-5, "peak_force": 1e-3},
            ):
                for corrected in (False, True):
                    number, key = bound.required_steps(asked, restitution, corrected)
                    reached = bound.error_bounds(number, restitution, corrected)
                    assert reached[key] == pytest.approx(asked[key], rel=1e-12)
                    assert all(reached[k] <= asked[k] * (1 + 1e-12) for k in asked)
            number, key = bound.required_steps({"peak_force": 0.2}, restitution, False)
            assert key is None and number == bound.min_steps(restitution)


@pytest.mark.parametrize("restitution", [0.05, 0.1, 0.2, 0.3, 0.5, 0.7])
def test_less_than_the_default_gives_never_costs_more(restitution):
    """The default's own error, by the table, takes the default's step."""
    default = step_of("marshmallow", None, restitution)
    quarter = accuracy.quarter_period("chamfered-cuboid", 0.01)
    frequency = accuracy.spring("chamfered-cuboid", 0.01).frequency
    eccentric = step_of("marshmallow", None).linear_limit * frequency / (2 * 0.1)
    number = eccentric * quarter / default.critical
    bound = walton_braun_accuracy.POLYTOPE.error_bounds(number, restitution, True)
    for key, error in bound.items():
        asked = step_of("marshmallow", {key: min(error * (1 + 1e-6), 0.2)}, restitution)
        assert asked.critical >= default.critical * (1 - 1e-6), key


def test_a_draft_takes_twice_the_default_step_and_says_what_that_does():
    for name in KINDS:
        draft = step_of(name, "draft")
        assert draft.critical == pytest.approx(2 * step_of(name, None).critical, rel=1e-12)
        assert draft.dt <= draft.stable
        words = str(draft)
        assert "from run.accuracy = draft, 2 times that of " in words
        assert "one impact errs by at most: restitution " in words
    assert load_scene("plate-drop", {"run.accuracy": "draft"}).run.accuracy.draft
    with pytest.raises(SceneError, match="draft = true: allowed without restitution and peak"):
        load_scene("plate-drop", {"run.accuracy": {"draft": True, "peak_force": 0.01}})
    other = {"contact.law": "hertz-mindlin"}  # up to the stable step
    default, draft = (
        assembly.assemble_system(load_scene("plate-drop", other | more)).step
        for more in ({}, {"run.accuracy": "draft"})
    )
    assert draft.critical == pytest.approx(min(2 * default.critical, draft.stable), rel=1e-12)
    assert draft.critical > 1.2 * default.critical


def test_a_quick_study_takes_the_draft_unless_it_says_how_long_the_step_is():
    tree = {"name": "a", "title": "a", "scene": "plate-drop"}
    assert validate_study(tree, "a", quick=True).base_scene().run.accuracy.draft
    assert validate_study(tree, "a").base_scene().run.accuracy is None
    own = {"run.time_step": 2e-6}, {"run.accuracy": {"peak_force": 0.01}}
    for settings in own:
        run = validate_study(tree | {"set": settings}, "a", quick=True).base_scene().run
        assert run.accuracy is None or not run.accuracy.draft
    varied = {"parameter": {"run.time_step": {"values": [1e-6, 2e-6]}}}
    assert validate_study(tree | varied, "a", quick=True).base_scene().run.accuracy is None
    assert not validate_study(tree | {"draft": False}, "a", quick=True).draft


def test_the_limit_is_named():
    words = str(step_of("sphere", {"restitution": 0.01, "peak_force": 0.1}))
    assert (
        "from run.accuracy.restitution = 0.01: " in words
        and "steps per loading quarter period, sphere of" in words
    )
    assert "the coarsest step whose error is known (run.accuracy): " in str(
        step_of("sphere", {"peak_force": 0.2})
    )
    found = simulate(
        load_scene("plate-drop", {"run.accuracy.restitution": 0.005, "run.duration": 1e-3})
    )
    assert "run.accuracy.restitution = 0.005" in summary.summarize_run(found)[0]


def test_every_accuracy_is_the_same_program():
    """As the step is a number of the system, and steps per sample are too."""
    programs = {
        jax.tree.structure(
            prepare_job(
                load_scene("plate-drop", {"run.accuracy.restitution": r}), (0,), None
            ).system
        )
        for r in (0.2, 0.03, 5e-3)
    }
    assert len(programs) == 1


def test_a_scene_says_it_in_a_table_of_its_own_and_reads_it_back(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'base = "plate-drop"\n[run.accuracy]\nrestitution = 0.02\npeak_force = 0.001\n'
    )
    mine = load_scene(tmp_path / "mine.toml")
    assert (mine.run.accuracy.restitution, mine.run.accuracy.peak_force) == (0.02, 0.001)
    assert scene.parse_scene(mine.to_toml()) == mine
    assert scene.parse_scene(scene.describe_scene(mine)).run == mine.run
    assert (
        load_scene("plate-drop", {"run.accuracy": {"peak_force": 0.01}}).run.accuracy.restitution
        is None
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"run.accuracy.restitution": 0.3},
            r"run\.accuracy\.restitution = 0\.3: allowed: a number > 0 and <= 0\.2",
        ),
        (
            {"run.accuracy.peak_force": 0.0},
            r"run\.accuracy\.peak_force = 0\.0: allowed: a number > 0 and <= 0\.2",
        ),
        (
            {"run.accuracy.peak": 0.1},
            r"run\.accuracy\.peak = 0\.1: unknown key; allowed: restitution, peak_force",
        ),
        ({"run.accuracy": {}}, r"run\.accuracy: missing: restitution, peak_force; at least one"),
        ({"run.accuracy": 0.01}, r"run\.accuracy = 0\.01: allowed: a table"),
        (
            {"run.accuracy.restitution": 0.1, "run.time_step": 4e-6},
            r"run: time_step = 4e-06: beside accuracy.*allowed: \"auto\"",
        ),
        (
            {"run.accuracy.restitution": 1e-3},
            r"run\.accuracy\.restitution = 0\.001: allowed in single precision: at least",
        ),
        (
            {"run.accuracy.restitution": 1e-5, "run.precision": "f64"},
            r"run\.accuracy\.restitution = 1e-05: allowed: at least 0\.0001 for [^;]*$",
        ),
    ],
)
def test_what_is_not_allowed_is_said(changes, message):
    with pytest.raises(SceneError, match=message):
        assembly.assemble_system(load_scene("plate-drop", changes))
    if changes.get("run.accuracy.restitution") == 1e-3:
        assembly.assemble_system(load_scene("plate-drop", changes | {"run.precision": "f64"}))
