"""Monte Carlo: many random portions from one key, and statistics of their forces."""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from product_model.extended import ADDED
from product_model.grid import Grid
from product_model.inputs import DTYPES, LEAVES, BadInput, Parameters, build_grid, check
from product_model.memory import (
    GIGABYTE,
    available_memory,
    check_memory,
    count_pulses,
    portion_bytes,
)
from product_model.portion import (
    Key,
    Leaves,
    Trace,
    as_key,
    in_precision,
    parameter_leaves,
    portion,
    static_parameters,
)

SHORTENING = ("gravity",)  # inputs whose largest value makes the shortest portions
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@partial(jax.jit, static_argnames=("static",))
def _portions(
    leaves: Leaves, keys: jax.Array, static: tuple[tuple[str, Any], ...], varied: Leaves
) -> Trace:
    return jax.vmap(lambda key, own: portion(with_own(leaves, own), key, **dict(static)))(
        keys, varied
    )


def with_own(leaves: Leaves, own: Leaves) -> Leaves:
    """`leaves` with the values of `own`, including those of the landings."""
    added = {name: value for name, value in own.items() if name in ADDED}
    if not added:
        return leaves | own
    return (
        leaves
        | {name: own[name] for name in own if name not in ADDED}
        | {"landings": leaves["landings"].replace(**added)}
    )


def _with_values(params: Parameters, values: Mapping[str, float]) -> Parameters:
    """`params` with these values, including those of the landings."""
    given = with_own({"landings": params.landings}, dict(values))
    return params.replace(**given)


@dataclass(frozen=True)
class _Prepared:
    """Arguments of a program for several portions: leaves, keys [runs], static inputs, varied
    leaves [runs].
    """

    leaves: Leaves
    keys: jax.Array
    static: tuple[tuple[str, Any], ...]
    varied: dict[str, np.ndarray]

    def portions(self, rows: slice) -> Trace:
        """The portions of these rows."""
        return _portions(
            self.leaves,
            self.keys[rows],
            self.static,
            {name: column[rows] for name, column in self.varied.items()},
        )


def widest_grid(params: Parameters, varied: Mapping[str, np.ndarray]) -> Grid:
    """The sample times for portions with varied leaves, name -> [runs]: long enough for the longest
    portion.
    """
    ends = {
        name: float((np.min if name in SHORTENING else np.max)(column))
        for name, column in varied.items()
    }
    return build_grid(_with_values(params, ends))


def _prepare(
    params: Parameters, key: Key, runs: int, varied: Mapping[str, ArrayLike] | None
) -> _Prepared:
    """Checked inputs; call it inside `in_precision`."""
    check(params)
    if runs < 1:
        raise BadInput(f"runs = {runs}: must be at least 1")
    values = {name: np.asarray(column, np.float64) for name, column in (varied or {}).items()}
    for name, column in values.items():
        known = LEAVES if params.landings is None else LEAVES + ADDED
        if name not in known or column.shape != (runs,):
            raise BadInput(
                f"varied: {name} {column.shape}: must be one of {', '.join(known)}, each with {runs} values"
            )
    for k in (np.argmin, np.argmax):  # of each its least and its largest must be an input
        check(
            _with_values(
                params, {name: float(column[k(column)]) for name, column in values.items()}
            )
        )
    keys = jax.random.split(as_key(key), runs)
    own = {name: column.astype(DTYPES[params.precision]) for name, column in values.items()}
    static = static_parameters(params) | {"grid": widest_grid(params, values)}
    return _Prepared(parameter_leaves(params), keys, tuple(static.items()), own)


def ensemble(
    params: Parameters, key: Key, runs: int, varied: Mapping[str, ArrayLike] | None = None
) -> Trace:
    """`runs` independent portions from one key: a `Trace` with a leading axis [runs].

    varied: leaves of `Parameters` that differ from portion to portion, name -> [runs], in the place
    of the inputs'; a trace whose duration is not given is long enough for the largest. Raises
    `BadInput` where an input is out of range, and where the portions do not fit into memory: see
    `ensemble_blocks`. Warns if they take more than half of it.
    """
    with in_precision(params):
        prepared = _prepare(params, key, runs, varied)
        static = dict(prepared.static)
        itemsize = np.dtype(DTYPES[params.precision]).itemsize
        needed = runs * portion_bytes(
            static["grid"].samples, count_pulses(params, static["pieces"]), itemsize
        )
        check_memory(runs, needed, "use ensemble_blocks, a larger sample or f32")
        if needed > (available_memory() or math.inf) / 2:
            warnings.warn(
                f"{runs} portions take {needed / GIGABYTE:.1f} GB of memory; ensemble_blocks takes less",
                stacklevel=2,
            )
        return prepared.portions(slice(None))


def ensemble_blocks(
    params: Parameters,
    key: Key,
    runs: int,
    block: int,
    varied: Mapping[str, ArrayLike] | None = None,
) -> Iterator[Trace]:
    """The portions of `ensemble`, at most `block` at a time: each a `Trace` with a leading axis, in
    order.

    For more portions than memory holds. The forces are those of `ensemble` to rounding.
    Raises `BadInput` where an input is out of range.
    """
    if block < 1:
        raise BadInput(f"block = {block}: must be at least 1")
    size = -(-runs // -(-max(runs, 1) // block))  # of nearly equal blocks
    with in_precision(params):
        prepared = _prepare(params, key, runs, varied)
    for first in range(0, runs, size):
        with in_precision(params):
            yield prepared.portions(slice(first, min(first + size, runs)))


@dataclass(frozen=True)
class Peaks:
    """Peak and duration of the force of each portion, arrays [runs].

    peak_kg: (kg) largest PIF
    peak_time: (s) its time after the release
    first: (s) first impact
    duration: (s) from the first impact to the end of the last pulse
    """

    peak_kg: np.ndarray
    peak_time: np.ndarray
    first: np.ndarray
    duration: np.ndarray

    def quantiles(self, levels: Sequence[float] = QUANTILES) -> dict[str, np.ndarray]:
        """Name -> [levels] quantiles over the runs."""
        return {
            name: np.quantile(getattr(self, name), levels)
            for name in ("peak_kg", "peak_time", "first", "duration")
        }


def peaks(trace: Trace) -> Peaks:
    """Peak PIF, its time and the total duration of every portion of an ensemble (or of one trace:
    [1]).
    """
    force, start, ends = (
        np.atleast_2d(np.asarray(a)) for a in (trace.force, trace.pulses.start, trace.pulses.ends())
    )
    first = start.min(axis=1)
    duration = ends.max(axis=1) - first
    peak = force.max(axis=1) / np.asarray(trace.gravity)
    return Peaks(peak, trace.time[force.argmax(axis=1)], first, duration)


@dataclass(frozen=True)
class Summary:
    """Summary of all portions.

    pieces: number in each portion
    grid: sample times
    peaks: of every portion
    redrawn: number of drop heights drawn again because negative
    late: number of pulses that are not over at the end
    """

    pieces: int
    grid: Grid
    peaks: Peaks
    redrawn: int
    late: int


def summarize(trace: Trace) -> Summary:
    """The summary of one trace or of an ensemble."""
    redrawn, late = (int(np.sum(counts)) for counts in (trace.redrawn, trace.late))
    return Summary(int(trace.height.shape[-1]), trace.grid, peaks(trace), redrawn, late)


def join_summaries(parts: Sequence[Summary]) -> Summary:
    """The summary of all portions of several."""
    names = [f.name for f in fields(Peaks)]
    joined = {name: np.concatenate([getattr(part.peaks, name) for part in parts]) for name in names}
    redrawn, late = sum(part.redrawn for part in parts), sum(part.late for part in parts)
    return Summary(parts[0].pieces, parts[0].grid, Peaks(**joined), redrawn, late)


def bands(trace: Trace, levels: Sequence[float] = QUANTILES) -> np.ndarray:
    """Pointwise quantiles of the PIF over the runs: [levels, T] (kg)."""
    return np.quantile(np.asarray(trace.pif_kg), levels, axis=0)
