"""The parameters of a calibration (fit.json), and random draws within their uncertainty."""

import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from product_model.extended import ADDED, ADDITIONS, Landings, check_landings
from product_model.inputs import BadInput, checked_seed

FITTED = ("dt_impact", "gamma_low", "gamma_high", "h_mean")
NINETY = 1.6448536269514722  # half of a 90 % interval in standard deviations of a normal
# distribution


@dataclass(frozen=True)
class Fitted:
    """Parameters of a fit, in SI units.

    value, low, high: by name of FITTED, and of the additions of the extended model if that was
    fitted; low and high of the 90 % intervals. m_piece (kg), pieces: of the portions that were
    fitted, None where they differ or the file does not give them. landings: the additions of the
    extended model; None: the fit is one of the paper's model.
    """

    value: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    m_piece: float | None = None
    pieces: int | None = None
    landings: Landings | None = None


def read_fit(path: str | PathLike[str]) -> Fitted:
    """The fit of a file that `calibrate fit` wrote. Raises `BadInput` with one line."""
    try:
        tree = json.loads(Path(path).read_text(encoding="utf-8-sig"))
        extended = tree.get("model", "paper") != "paper"
        names = FITTED + ADDED if extended else FITTED
        rows = {
            name: [float(tree["parameters"][name][key]) for key in ("value", "low", "high")]
            for name in names
        }
        impacts = tuple(tree["impacts"]) if extended else ()
        info = tree.get("info", {})
        pieces, mass = ([number for number in info.get(key, [])] for key in ("pieces", "m_piece"))
    except OSError as error:
        raise BadInput(f"fit = {path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInput(
            f"fit = {path}: not a file of `calibrate fit` ({type(error).__name__}: {error})"
        ) from None
    for name, (value, low, high) in rows.items():
        if not (np.isfinite([value, low, high]).all() and low <= value <= high):
            raise BadInput(
                f"fit = {path}: {name} = {value:g}, {low:g} to {high:g}: must be low <= value <= high, all finite"
            )
    values, lows, highs = ({name: row[k] for name, row in rows.items()} for k in range(3))
    one = lambda found, kind: kind(found[0]) if len(found) == 1 else None
    landings = (
        Landings(impacts=impacts).replace(**{name: values[name] for name in ADDED})
        if extended
        else None
    )
    if landings is not None:
        try:
            check_landings(landings)
        except BadInput as error:
            raise BadInput(f"fit = {path}: {error}") from None
    return Fitted(values, lows, highs, one(mass, float), one(pieces, int), landings)


def drawn(fit: Fitted, runs: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Parameters [runs] by name, each by itself: 5 % are below the interval, half below the value,
    5 % above the interval.

    Each side of the value is half a normal distribution, of the logarithm where low > 0; never
    below 0, and gamma_high at least gamma_low.
    """
    if runs < 1:
        raise BadInput(f"runs = {runs}: must be at least 1")
    z = (
        np.random.default_rng([checked_seed(seed), 11]).standard_normal((len(fit.value), runs))
        / NINETY
    )
    found = {
        name: _between(fit.value[name], fit.low[name], fit.high[name], row)
        for name, row in zip(fit.value, z, strict=True)
    }
    for row in ADDITIONS:
        if row.name in found:
            found[row.name] = np.clip(found[row.name], row.low, np.nextafter(row.high, row.low))
    floor = {name: np.maximum(found[name], 0.0) for name in FITTED}
    return found | floor | {"gamma_high": np.maximum(floor["gamma_high"], floor["gamma_low"])}


def _between(value: float, low: float, high: float, z: np.ndarray) -> np.ndarray:
    if low > 0:
        return value * np.exp(np.where(z > 0, z * np.log(high / value), z * np.log(value / low)))
    return value + np.where(z > 0, z * (high - value), z * (value - low))
