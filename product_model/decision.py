"""The decision of a scale: a reading counts once its error bar is within the tolerance.

An interval of 1.96 standard deviations of a reading contains 95 % of the portions. As the standard
deviation is learnt from few portions, errors have the tails of a t distribution of four degrees of
freedom, whose quantiles have a closed form: 99 % are within 3.25 standard deviations instead of
2.58.
"""

import numpy as np

from product_model.inputs import BadInput
from product_model.weigher import EMPTY, Array, Reading

CONFIDENCE = 0.99  # that the weight is within the tolerance
NORMAL_95 = 1.96  # standard deviations of a reading that hold 95 %


def is_decided(reading: Reading, tolerance: float, confidence: float = CONFIDENCE) -> Array:
    """Whether a reading counts: its error is within the tolerance (g) with this confidence.

    Raises `BadInput` for an invalid tolerance or confidence.
    """
    factor = check_decision(tolerance, confidence)
    return (reading.status != EMPTY) & (factor * reading.sd <= tolerance)


def check_decision(tolerance: float, confidence: float) -> float:
    """The number of standard deviations of a reading that have this confidence.

    Raises `BadInput` for an invalid tolerance or confidence.
    """
    if not 0 < tolerance < np.inf:
        raise BadInput(f"tolerance = {tolerance:g} g: allowed: above 0")
    if not 0.5 <= confidence < 1:
        raise BadInput(f"confidence = {confidence:g}: allowed: from 0.5 to below 1")
    return NORMAL_95 * t_quantile(0.5 + 0.5 * confidence) / t_quantile(0.975)


def t_quantile(share: float) -> float:
    """Quantile of Student's t distribution of four degrees of freedom.

    Args:
        share: probability below it, from 0.5 to below 1.

    Source: W. T. Shaw, Journal of Computational Finance 9(4), 2006, eq. 37.
    """
    root = np.sqrt(4 * share * (1 - share))
    return float(2 * np.sqrt(max(np.cos(np.arccos(root) / 3) / root - 1, 0.0)))


def first_decision(
    reading: Reading, tolerance: float, confidence: float = CONFIDENCE
) -> np.ndarray:
    """[..] the first sample at which readings [.., n] count; -1: none.

    Raises `BadInput`, as `is_decided`.
    """
    decided = np.asarray(is_decided(reading, tolerance, confidence))
    return np.where(decided.any(axis=-1), decided.argmax(axis=-1), -1)
