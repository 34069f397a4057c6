"""Portions of a fit: its parameters, draws from its intervals, and the stream, from Python and the
command line.
"""

import json

import jax
import numpy as np
import pytest

from product_model import BadInput, drawn, ensemble, load, parameters, read_fit, simulate
from product_model.__main__ import main

ROWS = {
    "dt_impact": (4e-4, 3e-4, 6e-4),
    "gamma_low": (0.03, 0.02, 0.04),
    "gamma_high": (0.05, 0.04, 0.09),
    "h_mean": (0.2, 0.19, 0.22),
}
SHORT = ["--sample", "1e-3", "--duration", "0.3"]


def fit_file(**changes):
    rows = {
        name: dict(zip(("value", "low", "high"), row, strict=True))
        for name, row in (ROWS | changes).items()
    }
    with open("fit.json", "w") as file:
        json.dump({"parameters": rows, "info": {"pieces": [7], "m_piece": [4e-3]}}, file)
    return "fit.json"


def test_a_portion_of_a_fit_has_its_parameters(capsys):
    arguments = ["simulate", "--fit", fit_file(), *SHORT]
    assert main([*arguments, "--out", "a.h5"]) == 0
    assert "1 portion(s) of 7 pieces of 4 g" in capsys.readouterr().out
    params = parameters(
        pieces=7,
        m_piece=4e-3,
        sample=1e-3,
        duration=0.3,
        **{name: row[0] for name, row in ROWS.items()},
    )
    expected = simulate(params, jax.random.split(jax.random.key(0), 1)[0])
    np.testing.assert_allclose(
        -load("a.h5")["mean_force/wb_flaps"][:, 2], expected.force, atol=1e-12
    )
    # what is given wins
    assert main([*arguments, "--h-mean", "0.3", "--pieces", "4", "--out", "b.h5"]) == 0
    assert (
        load("b.h5")["pieces/drop_height"].shape == (4,)
        and "h_mean = 0.3" in load("b.h5")["attrs"]["scene"]
    )


def test_draws_fill_the_intervals():
    found = drawn(read_fit(fit_file()), 20000, seed=1)
    for name, (value, low, high) in ROWS.items():
        if name != "gamma_high":  # which is raised to gamma_low where it is below
            np.testing.assert_allclose(
                np.quantile(found[name], [0.05, 0.5, 0.95]), [low, value, high], rtol=0.02
            )
    assert (found["gamma_high"] >= found["gamma_low"]).all()
    still = drawn(
        read_fit(fit_file(gamma_low=(0.0, 0.0, 0.01), dt_impact=(4e-4, 4e-4, 4e-4))), 1000
    )
    assert (still["gamma_low"] >= 0).all() and (still["dt_impact"] == 4e-4).all()


def test_each_portion_has_parameters_of_its_own(capsys):
    assert (
        main(
            [
                "simulate",
                "--fit",
                fit_file(),
                "--draw",
                "--runs",
                "3",
                "--sample",
                "1e-3",
                "--seed",
                "5",
                "--out",
                "a.h5",
            ]
        )
        == 0
    )
    data, expected = load("a.h5"), drawn(read_fit("fit.json"), 3, 5)
    params = parameters(
        pieces=7, m_piece=4e-3, sample=1e-3, **{name: row[0] for name, row in ROWS.items()}
    )
    made = ensemble(params, 5, 3, expected)
    np.testing.assert_allclose(-data["mean_force/wb_flaps"][..., 2], made.force, atol=1e-12)
    for name, values in expected.items():
        np.testing.assert_array_equal(data[f"parameters/{name}"], values)
    # A portion by itself with those inputs has the same drop heights.
    own = params.replace(**{name: float(values[1]) for name, values in expected.items()})
    one = simulate(own, jax.random.split(jax.random.key(5), 3)[1])
    np.testing.assert_allclose(made.height[1], one.height, rtol=1e-12)
    assert made.late.sum() == 0 and "warning" not in capsys.readouterr().err


def test_the_stream_prints_the_trace(capsys):
    assert main(["stream", "--pieces", "5", "--seed", "2", *SHORT]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head == "time_s,force_n,pif_g"
    table = np.array([[float(cell) for cell in line.split(",")] for line in lines])
    expected = simulate(parameters(pieces=5, sample=1e-3, duration=0.3), 2)
    np.testing.assert_allclose(table[:, 0], expected.time, rtol=1e-8)
    np.testing.assert_allclose(table[:, 1], expected.force, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(table[:, 2], expected.pif_g, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["simulate", "--fit", "nothing.json"],
            "fit = nothing.json: cannot be read (No such file or directory)",
        ),
        (["simulate", "--fit", "other.json"], "fit = other.json: not a file of `calibrate fit`"),
        (["simulate", "--draw"], "draw: needs the intervals of a fit; give --fit FILE"),
        (
            ["simulate", "--out", "other.json/x.h5"],
            "out = other.json/x.h5: the folder does not exist",
        ),
        (["stream", "--h-mean", "-1"], "h_mean = -1.0: must be greater than 0 (m)"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, message, capsys):
    with open("other.json", "w") as file:
        file.write("[1]")
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_bad_values_of_portions_are_refused():
    for varied, message in (
        ({"h_mean": [0.2, -0.1]}, "h_mean = -0.1: must be greater than 0"),
        ({"height": [0.2, 0.1]}, "varied: height"),
        ({"h_mean": [0.2]}, "each with 2 values"),
    ):
        with pytest.raises(BadInput, match=message):
            ensemble(parameters(), 0, 2, varied)
    with pytest.raises(BadInput, match="low <= value <= high"):
        read_fit(fit_file(h_mean=(0.2, 0.3, 0.4)))
