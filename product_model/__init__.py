"""The Product Model: impact-force curves of portions of piece goods in real time (Profe, Kostetzer
and Ament, SIMULTECH 2023).

`simulate` makes one portion, `ensemble` many, `stream` a sample at a time; `read_fit` reads the
result of a calibration.
"""

from product_model.program import begin_program

begin_program()

from product_model import stream  # noqa: E402
from product_model.extended import Landings, landings  # noqa: E402
from product_model.fitted import Fitted, drawn, read_fit  # noqa: E402
from product_model.inputs import BadInput, Parameters, check, parameters, table  # noqa: E402
from product_model.monte_carlo import Peaks, bands, ensemble, ensemble_blocks, peaks  # noqa: E402
from product_model.portion import Trace, compiled, simulate  # noqa: E402
from product_model.record import load, save  # noqa: E402
from product_model.weigher import Weigher  # noqa: E402
from product_model.weigher_file import load_weigher, save_weigher  # noqa: E402

__all__ = [
    "BadInput",
    "Fitted",
    "Landings",
    "Parameters",
    "Peaks",
    "Trace",
    "Weigher",
    "bands",
    "check",
    "compiled",
    "drawn",
    "ensemble",
    "ensemble_blocks",
    "landings",
    "load",
    "load_weigher",
    "parameters",
    "peaks",
    "read_fit",
    "save",
    "save_weigher",
    "simulate",
    "stream",
    "table",
]
