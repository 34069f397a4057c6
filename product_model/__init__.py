"""The Product Model: impact-force curves of portions of piece goods in real time (Profe, Kostetzer and Ament,
SIMULTECH 2023).
"""

from product_model.inputs import BadInput, Parameters, check, parameters, table
from product_model.monte_carlo import Peaks, bands, ensemble, peaks
from product_model.portion import Trace, compiled, simulate
from product_model.record import load, save

__all__ = [
    "BadInput",
    "Parameters",
    "Peaks",
    "Trace",
    "bands",
    "check",
    "compiled",
    "ensemble",
    "load",
    "parameters",
    "peaks",
    "save",
    "simulate",
    "table",
]
