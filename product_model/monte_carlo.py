"""Monte Carlo: many random portions from one key, and what their forces have in common."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from product_model.inputs import DTYPES, LEAVES, BadInput, Parameters, check, grid_of
from product_model.portion import Key, Leaves, Trace, as_key, in_precision, leaves_of, portion, static_of

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@partial(jax.jit, static_argnames=("static",))
def _portions(leaves: Leaves, keys: jax.Array, static: tuple[tuple[str, Any], ...], varied: Leaves) -> Trace:
    return jax.vmap(lambda key, own: portion(leaves | own, key, **dict(static)))(keys, varied)


def ensemble(params: Parameters, key: Key, runs: int, varied: Mapping[str, ArrayLike] | None = None) -> Trace:
    """`runs` independent portions from one key: a `Trace` with a leading axis [runs].

    varied: leaves of `Parameters` that differ from portion to portion, name -> [runs], in the place of the inputs'; a trace
    whose duration is not given is long enough for the largest.
    Raises `BadInput` where an input is out of range.
    """
    check(params)
    if runs < 1:
        raise BadInput(f"runs = {runs}: must be at least 1")
    values = {name: np.asarray(column, np.float64) for name, column in (varied or {}).items()}
    for name, column in values.items():
        if name not in LEAVES or column.shape != (runs,):
            raise BadInput(f"varied: {name} {column.shape}: must be one of {', '.join(LEAVES)}, each with {runs} values")
    for k in (np.argmin, np.argmax):  # of each its least and its largest must be an input
        check(params.replace(**{name: float(column[k(column)]) for name, column in values.items()}))
    widest = params.replace(**{name: float((np.min if name == "gravity" else np.max)(column)) for name, column in values.items()})
    with in_precision(params.precision):
        keys = jax.random.split(as_key(key), runs)
        own = {name: column.astype(DTYPES[params.precision]) for name, column in values.items()}
        static = static_of(params) | {"grid": grid_of(widest)}
        return _portions(leaves_of(params), keys, tuple(static.items()), own)


@dataclass(frozen=True)
class Peaks:
    """What a designer asks of each portion, arrays [runs].

    peak_kg:   (kg) largest PIF;  peak_time: (s) when it occurs after release
    first:     (s)  first impact;  duration: (s) from the first impact to the end of the last pulse
    """

    peak_kg: np.ndarray
    peak_time: np.ndarray
    first: np.ndarray
    duration: np.ndarray

    def quantiles(self, levels: Sequence[float] = QUANTILES) -> dict[str, np.ndarray]:
        """Name -> [levels] quantiles over the runs."""
        return {name: np.quantile(getattr(self, name), levels) for name in ("peak_kg", "peak_time", "first", "duration")}


def peaks(trace: Trace) -> Peaks:
    """Peak PIF, its time and the total duration of every portion of an ensemble (or of one trace: [1])."""
    force, start = np.atleast_2d(np.asarray(trace.force)), np.atleast_2d(np.asarray(trace.pulses.start))
    first, last = start.min(axis=1), start.max(axis=1)
    duration = last - first + np.asarray(trace.pulses.duration)
    peak = force.max(axis=1) / np.asarray(trace.gravity)
    return Peaks(peak, trace.time[force.argmax(axis=1)], first, duration)


def bands(trace: Trace, levels: Sequence[float] = QUANTILES) -> np.ndarray:
    """Pointwise quantiles of the PIF over the runs: [levels, T] (kg)."""
    return np.quantile(np.asarray(trace.pif_kg), levels, axis=0)
