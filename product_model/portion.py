"""One random portion: from the inputs and a key to the force over time."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from product_model import draws, fall, model
from product_model import pulses as sharp
from product_model import smooth as smoothed
from product_model.draws import DType
from product_model.extended import LandingPulses, count_numbers, landing_numbers, landing_pulses
from product_model.grid import Grid
from product_model.inputs import (
    DTYPES,
    LEAVES,
    Parameters,
    build_grid,
    check,
    checked_seed,
    count_pieces,
)

Key = int | np.integer | jax.Array  # a random key of JAX, or an integer seed
Leaves = dict[str, Any]  # name -> [] array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trace:
    """The force of one portion, or of several with a leading axis [runs] on every array.

    force: [T] (N) total force in the requested form, downward positive
    pulses: [pieces] start (s), duration (s), force (N), weight (N) of every piece's pulse; in the
    extended model those of `LandingPulses`
    height: [pieces] (m) drop heights
    sigma_height: [] (m) their standard deviation in this portion, eqs 19-22
    again: [pieces] True where the drop height would have been negative and was drawn again
    gravity: [] (m/s2)
    grid: static, sample times
    """

    force: jax.Array
    pulses: model.Pulses | LandingPulses
    height: jax.Array
    sigma_height: jax.Array
    again: jax.Array
    gravity: jax.Array
    grid: Grid = field(metadata={"static": True})

    @property
    def time(self) -> np.ndarray:
        """[T] (s) sample times after release, double precision."""
        return self.grid.times()

    @property
    def pif_kg(self) -> np.ndarray:
        """[T] (kg) product impact force as a weight, eq. 24."""
        return _concrete(self.force) / self._over_time(_concrete(self.gravity))

    @property
    def pif_g(self) -> np.ndarray:
        """[T] (g) product impact force as a weight, eq. 24."""
        return 1e3 * self.pif_kg

    @property
    def redrawn(self) -> np.ndarray:
        """[] pieces whose drop height would have been negative and was drawn again."""
        return _concrete(self.again).sum(axis=-1)

    @property
    def late(self) -> np.ndarray:
        """[] pieces whose pulse is not over at the last sample: lengthen the trace if there are
        any.
        """
        return (_concrete(self.pulses.ends()) > self.grid.end).sum(axis=-1)

    def settled_mass(self) -> np.ndarray:
        """[T] (kg) mass whose weight rests on the flaps at each sample time: the static weight of
        Fig. 6 over g.
        """
        end, weight = (
            np.asarray(values, np.float64) for values in _in_double(self.pulses).weight_steps()
        )
        mass = weight / np.asarray(self._over_time(self.gravity), np.float64)
        if end.ndim == 1:
            return _settled_mass(self.time, end, mass)
        return np.stack([_settled_mass(self.time, e, m) for e, m in zip(end, mass, strict=True)])

    def _over_time(self, value: Any) -> Any:
        return value[..., None] if getattr(value, "ndim", 0) else value


def _concrete(value: Any) -> Any:
    """A concrete value as a NumPy array, so that its precision does not depend on the global flag;
    a traced value unchanged.
    """
    return value if isinstance(value, jax.core.Tracer) else np.asarray(value)


def _in_double(pulses: Any) -> Any:
    """`pulses` as NumPy arrays in double precision."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), pulses)


def _settled_mass(time: np.ndarray, end: np.ndarray, mass: np.ndarray) -> np.ndarray:
    order = np.argsort(end)
    total = np.concatenate([[0.0], np.cumsum(mass[order])])
    return total[np.searchsorted(end[order], time, side="right")]


def render(
    pulses: model.Pulses | LandingPulses, grid: Grid, form: str, smooth_width: float
) -> jax.Array:
    """Force [T] (N) of `pulses` in one of the three forms."""
    if form == "rectangular":
        return sharp.rectangular(pulses, grid)
    if form == "interval-mean":
        return sharp.interval_mean(pulses, grid)
    return smoothed.smooth(pulses, grid, smooth_width)


def random_numbers(
    key: jax.Array, pieces: int, dtype: DType, more: int = 0
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Draw the random numbers of a portion: z [] normal for its spread, v [pieces] uniform on (-1,
    1) for its drop heights, and [pieces, more] further uniform numbers, which change none of the
    others.

    All come from one call of the generator, whose fixed cost on a CPU exceeds that of filling the
    array.
    """
    lowest = np.nextafter(np.array(-1.0, dtype), np.array(0.0, dtype))
    v = draws.uniform(key, 1 + pieces * (1 + more), dtype, lowest, 1.0)
    return fall.standard_normal(v[0]), v[1 : pieces + 1], v[pieces + 1 :].reshape(pieces, more)


@partial(jax.jit, static_argnames=("pieces", "grid", "form", "smooth_width"))
def portion(
    leaves: Leaves, key: jax.Array, *, pieces: int, grid: Grid, form: str, smooth_width: float
) -> Trace:
    """Eqs 9-22 for one key. leaves: dict of the names in `LEAVES`, [] each and all of one dtype,
    which is that of the result; "landings", if any, the additions of the extended model.
    """
    extended = leaves.get("landings")
    more = 0 if extended is None else count_numbers(extended.impacts)
    z, v, numbers = random_numbers(key, pieces, jnp.result_type(leaves["h_mean"]), more)
    sigma = fall.sigma_height(leaves["gamma_low"], leaves["gamma_high"], z)
    height, again = fall.drop_heights(leaves["h_mean"], sigma, v)
    mass = jnp.broadcast_to(leaves["m_piece"], (pieces,))
    pulses: model.Pulses | LandingPulses
    if extended is None:
        pulses = model.pulses(height, mass, leaves["dt_impact"], leaves["gravity"])
    else:
        given = leaves["dt_impact"], leaves["h_mean"], leaves["gravity"]
        landed = landing_pulses(
            extended, height, mass, *given, landing_numbers(numbers, extended.impacts)
        )
        pulses = lax.optimization_barrier(landed)  # else XLA computes them once for each use
    return Trace(
        force=render(pulses, grid, form, smooth_width).astype(height.dtype),
        pulses=pulses,
        height=height,
        sigma_height=sigma,
        again=again,
        gravity=leaves["gravity"],
        grid=grid,
    )


def in_precision(params: Parameters) -> contextlib.AbstractContextManager[Any]:
    """Context that allows arrays of the precision of `params`, regardless of the global flag.

    Landings are rendered in double precision, in f32 as well: slopes that are summed up twice lose
    four digits otherwise.
    """
    double = params.precision == "f64" or params.landings is not None
    needed = double and not jax.config.jax_enable_x64  # type: ignore[attr-defined]
    return jax.enable_x64(True) if needed else contextlib.nullcontext()


def parameter_leaves(params: Parameters) -> Leaves:
    """The leaves of `params` in its precision; call it inside `in_precision`."""
    dtype = DTYPES[params.precision]
    leaves = {name: _cast(getattr(params, name), dtype) for name in LEAVES}
    if params.landings is None:
        return leaves
    added = {name: _cast(value, dtype) for name, value in params.landings.values().items()}
    return leaves | {"landings": params.landings.replace(**added)}


def _cast(value: Any, dtype: DType) -> np.ndarray | jax.Array:
    return (
        jnp.asarray(value).astype(dtype)
        if isinstance(value, jax.Array)
        else np.asarray(value, dtype)
    )


def static_parameters(params: Parameters) -> dict[str, Any]:
    """The static choices that define the program; a new set needs a new compilation."""
    return {
        "pieces": count_pieces(params),
        "grid": build_grid(params),
        "form": params.form,
        "smooth_width": params.smooth_width,
    }


def as_key(key: Key) -> jax.Array:
    """A random key from a key or a whole number as seed. Raises `BadInput` for a seed that is no
    such number.
    """
    return key if isinstance(key, jax.Array) else jax.random.key(checked_seed(key))


def simulate(params: Parameters, key: Key) -> Trace:
    """The product impact force of one random portion (eqs 9-22).

    params: `Parameters`; key: a jax random key, or an integer seed. The same key gives the same
    trace. Raises `BadInput` with one line where an input is out of range. Compiles once for each
    set of static inputs; in a loop that counts microseconds use `compiled`.
    """
    check(params)
    with in_precision(params):
        return portion(parameter_leaves(params), as_key(key), **static_parameters(params))


def compiled(params: Parameters) -> Callable[[jax.Array], Trace]:
    """`key -> Trace` with all checks done and all inputs fixed beforehand: the fast way to many
    traces of one set of inputs.

    The first call compiles. Where every trace is waited for,
    `jax.config.update("jax_cpu_enable_async_dispatch", False)` at the start of the program saves a
    quarter of the time on a CPU. Only random arrays come out of the compiled program, as each array
    costs microseconds; the others are made once.
    """
    check(params)
    static = static_parameters(params)
    if params.landings is not None:
        return _compiled_landings(params, static)
    with in_precision(params):
        leaves = parameter_leaves(params)
        weight = jnp.full(static["pieces"], leaves["m_piece"] * leaves["gravity"])
        duration, gravity = jnp.asarray(leaves["dt_impact"]), jnp.asarray(leaves["gravity"])

    @jax.jit
    def random_parts(key: jax.Array) -> tuple[jax.Array, ...]:
        trace = portion(leaves, key, **static)
        return (
            trace.force,
            trace.pulses.start,
            trace.pulses.force,
            trace.height,
            trace.sigma_height,
            trace.again,
        )

    def run(key: jax.Array) -> Trace:
        force, start, height_of_pulse, height, sigma, again = random_parts(key)
        pulses = model.Pulses(start, duration, height_of_pulse, weight)
        return Trace(force, pulses, height, sigma, again, gravity, static["grid"])

    return run if isinstance(in_precision(params), contextlib.nullcontext) else _within_x64(run)


def _compiled_landings(params: Parameters, static: dict[str, Any]) -> Callable[[jax.Array], Trace]:
    with in_precision(params):
        leaves = parameter_leaves(params)
    run = jax.jit(lambda key: portion(leaves, key, **static))
    return run if isinstance(in_precision(params), contextlib.nullcontext) else _within_x64(run)


def _within_x64(run: Callable[[jax.Array], Trace]) -> Callable[[jax.Array], Trace]:
    def in_double(key: jax.Array) -> Trace:
        with jax.enable_x64(True):
            return run(key)

    return in_double
