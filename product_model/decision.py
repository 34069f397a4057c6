"""A scale that decides: the reading counts when its own error bar is within the tolerance."""

from statistics import NormalDist

import numpy as np

from product_model.inputs import BadInput
from product_model.weigher import EMPTY, Array, Reading

CONFIDENCE = 0.99  # that the weight is within the tolerance


def is_decided(reading: Reading, tolerance: float, confidence: float = CONFIDENCE) -> Array:
    """Whether a reading may be taken: with this confidence its error is within the tolerance (g).

    Raises `BadInput` for a tolerance or a confidence that is none.
    """
    factor = check_decision(tolerance, confidence)
    return (reading.status != EMPTY) & (factor * reading.sd <= tolerance)


def check_decision(tolerance: float, confidence: float) -> float:
    """The number of standard deviations that have this confidence.

    Raises `BadInput` for a tolerance or a confidence that is none.
    """
    if not 0 < tolerance < np.inf:
        raise BadInput(f"tolerance = {tolerance:g} g: allowed: above 0")
    if not 0.5 <= confidence < 1:
        raise BadInput(f"confidence = {confidence:g}: allowed: from 0.5 to below 1")
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence)


def first_decision(reading: Reading, tolerance: float, confidence: float = CONFIDENCE) -> np.ndarray:
    """[..] the first sample at which readings [.., n] may be taken; -1: none.

    Raises `BadInput`, as `is_decided`.
    """
    decided = np.asarray(is_decided(reading, tolerance, confidence))
    return np.where(decided.any(axis=-1), decided.argmax(axis=-1), -1)
