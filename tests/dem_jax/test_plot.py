"""The figure of a run: what its lines, axes and words say, and that the file is a picture."""

from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

from dem_jax.errors import RecordError
from dem_jax.io.run_files import Run, RunHeader
from dem_jax.visualization.run_figure import FORCE_COLOUR, MASS_COLOUR, draw_run_figure, plot_run

SCENE = 'name = "weigh-bucket"\n[portion]\nscale_factor = 0.4\n[material]\nrestitution = 0.7\n'
G = 9.81


def made_up(runs=None):
    """Nine half-sine impacts of 1 ms from 30 ms on, each leaving 5.832 g: kg and g that a reader
    can check.
    """
    time = 30e-6 * np.arange(1, 4001)
    rng = np.random.default_rng(1)
    lead = 1 if runs is None else runs
    instants = np.zeros((lead, len(time)))
    mass = np.zeros((lead, len(time)))
    for member in range(lead):
        for k in range(9):
            at = 0.03 + 0.004 * k + 0.002 * rng.random()
            inside = (time > at) & (time < at + 1e-3)
            instants[member] += inside * (1.5 + rng.random()) * np.sin(np.pi * (time - at) / 1e-3)
            mass[member] += 5.832e-3 * (time > at + 0.01)
        instants[member] += mass[member] * (1 + 0.9 * np.sin(2 * np.pi * 3800 * time))
    means = np.apply_along_axis(lambda row: np.convolve(row, np.ones(8) / 8, "same"), 1, instants)
    pick = (lambda a: a[0]) if runs is None else (lambda a: a)
    vector = lambda kg: pick(kg)[..., None] * (0.0, 0.0, -G)
    header = RunHeader(
        SCENE,
        7,
        5e-6,
        "f32",
        "0.1",
        30e-6,
        (0.0, 0.0, -G),
        ("wb_walls", "wb_flaps"),
        ("wb",),
        9,
        runs,
    )
    force = {"wb_walls": 0 * vector(instants), "wb_flaps": vector(instants)}
    mean_force = {"wb_walls": 0 * vector(means), "wb_flaps": vector(means)}
    return Run(
        header, time, {"force": force, "mean_force": mean_force, "settled_mass": {"wb": pick(mass)}}
    )


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def test_a_run_is_drawn_in_kilograms_and_grams_over_milliseconds():
    run = made_up()
    left, right = draw_run_figure(run).axes
    assert left.get_xlabel() == "time since release (ms)"
    assert left.get_ylabel().endswith("(kg)") and right.get_ylabel() == "settled mass (g)"
    drawn = lines(left)
    np.testing.assert_allclose(drawn["mean over 30 µs"].get_xdata(), 1e3 * run.time)
    np.testing.assert_allclose(
        drawn["mean over 30 µs"].get_ydata(), -run.mean_force["wb_flaps"][:, 2] / G, atol=1e-15
    )
    instants = drawn["PIF on wb_flaps, instantaneous"]
    np.testing.assert_allclose(instants.get_ydata(), -run.force["wb_flaps"][:, 2] / G, atol=1e-15)
    assert instants.get_alpha() < 0.5 and drawn["mean over 30 µs"].get_alpha() is None
    assert lines(right)["settled mass in wb"].get_ydata()[-1] == pytest.approx(9 * 5.832)


def test_the_title_and_the_peak_are_told():
    figure = draw_run_figure(made_up())
    assert figure.get_suptitle() == "weigh-bucket, 9 pieces, SF = 0.4, ε = 0.7"
    peak = made_up().pif_kg("wb_flaps")
    words = f"{peak.max():.3g} kg at {1e3 * made_up().time[peak.argmax()]:.1f} ms"
    assert words in [text.get_text() for text in figure.axes[0].texts]
    listed = replace(
        made_up().header, scene='name = "mine"\n[[piece]]\nscale_factor = 1.0\n', piece_count=1
    )
    assert (
        draw_run_figure(replace(made_up(), header=listed)).get_suptitle() == "mine, 1 piece, SF = 1"
    )


def test_all_that_happens_is_inside_the_axes():
    run = made_up()
    left, right = draw_run_figure(run).axes
    first = 1e3 * run.time[np.flatnonzero(run.pif_kg("wb_flaps"))[0]]
    assert 0.8 * first < left.get_xlim()[0] < first and left.get_xlim()[1] == 1e3 * run.time[-1]
    assert left.get_ylim()[0] <= 0 and left.get_ylim()[1] > run.pif_kg("wb_flaps").max()
    assert right.get_ylim()[1] > 9 * 5.832
    for made in (draw_run_figure(run), draw_run_figure(made_up(runs=6))):
        made.draw_without_rendering()
        legend = made.legends[0].get_window_extent()
        assert (
            made.bbox.x0 < legend.x0
            and legend.x1 < made.bbox.x1
            and not legend.overlaps(made._suptitle.get_window_extent())
        )
    zoomed, _ = draw_run_figure(run, start=0.05, end=0.06).axes
    assert zoomed.get_xlim() == pytest.approx((50, 60))


def test_an_ensemble_is_drawn_as_median_band_and_members():
    run = made_up(runs=40)
    figure = draw_run_figure(run)
    left, right = figure.axes
    pif = run.pif_kg("wb_flaps")
    np.testing.assert_allclose(
        lines(left)["PIF on wb_flaps, median"].get_ydata(), np.median(pif, axis=0), atol=1e-12
    )
    members = [line for line in left.get_lines() if line.get_linewidth() < 0.5]  # the thin ones
    assert len(members) == 5
    np.testing.assert_array_equal(members[3].get_ydata(), pif[3])
    (band,) = left.collections
    outline = band.get_paths()[0].vertices
    at = 1500
    heights = outline[np.isclose(outline[:, 0], 1e3 * run.time[at]), 1]
    assert (heights.min(), heights.max()) == pytest.approx(
        tuple(np.quantile(pif[:, at], [0.05, 0.95]))
    )
    np.testing.assert_allclose(
        lines(right)["settled mass in wb, median"].get_ydata()[-1], 9 * 5.832
    )
    assert figure.get_suptitle().endswith("40 runs")


@pytest.mark.parametrize("runs", [None, 8])
def test_the_file_is_a_picture_with_both_colours(tmp_path, runs):
    plot_run(made_up(runs), tmp_path / "run.png")
    picture = matplotlib.image.imread(tmp_path / "run.png")[..., :3]
    assert picture.shape == (840, 1440, 3)
    for colour in (FORCE_COLOUR, MASS_COLOUR):
        rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        assert (np.abs(picture - rgb).max(axis=-1) < 0.02).sum() > 300  # a line of 1.2 points over
        # 1000 pixels
    assert 0.6 < (picture.min(axis=-1) > 0.99).mean() < 0.99


def test_what_is_not_there_is_named(tmp_path):
    run = made_up()
    with pytest.raises(
        RecordError, match="group = 'lf' is not in this run; it has: wb_walls, wb_flaps"
    ):
        plot_run(run, tmp_path / "run.png", group="lf")
    with pytest.raises(RecordError, match="block = 'fb' is not in this run; it has: wb"):
        plot_run(run, tmp_path / "run.png", block="fb")
    with pytest.raises(RecordError, match=r"run\.xyz must end in one of: \.png, \.pdf, \.svg"):
        plot_run(run, tmp_path / "run.xyz")
    with pytest.raises(RecordError, match="cannot be written: No such file"):
        plot_run(run, tmp_path / "nowhere" / "run.png")


def test_a_run_without_blocks_or_forces_is_still_a_figure():
    run = made_up()
    (only,) = draw_run_figure(replace(run, series=run.series | {"settled_mass": {}})).axes
    assert "mean over 30 µs" in lines(only)
    still = {"wb_flaps": 0 * run.force["wb_flaps"]}
    left, _ = draw_run_figure(
        replace(run, series=run.series | {"mean_force": still, "force": still})
    ).axes
    assert left.get_xlim()[0] == pytest.approx(0.03)
