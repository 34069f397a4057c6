"""The predicted model of a product: scaling, the drop height from momentum, the table, the command."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from product_model import BadInput, Landings, ensemble, parameters
from product_model.__main__ import main
from product_model.conditions import product_conditions
from product_model.coordinates import NAMES, to_coordinates, to_values
from product_model.fitted import FITTED
from product_model.record import load
from product_model.transfer import (
    SCALED,
    STOCK,
    STOCK_VALUES,
    Coefficients,
    TransferTable,
    describe_prediction,
    measure_conditions,
    predict_parameters,
    read_table,
    scale_parameters,
    shipped_table,
    write_table,
)

WIDE = {name: [0.0, 1.0, -9.0, 9.0] for name in measure_conditions(STOCK)}


def small_table(lost=-2.0, **changes):
    """A table that scales by the physics alone, and loses exp(lost) of the opening time."""
    none = Coefficients({name: [0.0, 0.0] for name in SCALED}, [lost, 0.0])
    return replace(TransferTable("test", WIDE, ["pieces"], ["length"], none), **changes)


def test_the_stock_scene_has_the_stock_parameters():
    absolute = {"restitution", "friction on the bucket", "friction between pieces"}
    assert {value for name, value in measure_conditions(STOCK).items() if name not in absolute} == {
        0.0
    }
    stock = to_coordinates(STOCK_VALUES)
    assert scale_parameters(STOCK) == {name: float(value) for name, value in stock.items()}


def test_parameters_scale_as_the_physics():
    """Young's modulus times 4 halves the lengths of pulses; length times 2 (mass times 8) doubles
    lengths.
    """
    stock = to_values(scale_parameters(STOCK))
    stiff = to_values(scale_parameters(replace(STOCK, modulus=4.0 * STOCK.modulus)))
    for name in NAMES:
        factor = 0.5 if name in ("dt_impact", "late_duration") else 1.0
        assert float(stiff[name]) == pytest.approx(factor * float(stock[name]), rel=1e-12)
    large = to_values(scale_parameters(replace(STOCK, m_piece=8.0 * STOCK.m_piece)))
    # contact: sqrt(m / (E L))
    for name in ("gamma_low", "gamma_high", "slump_depth", "impact_delay", "dt_impact"):
        assert float(large[name]) == pytest.approx(2.0 * float(stock[name]), rel=1e-12)
    slow = to_values(scale_parameters(replace(STOCK, opening_time=3.0 * STOCK.opening_time)))
    assert float(slow["release_time"]) == pytest.approx(
        3.0 * float(stock["release_time"]), rel=1e-12
    )


@pytest.mark.parametrize("lost", [-20.0, -2.0])
def test_portions_bring_the_momentum_of_a_fall_shortened_by_the_lost_time(lost):
    fitted = predict_parameters(STOCK, small_table(lost))
    values = {name: fitted.value[name] for name in FITTED}
    span = {"sample": 1e-4, "duration": 0.8}
    given = {"m_piece": STOCK.m_piece, "pieces": STOCK.pieces, "gravity": STOCK.gravity}
    portions = ensemble(parameters(**values, **given, **span, landings=fitted.landings), 3, 400)
    force, mass = np.asarray(portions.force), STOCK.m_piece * STOCK.pieces
    first = np.asarray(portions.time)[np.argmax(force > 0.0, axis=1)] - 1e-4  # the sample before
    # which it begins
    brought = force.sum(1) * 1e-4 / mass - STOCK.gravity * (0.8 - first)
    expected = STOCK.gravity * (STOCK.fall_time - np.exp(lost) * STOCK.opening_time)
    error = brought.std() / np.sqrt(400)
    # Three standard errors, as many of the 256 portions that decided the height, and one sample of
    # the first impact.
    assert brought.mean() == pytest.approx(
        expected, abs=3 * error * (1 + np.sqrt(400 / 256)) + 1e-4 * STOCK.gravity
    )


def test_coefficients_multiply_their_terms():
    none = {name: [0.0, 0.0] for name in SCALED} | {"rebound": [0.0, 2.0]}
    table = small_table(coefficients=Coefficients(none, [-2.0, 0.0]))
    many = replace(STOCK, pieces=18)  # log 2 in `pieces`
    value, stock = (
        predict_parameters(many, table).value["rebound"],
        predict_parameters(STOCK, table).value["rebound"],
    )
    assert value / stock == pytest.approx(4.0, rel=1e-9)


def test_intervals_are_the_jackknife():
    """Of two groups whose coordinate differs by -d and +d from all: sqrt(1/2 * 2 d^2) = d."""
    groups = [Coefficients({name: [d, 0.0] for name in SCALED}, [-2.0, 0.0]) for d in (-0.1, 0.1)]
    fitted = predict_parameters(STOCK, small_table(groups=groups))
    for name in ("dt_impact", "rebound", "release_time"):
        assert np.log(fitted.high[name] / fitted.value[name]) == pytest.approx(
            0.1 * 1.6448536, rel=1e-6
        )
        assert fitted.low[name] * fitted.high[name] == pytest.approx(
            fitted.value[name] ** 2, rel=1e-6
        )
    assert fitted.low["h_mean"] <= fitted.value["h_mean"] <= fitted.high["h_mean"]


def test_no_interval_is_wider_than_a_factor_of_five():
    groups = [Coefficients({name: [d, 0.0] for name in SCALED}, [-2.0, 0.0]) for d in (-9.0, 9.0)]
    fitted = predict_parameters(STOCK, small_table(groups=groups))
    for name in ("slump_depth", "release_time"):
        assert np.log(fitted.high[name] / fitted.value[name]) == pytest.approx(1.6448536, rel=1e-6)


def test_a_table_is_read_as_it_was_written():
    table = shipped_table()
    write_table("table.json", table)
    assert read_table("table.json") == table
    for text in ("[1]", "{}", '{"format": 0}', '{"format": 1, "version": "1"}', "{"):
        with open("broken.json", "w") as file:
            file.write(text)
        with pytest.raises(BadInput, match=r"table = broken.json: not a table of transfer"):
            read_table("broken.json")


def test_what_is_outside_of_the_design_is_named():
    assert shipped_table().outside(STOCK) == []
    far = replace(STOCK, drop_height=2.0, modulus=1e10)
    lines = shipped_table().outside(far)
    assert [line.split(" = ")[0] for line in lines] == ["contact time", "drop height"]
    assert "drop height = 2e+03 mm: learnt from" in lines[1]
    assert "outside of what was learnt: drop height" in " ".join(describe_prediction(far))


def test_conditions_of_a_product():
    drop, notes = product_conditions("marshmallow")
    assert (drop.pieces, drop.drop_height, drop.opening_time, drop.restitution) == (
        9,
        0.31,
        0.16,
        0.1,
    ) and notes == []
    assert drop.m_piece == pytest.approx(STOCK.m_piece, rel=1e-3) and drop.modulus == pytest.approx(
        STOCK.modulus
    )
    assert drop.elongation == pytest.approx(STOCK.elongation, abs=0.01)
    nuts, _ = product_conditions("hazelnut", 0.02, settings={"drop.height": 0.2})
    assert (
        nuts.pieces * nuts.m_piece == pytest.approx(0.02, abs=0.6 * nuts.m_piece)
        and nuts.drop_height == 0.2
    )


def test_the_command_predicts_a_product(capsys):
    arguments = [
        "simulate",
        "--product",
        "hazelnut",
        "--target",
        "0.02",
        "--sample",
        "1e-3",
        "--duration",
        "3",
        "--out",
        "a.h5",
    ]
    assert main([*arguments, "--runs", "3", "--draw"]) == 0
    out, err = capsys.readouterr()
    drop, _ = product_conditions("hazelnut", 0.02)
    assert f"3 portion(s) of {drop.pieces} pieces" in out and "predicted by table" in err
    data = load("a.h5")
    expected = predict_parameters(drop)
    assert (
        data["parameters/h_mean"].min()
        < expected.value["h_mean"]
        < data["parameters/h_mean"].max() * 1.1
    )
    mass = drop.m_piece * drop.pieces
    # weight at the end
    np.testing.assert_allclose(-data["mean_force/wb_flaps"][:, -1, 2], mass * 9.81, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--product", "hazelnuts"], "did you mean"),
        (["--product", "mine.toml"], "product = mine.toml: no such file"),
        (["--product", "hazelnut", "--target", "-1"], "target = -1: must be greater than 0 (kg)"),
        (["--product", "hazelnut", "--pieces", "0"], "pieces = 0: must be at least 1"),
        (
            ["--product", "hazelnut", "--m-piece", "0.001"],
            "m_piece = 0.001: follows from the product",
        ),
        (["--product", "hazelnut", "--set", "drop"], "--set 'drop': allowed: section.key=value"),
        (["--product", "hazelnut", "--set", "drop.high=1"], "drop.high"),
        (["--set", "drop.height=1"], "set: changes the scene of a product; give --product"),
        (["--product", "hazelnut", "--fit", "fit.json"], "not allowed with"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, message, capsys):
    try:
        code = main(["simulate", *arguments])
    except SystemExit as stopped:
        code = stopped.code
    error = capsys.readouterr().err
    assert code == 2 and message in error and error.count("\n") == 1


def test_prediction_is_the_same_in_single_precision_of_the_host():
    with jax.enable_x64(False):
        single = predict_parameters(STOCK)
    assert single.value == predict_parameters(STOCK).value
    assert isinstance(single.landings, Landings)
