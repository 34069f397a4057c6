"""Readings of a load cell under the pulses of a portion, in closed form and differentiable.

Between the edges of pulses (eqs 9-17) the force is constant, and the cell a damped oscillator of
constant mass:

    (M + p) x'' + c x' + k x = F,    reading = (k x + c x') / g + tare

M is the mass of the empty bucket, p of the pieces whose pulses are over. With u = k x / g in kg the
numbers of the empty cell are its angular frequency omega = sqrt(k / M), its damping ratio
zeta = c / (2 M omega) and 1 / M; gravity cancels.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

SHARED = ("log_omega", "damping_ratio", "inverse_mass", "squared_pulse")
# then the middles of the pulses and, where pieces differ in weight, their relative differences
LOCAL = ("release", "tare", "level", "rate", "weight")
PULSE = SHARED.index("squared_pulse")


class Segments(NamedTuple):
    """Constants of the intervals between edges.

    begin: [E] (s); force: [E] (kg); mass: [E] (M + p) / M; state at the beginning: level [E] (kg),
    rate [E] (kg/s), and the integral of the reading [E] (kg s)."""

    begin: jax.Array
    force: jax.Array
    mass: jax.Array
    level: jax.Array
    rate: jax.Array
    integral: jax.Array


def piece_middles(local: Any, pieces: int) -> Any:
    """[.., pieces] (s) middles of the pulses."""
    return local[..., len(LOCAL) : len(LOCAL) + pieces]


def fall_times(shared: jax.Array, local: jax.Array, pieces: int) -> jax.Array:
    """[pieces] (s) from the release to the beginning of each pulse."""
    return piece_middles(local, pieces) - 0.5 * jnp.sqrt(shared[PULSE]) - local[0]


def piece_masses(local: jax.Array, share: jax.Array) -> jax.Array:
    """[pieces] (kg): equal, or from the numbers behind the middles of the pulses."""
    differences = local[len(LOCAL) + share.shape[0] :]
    if differences.shape[0]:
        share = share * (1.0 + differences)
        share = share / jnp.sum(share)
    return local[LOCAL.index("weight")] * share


def respond(
    shared: jax.Array, local: jax.Array, share: jax.Array, edges: jax.Array, is_mean: jax.Array
) -> jax.Array:
    """Readings of one portion.

    Args:
        shared: [4] ln of the angular frequency of the empty cell (rad/s), its damping ratio, one
            over its mass (1/kg), and the squared length of a pulse (s2).
        local: [5 + pieces] or [5 + 2 pieces] moment of the release (s), tare (kg), level (kg) and
            rate (kg/s) of the cell at the first edge, weight of the portion (kg), middles of the
            pulses (s), and relative differences of the weights of pieces from their mean.
        share: [pieces] of the weight; 0 for a piece that is not there.
        edges: [T + 1] (s) ends of the sample intervals, the first one where the readings begin.
        is_mean: [] 1: means over the intervals, as converters make them; 0: values at their ends.

    Returns:
        [T] (kg).
    """
    omega, damping = jnp.exp(shared[0]), shared[1]
    segments = _propagate(
        omega, damping, *_forces(shared, local, share, edges[0]), local[2], local[3]
    )
    place = jnp.searchsorted(segments.begin, edges, side="right") - 1
    level, rate, integral = _advance(
        omega, damping, Segments(*(row[place] for row in segments)), edges
    )
    point = level[1:] + 2.0 * damping / omega * rate[1:]
    mean = jnp.diff(integral) / jnp.diff(edges)
    return local[1] + point + is_mean * (mean - point)


def _forces(
    shared: jax.Array, local: jax.Array, share: jax.Array, start: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Beginnings of the segments [2 pieces + 1] (s), forces (kg) and masses over M in them."""
    duration = jnp.sqrt(shared[PULSE])
    mass, middle = piece_masses(local, share), piece_middles(local, share.shape[0])
    pulse = mass * fall_times(shared, local, share.shape[0]) / duration
    times = jnp.concatenate([middle - 0.5 * duration, middle + 0.5 * duration])
    order = jnp.argsort(times)
    forces = jnp.cumsum(jnp.concatenate([pulse, mass - pulse])[order])
    masses = jnp.cumsum(jnp.concatenate([jnp.zeros_like(mass), mass])[order])
    first = jnp.zeros_like(forces[:1])
    begin = jnp.concatenate([start[None], jnp.maximum(times[order], start)])
    return (
        begin,
        jnp.concatenate([first, forces]),
        1.0 + shared[2] * jnp.concatenate([first, masses]),
    )


def _propagate(
    omega: jax.Array,
    damping: jax.Array,
    begin: jax.Array,
    force: jax.Array,
    mass: jax.Array,
    level: jax.Array,
    rate: jax.Array,
) -> Segments:
    """The segments with the state at each beginning. level, rate: state at the first beginning."""

    def step(state: tuple, row: tuple) -> tuple:
        start, end, force, mass = row
        return _advance(omega, damping, Segments(start, force, mass, *state), end), state

    ends = jnp.append(begin[1:], begin[-1])
    first, rows = (level, rate, jnp.zeros_like(level)), (begin, ends, force, mass)
    states: tuple[jax.Array, jax.Array, jax.Array] = jax.lax.scan(step, first, rows)[1]
    return Segments(begin, force, mass, *states)


def _advance(
    omega: jax.Array, damping: jax.Array, segments: Segments, time: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Level (kg), rate (kg/s) and integral of the reading (kg s) at times [..] within segments
    [..]."""
    begin, force, mass, level, rate, integral = segments
    elapsed = time - begin
    decay, square = damping * omega / mass, omega**2 / mass
    swing = jnp.sqrt(square - decay**2)
    shrink, cosine, sine = (
        jnp.exp(-decay * elapsed),
        jnp.cos(swing * elapsed),
        jnp.sin(swing * elapsed) / swing,
    )
    offset = level - force
    new_rate = shrink * (rate * cosine - (decay * rate + square * offset) * sine)
    new_level = force + shrink * (offset * cosine + (rate + decay * offset) * sine)
    return new_level, new_rate, integral + force * elapsed - (new_rate - rate) / square
