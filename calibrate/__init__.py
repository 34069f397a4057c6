"""Calibration of the Product Model to impact-force traces by gradient descent, with intervals and a
goodness of fit.
"""

import product_model  # noqa: F401  # first: from then on Ctrl-C ends the program at once, while the rest is imported
from calibrate.cell_signals import ScaleSignal, read_scale_signals
from calibrate.csv_table import TableOptions
from calibrate.errors import BadInput
from calibrate.fit import Fit, fit
from calibrate.landing_fit import LandingFit, fit_landings
from calibrate.signal_fit import SignalFit, fit_signals
from calibrate.targets import Target, read, target

__all__ = [
    "BadInput",
    "Fit",
    "LandingFit",
    "ScaleSignal",
    "SignalFit",
    "TableOptions",
    "Target",
    "fit",
    "fit_landings",
    "fit_signals",
    "read",
    "read_scale_signals",
    "target",
]
