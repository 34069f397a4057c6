"""A film strip shows the impact of any run: instants are chosen by the force and by the speeds of
the pieces.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from dem_jax.visualization.instants import find_impact_instants

SAMPLE, FRAME, END = 1e-3, 1e-3, 1.0  # s


def run(forces, rest=0.6, frame=FRAME, end=END):
    """A run of one piece whose walls bear these forces (kg): group -> [(from (s), to (s), force)];
    it moves until ``rest`` (s).
    """
    time = SAMPLE * np.arange(1, round(end / SAMPLE) + 1)
    traces = {group: np.zeros(len(time)) for group in forces}
    for group, loads in forces.items():
        for begin, until, load in loads:
            traces[group][(time > begin + SAMPLE / 2) & (time < until + SAMPLE / 2)] = load
    frames = frame * np.arange(round(end / frame) + 1)
    speed = np.where(frames < rest - frame / 2, 1.0, 0.01)
    pieces = SimpleNamespace(
        time=frames, velocity=speed[:, None, None] * np.array([0.0, 0.0, -1.0])
    )
    return SimpleNamespace(time=time, sample=SAMPLE, force=traces, pieces=pieces, pif_kg=traces.get)


# a piece, a gap of 40 ms, the portion
PORTION = [(0.3, 0.31, 0.5), (0.35, 0.36, 2.0), (0.36, 0.37, 4.0), (0.37, END, 0.1)]


def told(found):
    return [(pytest.approx(instant.time, abs=1e-9), instant.label) for instant in found]


def test_a_portion_is_shown_from_start_to_rest():
    assert told(
        find_impact_instants(run({"wb_walls": [(0.4, 0.41, 9.0)], "wb_flaps": PORTION}))
    ) == [
        (0.0, "start"),
        (0.251, "approach"),  # 50 ms before the first contact
        (0.301, "first contact"),
        (0.361, "peak force, 4 kg"),
        (0.6, "at rest"),
    ]


def test_of_several_impacts_the_largest_is_shown():
    second = [(0.3, 0.32, 1.0), (0.7, 0.72, 3.0), (0.72, 0.74, 2.0)]
    found = find_impact_instants(run({"wb_flaps": second}, rest=0.8))
    assert told(found)[1:4] == [
        (0.651, "approach"),
        (0.701, "first contact, peak force, 3 kg"),
        (0.8, "at rest"),
    ]


def test_without_a_weigh_bucket_the_wall_that_is_hit_hardest_decides():
    found = find_impact_instants(run({"side": [(0.1, 0.2, 1.0)], "floor": [(0.4, 0.5, 2.0)]}))
    assert (0.401, "first contact, peak force, 2 kg") in told(found)
    assert (0.101, "first contact, peak force, 1 kg") in told(
        find_impact_instants(run({"side": [(0.1, 0.2, 1.0)]}), "side")
    )


def test_a_short_fall_is_approached_within_it():
    # 3/4 of 40 ms, next frame
    assert told(find_impact_instants(run({"plate": [(0.04, 0.06, 1.0)]})))[1] == (0.031, "approach")


def test_frames_that_coincide_are_shown_once():
    found = find_impact_instants(run({"wb_flaps": PORTION}, frame=0.1))
    assert [round(i.time, 3) for i in found] == [0.0, 0.3, 0.4, 0.6]
    assert [i.label for i in found] == [
        "start",
        "approach, first contact",
        "peak force, 4 kg",
        "at rest",
    ]


def test_what_lies_on_the_wall_from_the_start_has_no_approach():
    labels = [i.label for i in find_impact_instants(run({"floor": [(-1.0, END, 1.0)]}))]
    assert labels == ["start", "peak force, 1 kg", "at rest"]


def test_what_does_not_come_to_rest_is_shown_at_the_end():
    for rest in (2.0, END - 0.01):  # never, or for less than it takes to tell
        assert told(find_impact_instants(run({"wb_flaps": PORTION}, rest=rest)))[-1] == (
            END,
            "end of the run",
        )


def test_without_an_impact_instants_are_evenly_spaced():
    for forces in ({}, {"wb_flaps": []}):
        assert told(find_impact_instants(run(forces))) == [
            (t, "") for t in (0.0, 0.25, 0.5, 0.75, 1.0)
        ]
