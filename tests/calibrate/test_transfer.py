"""What is learnt for the transfer of the Product Model, from ensembles with known answers."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from calibrate import target
from calibrate.transfer_fit import (
    Ensemble,
    Lesson,
    choose_frame,
    empty_table,
    learn_coefficients,
    learn_lost_time,
    learn_transfer,
    prepare_lessons,
)
from product_model import ensemble, parameters
from product_model.fitted import FITTED
from product_model.transfer import SCALED, STOCK, predict_parameters

SAMPLE = 60e-6
START = 0.1


def model_traces(drop, table, portions, seed):
    """Traces of the predicted model."""
    fitted = predict_parameters(drop, table)
    values = {name: fitted.value[name] for name in FITTED}
    given = {
        "m_piece": drop.m_piece,
        "pieces": drop.pieces,
        "gravity": drop.gravity,
        "landings": fitted.landings,
    }
    made = ensemble(
        parameters(**values, **given, sample=SAMPLE, start=START, duration=0.35), seed, portions
    )
    time = np.asarray(made.time)
    return [target(time, row, drop.m_piece, drop.pieces) for row in np.asarray(made.force)]


def square_traces(drop, fall_time):
    """A trace that brings the momentum of a fall of `fall_time` in 80 samples, then stays at the
    weight.
    """
    number = np.arange(1, 4001)
    time, weight = number * SAMPLE, drop.m_piece * drop.pieces * drop.gravity
    force = np.where(
        number > 1600,
        weight * (1.0 + np.where(number <= 1680, fall_time / (80 * SAMPLE), 0.0)),
        0.0,
    )
    return [target(time, force, drop.m_piece, drop.pieces)]


def varied_drops(count, seed):
    random = np.random.default_rng(seed)
    for _ in range(count):
        opening, pieces, friction = (
            random.uniform(0.08, 0.3),
            int(random.integers(4, 40)),
            random.uniform(0.15, 0.55),
        )
        given = {"opening_time": opening, "pieces": pieces, "friction_wall": friction}
        yield replace(
            STOCK, **given, m_piece=random.uniform(1e-3, 2e-2), elongation=random.uniform(1.0, 2.0)
        )


def test_the_lost_time_is_that_of_the_momentum():
    traces = square_traces(STOCK, STOCK.fall_time - 7e-3)
    # in which the first impact is
    assert Ensemble("a", STOCK, traces).lost_time() == pytest.approx(7e-3, abs=SAMPLE)


def test_a_lost_time_of_the_second_degree_is_recovered():
    """log(lost / opening) = -3 + 0.4 log(opening/stock) + 0.3 friction^2: what its polynomial holds
    exactly, but for the ridge.
    """
    law = lambda d: np.exp(-3.0 + 0.4 * np.log(d.opening_time / 0.16) + 0.3 * d.friction_wall**2)
    made = [
        Ensemble(str(k), drop, square_traces(drop, drop.fall_time - law(drop) * drop.opening_time))
        for k, drop in enumerate(varied_drops(90, 1))
    ]
    table = empty_table(made, "x")
    lost, error = learn_lost_time(made, table)
    table = replace(table, coefficients=replace(table.coefficients, lost_time=lost.tolist()))
    for drop in varied_drops(10, 2):  # a sample is up to 2 % of them
        assert table.lost_time(drop, table.coefficients) == pytest.approx(
            law(drop) * drop.opening_time, rel=0.04
        )
    assert 0.0 < error < 0.04


def test_traces_that_end_before_they_land_are_left_out():
    traces = square_traces(STOCK, 0.2)  # 144 ms from the first impact on
    # whole bins
    assert choose_frame(traces).samples * choose_frame(traces).bin == pytest.approx(
        0.088, abs=30e-6
    )
    # 5 ms after the first impact
    short = [target(t.time[:1750], t.force[:1750], t.m_piece, t.pieces) for t in traces]
    assert choose_frame(short) is None
    whole, cut = Ensemble("whole", STOCK, traces * 3), Ensemble("cut", STOCK, short * 3)
    assert [
        lesson.name for lesson in prepare_lessons([whole, cut], empty_table([whole, cut], "x"), 4)
    ] == ["whole"]


@pytest.mark.long
def test_learning_finds_what_traces_were_made_with():
    """Pulses 1.8 times as long as the start's, and half of its rebound: the loss falls to that of
    the truth.
    """
    drops = [replace(STOCK, pieces=4), replace(STOCK, pieces=4, drop_height=0.2)]
    none = empty_table([Ensemble("a", drop, []) for drop in drops], "x")
    truth = none.coefficients
    true_rows = truth.scaled | {"dt_impact": [np.log(1.8), *truth.scaled["dt_impact"][1:]]}
    true_rows |= {"rebound": [-0.7, *truth.scaled["rebound"][1:]]}
    true = replace(
        none, coefficients=replace(truth, scaled=true_rows, lost_time=[-3.0, *truth.lost_time[1:]])
    )
    made = [Ensemble(str(k), drop, model_traces(drop, true, 60, k)) for k, drop in enumerate(drops)]
    learnt = learn_transfer(made, "1", portions=64, epochs=(60, 1), groups=2)
    found = {name: row[0] for name, row in learnt.coefficients.scaled.items()}
    assert found["dt_impact"] == pytest.approx(np.log(1.8), abs=0.15)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        lessons: list[Lesson] = prepare_lessons(made, none, 64)
        loss = lambda rows: np.mean(
            [each.slope({k: np.array(v) for k, v in rows.items()})[0] for each in lessons]
        )
        assert loss(learnt.coefficients.scaled) < loss(true_rows) + 0.1 * (
            loss(truth.scaled) - loss(true_rows)
        )
    assert len(learnt.groups) == 2 and set(found) == set(SCALED)


def test_nothing_to_learn_from_is_refused():
    from calibrate.errors import BadInput

    with pytest.raises(BadInput, match="ensembles: none has traces that are long enough"):
        learn_coefficients([], {}, 1)
