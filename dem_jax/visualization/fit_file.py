"""Results of a calibration (fit.json) for a report."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dem_jax.errors import RecordError

SHOWN_PARAMETERS = {  # parameter -> name, unit, factor
    "dt_impact": ("length of an impact, Δt_impact", "µs", 1e6),
    "gamma_low": ("least spread of the heights, γ_low", "mm", 1e3),
    "gamma_high": ("largest spread of the heights, γ_high", "mm", 1e3),
    "h_mean": ("mean drop height, h_mean", "mm", 1e3),
}


@dataclass(frozen=True)
class FitResults:
    """Parameters of a Product Model: name -> (value, low, high), SI, 90 % intervals; statements of
    the fit; its figure.
    """

    parameters: dict[str, tuple[float, float, float]]
    statements: list[str]
    picture: Path | None

    def parameter_rows(self) -> list[list[str]]:
        """A table: the column headings, then one row per parameter."""
        rows = [["", "value", "90 % interval"]]
        for name, row in self.parameters.items():
            words, unit, factor = SHOWN_PARAMETERS[name]
            value, low, high = (f"{factor * x:.4g}" for x in row)
            rows.append([words, f"{value} {unit}", f"{low} to {high} {unit}"])
        return rows


def read_fit(path: str | Path) -> FitResults:
    """The fit of a file that `calibrate fit` wrote, with the figure beside it. Raises RecordError."""
    path = Path(path)
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        rows = {
            name: tuple(float(tree["parameters"][name][key]) for key in ("value", "low", "high"))
            for name in SHOWN_PARAMETERS
        }
        statements = [str(line) for line in tree.get("statements", [])]
    except OSError as error:
        raise RecordError(f"--fit {path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordError(
            f"--fit {path}: not a file of `calibrate fit` ({type(error).__name__}: {error})"
        ) from error
    if not np.isfinite(list(rows.values())).all():
        raise RecordError(
            f"--fit {path}: contains a value that is not a number; allowed: a file of `calibrate fit`"
        )
    picture = path.with_suffix(".png")
    return FitResults(
        {k: (v, low, high) for k, (v, low, high) in rows.items()},
        statements,
        picture if picture.is_file() else None,
    )
