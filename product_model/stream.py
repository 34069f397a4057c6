"""Real time: one sample per call, bounded state, the same numbers as the batch form.

`start` draws a portion and sorts its edges; `step` is a pure function, for use inside a model of the weighing
station that is itself a scan. The state holds the sample counter and a few numbers per piece, and does not grow with
time.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from product_model.grid import Grid
from product_model.inputs import BadInput, Parameters, check
from product_model.model import Pulses
from product_model.portion import Key, as_key, in_precision, leaves_of, portion, static_of

_FAR = 2**30  # sample number no stream reaches


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stream:
    """State of a stream of E = 2 pieces edges.

    bin:    [E]      number of the sample in whose interval each edge lies, ascending
    level:  [E + 1]  (N) force after the first i edges
    excess: [E + 1]  (N) sum over the first i edges of what each adds to the mean of its own bin
    passed: []       number of edges that lie before the next sample's interval
    sample: []       number of the next sample
    """

    bin: jax.Array
    level: jax.Array
    excess: jax.Array
    passed: jax.Array
    sample: jax.Array


def start(params: Parameters, key: Key) -> Stream:
    """A stream of the portion that `simulate(params, key)` makes. Forms: rectangular and interval-mean.

    Raises `BadInput` where an input is out of range or the form is smooth (its pulses begin before the impact, so
    that there is no next sample without looking ahead).
    """
    check(params)
    if params.form == "smooth":
        raise BadInput("form = smooth: a stream is rectangular or interval-mean")
    static = static_of(params)
    with in_precision(params.precision):
        return _sorted_edges(portion(leaves_of(params), as_key(key), **static).pulses, static["grid"], params.form)


@partial(jax.jit, static_argnames=("grid", "form"))
def _sorted_edges(pulses: Pulses, grid: Grid, form: str) -> Stream:
    """Compiled as the batch form is, whose division by the sample time some versions of XLA round otherwise."""
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


def step(stream: Stream) -> tuple[Stream, jax.Array]:
    """(next stream, force [] (N) of this sample). O(log pieces); after the last sample of the grid the static
    weight goes on.
    """
    passed = jnp.searchsorted(stream.bin, stream.sample, side="right", method="scan_unrolled").astype(jnp.int32)
    force = stream.level[stream.passed] + (stream.excess[passed] - stream.excess[stream.passed])
    return Stream(stream.bin, stream.level, stream.excess, passed, stream.sample + 1), force
