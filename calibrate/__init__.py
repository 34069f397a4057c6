"""Calibration of the Product Model to impact-force traces by gradient descent, with intervals and a goodness of
fit.
"""

from calibrate.errors import BadInput
from calibrate.fit import Fit, fit
from calibrate.targets import Target, read, target

__all__ = ["BadInput", "Fit", "Target", "fit", "read", "target"]
