"""Ensembles: independence of runs, bands and peaks against direct evaluation."""

import numpy as np
import pytest

from product_model import BadInput, bands, ensemble, parameters, peaks, simulate


@pytest.fixture(scope="module")
def portions():
    return ensemble(parameters(pieces=20, sample=2e-4), 0, 200)


def test_runs_differ_and_repeat(portions):
    assert len(np.unique(np.asarray(portions.height))) == 200 * 20
    np.testing.assert_array_equal(
        portions.force, ensemble(parameters(pieces=20, sample=2e-4), 0, 200).force
    )


def test_bands_are_quantiles_of_the_pif(portions):
    low, mid, high = bands(portions, (0.05, 0.5, 0.95))
    pif = np.asarray(portions.force) / 9.81
    np.testing.assert_allclose(mid, np.median(pif, axis=0), rtol=1e-12)
    assert ((low <= mid) & (mid <= high)).all()
    assert high[-1] == pytest.approx(20 * 5.832e-3)  # all have landed


def test_peaks_of_each_portion(portions):
    found = peaks(portions)
    pif = np.asarray(portions.force) / 9.81
    np.testing.assert_allclose(found.peak_kg, pif.max(1), rtol=1e-12)
    np.testing.assert_allclose(found.peak_time, portions.time[pif.argmax(1)])
    start = np.asarray(portions.pulses.start)
    np.testing.assert_allclose(found.duration, start.max(1) - start.min(1) + 500e-6)
    assert found.quantiles((0.5,))["peak_kg"] == pytest.approx(np.median(pif.max(1)))


def test_one_trace_has_peaks_too():
    assert peaks(simulate(parameters(pieces=3), 0)).peak_kg.shape == (1,)


def test_no_runs_is_an_error():
    with pytest.raises(BadInput, match="runs = 0"):
        ensemble(parameters(), 0, 0)
