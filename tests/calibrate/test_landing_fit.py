"""The fit of the extended model: its parts by exact values, and a small recovery."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibrate import BadInput, landing_fit, landing_model, landing_summaries, two_samples
from calibrate.landing_fit import fit_landings
from calibrate.targets import target
from product_model import Landings, drawn, ensemble, parameters, read_fit

TRUTH = parameters(
    pieces=4, h_mean=0.3, gamma_low=0.006, gamma_high=0.014, dt_impact=690e-6, landings=Landings(impacts=(7, 3, 3, 2, 1)),
    sample=60e-6, start=0.2, duration=0.13,
)  # fmt: skip
FRAME = landing_summaries.TraceFrame(60e-6, 1400)


def traces(count, params=TRUTH, seed=0):
    made = ensemble(params, seed, count)
    return [
        target(made.time, force, params.m_piece, 4, name=f"trace {k}")
        for k, force in enumerate(np.asarray(made.force))
    ]


@pytest.fixture(scope="module")
def many():
    return traces(48)


def test_energy_distance_of_two_points_each():
    """2 E|x - y| - E|x - x'| - E|y - y'| of {0, 1} and {2, 5}: 2 x 3 - 1 - 3."""
    x, y = np.array([[0.0], [1.0]]), np.array([[2.0], [5.0]])
    assert two_samples.compare(x, y, 9).distance == pytest.approx(2.0)


def test_p_of_equal_and_of_different_samples():
    random = np.random.default_rng(0)
    x, y = random.standard_normal((2, 60, 3))
    assert two_samples.compare(x, y).p > 0.05
    assert two_samples.compare(x, y + 1.0).p == pytest.approx(1 / 500)  # the least of 499
    # permutations


def test_coordinates_are_inverted():
    values = Landings().values() | {
        "dt_impact": 7e-4,
        "gamma_low": 5e-3,
        "gamma_high": 2e-2,
        "h_mean": 0.3,
        "cushioning": -0.7,
    }
    again = landing_model.to_values(
        landing_model.to_coordinates(values), landing_model.MODELS["full"]
    )
    assert {name: float(again[name]) for name in landing_model.NAMES} == pytest.approx(values)
    small = landing_model.to_values(
        landing_model.to_coordinates(values), landing_model.MODELS["pulses"]
    )
    assert small["rebound"] == small["early_weight"] == small["release_time"] == 0.0


def test_summaries_of_a_constant_force():
    """g from the first impact on: momentum g t, peaks g, no increments, and a cell that rings to
    almost twice its weight.
    """
    numbers = dict(
        zip(
            FRAME.names,
            np.asarray(landing_summaries.summarize(jnp.full(FRAME.samples, 9.81), FRAME)),
            strict=True,
        )
    )
    for k, name in zip(FRAME.moments, FRAME.names, strict=False):
        assert numbers[name] == pytest.approx(9.81 * 60e-6 * k)
    assert numbers["peak of 0.06 ms"] == pytest.approx(np.log(9.81))
    assert numbers["increments of 0.06 ms"] == pytest.approx(np.log(1e-3), abs=1e-6)
    overshoot = 1 + np.exp(-np.pi * 0.05 / np.sqrt(1 - 0.05**2))
    assert numbers["cell: peak"] == pytest.approx(overshoot, rel=2e-3)  # read at the ends of blocks
    # of 1 ms
    # a bin and a half
    assert numbers["time to half"] == pytest.approx(
        np.log(FRAME.samples * 60e-6 / 2), abs=3 / FRAME.samples
    )


def test_a_simulated_trace_is_what_is_read_from_one(many):
    """The same numbers from the force of a portion and from its trace, but for where in a bin the
    trace begins.
    """
    read = landing_summaries.accelerations(many, FRAME)
    rows = np.array(
        [np.asarray(landing_summaries.summarize(jnp.asarray(row), FRAME)) for row in read[:8]]
    )
    values = TRUTH.landings.values() | {
        n: getattr(TRUTH, n) for n in ("dt_impact", "gamma_low", "gamma_high", "h_mean")
    }
    draws = landing_model.draw_landings(many, 512, 3)
    simulated = np.asarray(
        jax.jit(lambda v: landing_model.simulated_summaries(v, draws, 9.81, FRAME))(values)
    )
    # once in 100 000
    assert (np.abs(rows.mean(0) - simulated.mean(0)) < 4.5 * simulated.std(0) / np.sqrt(8)).all()
    end = simulated[:, FRAME.names.index(FRAME.names[11])]
    assert end.std() < 0.05 * end.mean()


def test_the_frame_needs_short_samples(many):
    assert landing_summaries.find_common_frame(many).bin == pytest.approx(60e-6)
    coarse = traces(1, TRUTH.replace(sample=1e-3))
    with pytest.raises(
        BadInput, match=r"sample = 1000 us: the extended model needs samples of at most 120 us"
    ):
        landing_summaries.find_common_frame(coarse)


def test_too_few_traces_and_unknown_names_are_refused(many):
    with pytest.raises(BadInput, match="8 traces: the extended model needs at least 24"):
        fit_landings(many[:8])
    with pytest.raises(BadInput, match="bounce: unknown"):
        fit_landings(many, {"bounce": 1.0})


@pytest.fixture(scope="module")
def found(many):
    """A short fit from the truth, of one model, with few portions."""
    saved = landing_fit.SEARCHED, landing_fit.BEST, landing_fit.STEPS, landing_fit.JUDGED
    landing_fit.SEARCHED, landing_fit.BEST, landing_fit.STEPS, landing_fit.JUDGED = 1, 1, (4, 8), 64
    try:
        return fit_landings(
            many, TRUTH.landings.values(), models=("full",), simulations=64, force=True
        )
    finally:
        landing_fit.SEARCHED, landing_fit.BEST, landing_fit.STEPS, landing_fit.JUDGED = saved


def test_traces_of_the_extended_model_reject_the_papers_and_accept_it(found):
    assert found.model == "full"
    assert found.judgements["paper"]["p"] < 0.05 <= found.judgements["full"]["p"]
    assert found.judgements["full"]["distance"] < 0.2 * found.judgements["paper"]["distance"]
    assert found.parameters["h_mean"]["value"] == pytest.approx(0.3, rel=0.05)


def test_the_file_of_a_fit_is_read_by_the_product_model(found, tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(found.to_dict()))
    fit = read_fit(path)
    assert fit.landings == found.landings()
    many = drawn(fit, 5)
    assert set(many) == set(landing_model.NAMES) and many["rebound"].shape == (5,)
    tree = found.to_dict()
    tree["parameters"]["rebound"] |= {"value": 1.5, "high": 1.6}
    path.write_text(json.dumps(tree))
    with pytest.raises(BadInput, match="rebound = 1.5: must be a number from 0 to below 1"):
        read_fit(path)


def test_steps_with_other_numbers_end_in_the_mean_of_the_last(monkeypatch):
    """Loss (u - c)^2 of c = -1 and 1 in turn: near 0, where each by itself would pull to its own."""
    from calibrate import landing_loss

    slope = lambda u, _, c: ((u["h"] - c) ** 2, {"h": 2.0 * (u["h"] - c)})
    monkeypatch.setattr(landing_loss, "loss_and_slope", slope)
    told = []
    end = landing_loss.minimize_with_fresh_draws(
        {"h": jnp.asarray(0.8)}, (-1.0, 1.0), (), 100, 0.05, lambda: told.append(1)
    )
    assert len(told) == 100 and abs(float(end["h"])) < 0.05
