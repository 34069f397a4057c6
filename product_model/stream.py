"""Real time: one sample per call, bounded state, the same numbers as the batch form.

`start` draws a portion and sorts its edges; `step` is a pure function, for use inside a model of
the weighing station that is itself a scan. The state holds the sample counter and a few numbers per
piece, and does not grow with time.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from product_model.grid import Grid
from product_model.inputs import BadInput, Parameters, check
from product_model.model import Triangles
from product_model.portion import (
    Key,
    as_key,
    in_precision,
    parameter_leaves,
    portion,
    static_parameters,
)
from product_model.pulses import PulseTrain, mean_ramp, sampled_ramp, triangle_corners, wide_dtype

_FAR = 2**30  # sample number no stream reaches


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stream:
    """State of a stream of E edges; the paper's model has two for each piece.

    bin: [E] number of the sample in whose interval each edge lies, ascending
    level: [E + 1] (N) force after the first i edges
    excess: [E + 1] (N) sum, over the first i edges, of the contribution of each to the mean of its
    own bin
    passed: [] number of edges that lie before the next sample's interval
    sample: [] number of the next sample
    slope: [E + 1] (N) change of the force in each sample after the first i edges, some of which are
    corners of pulses; level is then the force of the sample in which edge i - 1 lies. None: the
    force is constant between edges
    """

    bin: jax.Array
    level: jax.Array
    excess: jax.Array
    passed: jax.Array
    sample: jax.Array
    slope: jax.Array | None = None


def start(params: Parameters, key: Key) -> Stream:
    """A stream of the portion that `simulate(params, key)` makes. Forms: rectangular and
    interval-mean.

    Raises `BadInput` where an input is out of range or the form is smooth (its pulses begin before
    the impact, so that there is no next sample without looking ahead).
    """
    check(params)
    if params.form == "smooth":
        raise BadInput("form = smooth: a stream is rectangular or interval-mean")
    static = static_parameters(params)
    with in_precision(params):
        pulses = portion(parameter_leaves(params), as_key(key), **static).pulses
        triangles = pulses.triangles(wide_dtype())
        if triangles is not None:
            return _sorted_corners(pulses, triangles, static["grid"], params.form)
        return _sorted_edges(pulses, static["grid"], params.form)


@partial(jax.jit, static_argnames=("grid", "form"))
def _sorted_edges(pulses: PulseTrain, grid: Grid, form: str) -> Stream:
    """Sorted edges of a portion, compiled as in the batch form, as some versions of XLA round its
    division by the sample time differently.
    """
    times, jumps = pulses.edges()
    position = (times - grid.start) / grid.sample
    order = jnp.argsort(position)
    position, jumps = jnp.maximum(position[order], 0.0), jumps[order]
    whole = jnp.ceil(position) - 1.0 if form == "rectangular" else jnp.floor(position)
    share = jnp.ones_like(position) if form == "rectangular" else 1.0 - (position - whole)
    nothing = jnp.zeros(1, jumps.dtype)
    return Stream(
        bin=jnp.minimum(jnp.maximum(whole, 0.0), float(_FAR)).astype(jnp.int32),
        level=jnp.concatenate([nothing, jnp.cumsum(jumps)]),
        excess=jnp.concatenate([nothing, jnp.cumsum(jumps * share)]),
        passed=jnp.zeros((), jnp.int32),
        sample=jnp.zeros((), jnp.int32),
    )


@partial(jax.jit, static_argnames=("grid", "form"))
def _sorted_corners(pulses: PulseTrain, triangles: Triangles, grid: Grid, form: str) -> Stream:
    """The stream of a force that has slopes; sums are taken in the widest dtype, as rounding errors
    of a slope grow with time.
    """
    wide, dtype = wide_dtype(), pulses.edges()[1].dtype
    edges, jumps = pulses.edges()
    corners = triangle_corners(triangles, grid)
    position = jnp.concatenate(
        [(edges.astype(wide) - grid.start) / grid.sample, corners.position.reshape(-1)]
    )
    jump = jnp.concatenate([jumps.astype(wide), jnp.zeros(corners.change.size, wide)])
    slope = jnp.concatenate([jnp.zeros(len(jumps), wide), corners.change.reshape(-1)])
    sampled = form == "rectangular"
    whole = jnp.where(
        jnp.asarray(sampled) & (slope == 0.0), jnp.ceil(position) - 1.0, jnp.floor(position)
    )
    whole = jnp.clip(whole, 0.0, float(_FAR))
    after = position - whole
    share = jnp.ones_like(after) if sampled else 1.0 - jnp.maximum(after, 0.0)
    risen = jnp.where(after < 0.0, 0.5 - after, mean_ramp(after)[0])
    excess = jump * share + slope * (sampled_ramp(after)[0] if sampled else risen)
    height = (1.0 if sampled else 0.5) - after  # of the ramp in the sample of its corner
    order = jnp.argsort(whole)
    whole, jump, slope, excess, height = (
        values[order] for values in (whole, jump, slope, excess, height)
    )
    nothing = jnp.zeros(1, wide)
    slopes_after = jnp.concatenate([nothing, jnp.cumsum(slope)])
    moved = slopes_after[:-1] * jnp.diff(whole, prepend=whole[:1])
    level = jnp.concatenate([nothing, jnp.cumsum(jump + slope * height + moved)])
    return Stream(
        bin=whole.astype(jnp.int32),
        level=level.astype(dtype),
        excess=jnp.concatenate([nothing, jnp.cumsum(excess)]).astype(dtype),
        passed=jnp.zeros((), jnp.int32),
        sample=jnp.zeros((), jnp.int32),
        slope=slopes_after.astype(dtype),
    )


def step(stream: Stream) -> tuple[Stream, jax.Array]:
    """(next stream, force [] (N) of this sample). O(log pieces); after the last sample of the grid
    the static weight remains.
    """
    passed = jnp.searchsorted(
        stream.bin, stream.sample, side="right", method="scan_unrolled"
    ).astype(jnp.int32)
    force = stream.level[stream.passed] + (stream.excess[passed] - stream.excess[stream.passed])
    if stream.slope is not None:
        since = stream.sample - stream.bin[jnp.maximum(stream.passed - 1, 0)]
        force = force + stream.slope[stream.passed] * since.astype(force.dtype)
    return replace(stream, passed=passed, sample=stream.sample + 1), force
