"""The timeline of a weighing station: how walls move through any number of cycles, what is refused,
what each cycle comes to.
"""

from dataclasses import replace

import jax
import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.errors import SceneError
from dem_jax.runner import stop_criterion
from dem_jax.scene import load_scene, parse_scene
from dem_jax.scene.cycle_timing import apply_cycle
from dem_jax.visualization.cycle_metrics import (
    compute_cycle_metrics,
    cut_cycle_window,
    describe_cycles,
    find_cycle_windows,
)
from tests.dem_jax.stored import G, stored

PERIOD = 1.3
CYCLE = {
    "period": PERIOD,
    "wb": {"opens": [0.0, 0.08], "closes": [0.1, 0.19]},
    "fb": {"opens": [0.08, 0.16], "closes": [0.26, 0.35]},
    "lf": [0.35, 1.05],
}


def station(**changes):
    return load_scene("weighing-station").replace(cycle=CYCLE | changes)


def motions(scene):
    """The walls' groups, and how far flaps are open and the pan is out, of every ms through three
    cycles and a little more.
    """
    with jax.enable_x64(True):
        panels, sections, joint, *_ = assembly.wall_panels.lay_out_walls(scene)
        walls = assembly.wall_panels.build_walls(scene, panels, sections, joint, np.float64)[0]
        hinge, vibration = walls.motions
        time = np.arange(-200, 3 * 1300 + 200) / 1000
        return (
            walls.groups.index,
            time,
            np.array(jax.vmap(hinge.opening_fraction)(time)),
            np.array(jax.vmap(vibration.relative_displacement)(time)),
        )


def test_walls_move_as_table_1_says_in_each_of_three_cycles():
    of, time, opened, shift = motions(station())
    weigh, feed, pan = (
        opened[:, of("wb_flap_left")],
        opened[:, of("fb_flap_right")],
        shift[:, of("lf")],
    )
    np.testing.assert_array_equal(opened[:, of("wb_flap_right")], weigh)
    for k in range(3):
        phase = np.round(time + 0.08 - k * PERIOD, 9)  # s from the beginning of the cycle
        within = (phase >= 0) & (phase < PERIOD)
        for flap, (opens, closes) in ((weigh, CYCLE["wb"].values()), (feed, CYCLE["fb"].values())):
            shut = within & ((phase <= opens[0]) | (phase >= closes[1]))
            assert np.abs(flap[shut]).max() < 1e-9
            np.testing.assert_allclose(
                flap[within & (phase >= opens[1]) & (phase <= closes[0])], 1, atol=1e-9
            )
            moving = flap[within & (phase > opens[0] + 2e-3) & (phase < opens[1] - 2e-3)]
            assert ((moving > 0) & (moving < 1)).all() and (np.diff(moving) > 0).all()
        at_rest = within & ((phase <= CYCLE["lf"][0]) | (phase >= CYCLE["lf"][1]))
        assert np.abs(pan[at_rest]).max() < 1e-9 and np.abs(pan[within]).max() > 0.9
    assert not opened[time < -0.08].any() and not pan[time < 0.27].any()


def test_one_cycle_is_the_station_as_it_was():
    (_, time, once, pan), (_, _, again, pan_again) = (
        motions(load_scene("weighing-station")),
        motions(station()),
    )
    first = time < PERIOD - 0.08
    np.testing.assert_allclose(again[first], once[first], atol=1e-12)
    np.testing.assert_allclose(pan_again[first], pan[first], atol=1e-10)


def test_a_delay_moves_what_it_should():
    late = apply_cycle(
        station(fb={"opens": [0.1, 0.18], "closes": [0.3, 0.4]}, lf=[0.4, 1.0], period=1.2)
    )
    assert late.weigh_bucket.opening_start == pytest.approx(-0.1)  # time zero is when FB opens
    assert late.feed_bucket.opening_start == 0.0
    assert late.feed_bucket.hold_time == pytest.approx(
        0.12
    ) and late.feed_bucket.closing_time == pytest.approx(0.1)
    assert late.feeder.start == pytest.approx(0.3) and late.feeder.duration == pytest.approx(0.6)
    assert {late.weigh_bucket.period, late.feed_bucket.period, late.feeder.period} == {1.2}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"fb": {"opens": [0.05, 0.16], "closes": [0.26, 0.35]}},
            r"FB opens before WB is open; allowed: from 0\.08 s on",
        ),
        (
            {"wb": {"opens": [0.0, 0.08], "closes": [0.05, 0.19]}},
            "begin < end of opening <= begin < end of closing",
        ),
        (
            {"wb": {"opens": [0.0, 0.08], "closes": [0.1, 1.4]}},
            r"WB is not shut when it opens again; allowed: until 1\.3 s",
        ),
        ({"lf": [0.3, 1.05]}, r"lf = \[0\.3, 1\.05\]: allowed: within from 0\.35 s"),
        ({"lf": [0.35, 1.5]}, r"to 1\.38 s, when it opens again"),
        ({"period": 0.25, "lf": None}, "FB is not shut when it opens again"),
        ({"period": 0.0}, r"cycle\.period"),
        ({"pause": 1.0}, "pause"),
    ],
)
def test_bad_timelines_are_refused_in_one_line(changes, words):
    with pytest.raises(SceneError, match=words) as refused:
        station(**changes)
    assert "\n" not in str(refused.value)


def test_a_cycle_needs_what_it_moves_and_never_rests():
    with pytest.raises(
        SceneError,
        match=r"\[cycle\] needs a \[weigh_bucket\] and a \[feed_bucket\], and with lf a \[feeder\]",
    ):
        load_scene("weigh-bucket").replace(cycle=CYCLE)
    scene = station().replace(run={"until_settled": True})
    with pytest.raises(SceneError, match=r"the walls never rest: \[cycle\] goes on"):
        stop_criterion.build_criterion(scene, None, 0, 1)


def test_a_scene_with_a_cycle_is_written_and_read():
    scene = station()
    assert parse_scene(scene.to_toml()) == scene
    assert parse_scene('base = "weighing-station"\n[cycle]\n' + scene.to_toml().split("[cycle]\n")[1].split("\n[")[0] + "\n" + "\n".join(
        f'[cycle.{name}]\nopens = {CYCLE[name]["opens"]}\ncloses = {CYCLE[name]["closes"]}' for name in ("wb", "fb")
    )).cycle == scene.cycle  # fmt: skip


def test_each_cycle_has_its_dose_its_peak_and_its_time_to_rest():
    scene = station()
    windows = find_cycle_windows(scene, 3 * PERIOD)
    assert [(w.number, round(w.begin, 9), round(w.end, 9)) for w in windows] == [
        (1, 0.11, 1.22),
        (2, 1.41, 2.52),
        (3, 2.71, 3.82),
    ]
    assert len(find_cycle_windows(scene, 3 * PERIOD - 0.09)) == 2 and not find_cycle_windows(
        load_scene("weighing-station"), 3.0
    )
    time = 1e-3 * np.arange(1, 3901)
    grams, kg = np.zeros(3900), np.zeros(3900)
    for k, dose in enumerate((11.0, 22.0, 33.0)):
        at = k * PERIOD + 0.25
        kg += (k + 1.0) * ((time > at) & (time < at + 0.0105))
        kg += 1e-3 * dose * (time > at) * (time < (k + 1) * PERIOD - 0.05)
        grams += dose * (time > at + 0.0305) * (time < (k + 1) * PERIOD - 0.05)
    plain = stored()
    force = {"wb_flaps": kg[:, None] * np.array([0.0, 0.0, -G])}
    series = {"force": force, "mean_force": force, "settled_mass": {"wb": 1e-3 * grams}}
    run = replace(
        plain,
        header=replace(plain.header, scene=scene.to_toml()),
        time=time,
        series=series,
        pieces=None,
    )
    for window, dose, peak in zip(windows, (11.0, 22.0, 33.0), (1.0, 2.0, 3.0), strict=True):
        dosed, highest, rest = compute_cycle_metrics(run, window)
        assert dosed.median == pytest.approx(dose) and highest.median == pytest.approx(
            peak + 1e-3 * dose
        )
        assert rest.median == pytest.approx(30.0, abs=1.1)  # ms, of samples of 1 ms
        assert np.all(
            (cut_cycle_window(run, window).time > window.begin)
            & (cut_cycle_window(run, window).time <= window.end)
        )
    assert describe_cycles(run)[1].startswith(
        "cycle 2: dosed 22 g, peak force 2.02 kg, time to rest "
    )
    assert len(describe_cycles(run)) == 3


def test_each_cycle_says_what_its_buckets_hold_and_what_came_and_went():
    scene = load_scene("weighing-cycles")
    time = 1e-3 * np.arange(1, 3901)
    came, gone = np.floor(time / 0.2).astype(int), 3 * np.floor(time / PERIOD).astype(int)
    force = {"wb_flaps": np.zeros((3900, 3))}
    series = {
        "force": force,
        "mean_force": force,
        "settled_mass": {"wb": 0 * time, "fb": 1e-2 * time, "lf": 2e-2 * time},
    }
    series["piece_count"] = {"inside": 13 + came - gone, "inserted": came, "removed": gone}
    plain = stored()
    run = replace(
        plain,
        header=replace(plain.header, scene=scene.to_toml()),
        time=time,
        series=series,
        pieces=None,
    )
    found = [
        {n.name: n.median for n in compute_cycle_metrics(run, window)}
        for window in find_cycle_windows(scene, 3.9)
    ]
    assert [row["in FB"] for row in found] == pytest.approx([12.2, 25.2, 38.2])  # at 1.22, 2.52,
    # 3.82 s
    assert [row["on LF"] for row in found] == pytest.approx([24.4, 50.4, 76.4])
    assert [row["came in"] for row in found] == [6, 12 - 6, 19 - 12] and [
        row["taken out"] for row in found
    ] == [0, 3, 3]
    assert describe_cycles(run)[1].endswith("in FB 25.2 g, on LF 50.4 g, came in 6, taken out 3")
