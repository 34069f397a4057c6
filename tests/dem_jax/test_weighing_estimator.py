"""weigh --weigher: readings of an estimator beside those of filters."""

import numpy as np
import pytest

from dem_jax.visualization.scale_readings import estimate_drops
from dem_jax.weighing.tuning import Drops
from product_model import Weigher, save_weigher

H, OMEGA, ROWS, LEAD = 1e-3, 2 * np.pi * 50.0, 100, 80  # s, 1/s, samples


@pytest.fixture
def path(tmp_path):
    """The file of an estimator of pieces that lie down on a rigid, heavy bucket without impact."""
    weigher = Weigher(
        interval=H, omega=OMEGA, delta=1e-6 * OMEGA, mass=1e9, stiffness_sd=1e-6, damping_sd=1e-6,
        kick=1.0, kick_rate=1e-6, load_rate=1e-6, white=0.01, line=np.zeros(2), line_innovation=0.0,
        drift=1e-6, level=1.0, weight=50.0, least=5.0, most=500.0, impulse=np.full(ROWS, H),
        shapes=np.zeros((ROWS, 1)), residual=np.full(ROWS, 1e-6), residual_decay=0.9,
        landed=np.ones(ROWS), pulse=np.zeros(ROWS), widening=np.ones(ROWS),
        check_mean=np.zeros((ROWS, 3)), check_sd=np.ones((ROWS, 3)), check_decay=0.95, threshold=np.full(3, 4.0),
        sections=np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), filter_sd=np.full(ROWS, 50.0), settled=ROWS,
    )  # fmt: skip
    save_weigher(weigher, tmp_path / "weigher.json")
    return str(tmp_path / "weigher.json")


def test_a_step_is_weighed_within_five_samples_while_the_cell_rings(path):
    time = H * np.arange(1, LEAD + ROWS + 1)
    since = np.maximum(time - LEAD * H, 0.0)
    integral = since - np.sin(OMEGA * since) / OMEGA  # of 1 - cos, the ringing without damping
    signal = 0.04 * np.diff(integral, prepend=0.0)[None, :] / H
    drops = Drops(time, signal, np.array([0.04]), np.array([LEAD * H]))
    row, words = estimate_drops("step", drops, 1000.0, path)
    assert row.find_times_to_weigh(1e-3).impact[0] < 0.0055  # at the fifth sample
    assert np.abs(signal[0, -20:] - 0.04).max() > 0.03
    assert "doubted in 0 of 1" in words


@pytest.mark.parametrize(
    ("rate", "file", "words"),
    [(500.0, None, "rate = 500: allowed: 1000"), (1000.0, "no.json", "no.json: cannot be read")],
)
def test_bad_input_is_one_line(path, rate, file, words):
    drops = Drops(H * np.arange(1, 101), np.zeros((1, 100)), np.array([0.04]), np.array([0.05]))
    with pytest.raises(ValueError, match=words):
        estimate_drops("step", drops, rate, file or path)
