"""Simulated traces of the extended model for a fit: coordinates of its parameters, random numbers,
forces.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.stats import qmc

from calibrate.landing_summaries import TraceFrame, summarize
from calibrate.targets import Target
from product_model import coordinates, fall
from product_model.coordinates import NAMES, Values, to_coordinates
from product_model.extended import (
    ADDED,
    LandingNumbers,
    LandingPulses,
    Landings,
    choose_impacts,
    landing_numbers,
    landing_pulses,
)
from product_model.extended import count_numbers as numbers_of_piece
from product_model.grid import Grid
from product_model.pulses import interval_mean

BEFORE = 4  # bins that a simulated trace begins before its first impact, and as many more after its
# end
MARGIN = 64  # bins
REACH = 2.5  # in coordinates, about a factor of 12, beyond which a start value is doubted and a
# penalty begins

# nested models: which parameters each has free; the others are those of OFF_VALUES
PULSES = (
    "dt_impact",
    "gamma_low",
    "gamma_high",
    "h_mean",
    "pulse_exponent",
    "share_exponent",
    "impact_delay",
)
LANDINGS = (
    *PULSES,
    "late_duration",
    "rebound",
    "slump_depth",
    "early_weight",
    "release_time",
    "release_skew",
)
MODELS = {
    "pulses": PULSES,
    "landings": LANDINGS,
    "full": (*LANDINGS, "release_order", "cushioning"),
}
OFF_VALUES = {
    "rebound": 0.0,
    "slump_depth": 0.0,
    "early_weight": 0.0,
    "release_time": 0.0,
    "release_skew": 0.0,
}
OFF_VALUES |= {"release_order": 0.0, "cushioning": 0.0, "late_duration": 590e-6}


def to_values(u: Values, free: tuple[str, ...]) -> Values:
    """All parameters: `free` parameters from their coordinates, the others switched off."""
    off = {name: value for name, value in OFF_VALUES.items() if name not in free}
    return coordinates.to_values(u, off)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LandingDraws:
    """Random numbers of M simulated portions of up to n pieces, kept while the parameters move.

    z: [M] normal; v: [M, n] uniform on (-1, 1); numbers: [M, ...] of the landings; phase: [M] in
    (0, 1), where in a bin a trace begins; mass: [M, n] (kg), zero where a portion has fewer pieces
    """

    z: jax.Array
    v: jax.Array
    numbers: LandingNumbers
    phase: jax.Array
    mass: jax.Array
    impacts: tuple[int, ...] = field(metadata={"static": True})


def draw_landings(targets: list[Target], simulations: int, seed: int) -> LandingDraws:
    """Random numbers of `simulations` portions, taking the compositions of the traces in turn."""
    pieces = max(trace.pieces for trace in targets)
    impacts = choose_impacts(pieces)
    random = np.random.default_rng([seed, 7])
    tiny = np.finfo(np.float64).eps
    v = random.uniform(-1.0 + tiny, 1.0, (simulations, pieces, 1 + numbers_of_piece(impacts)))
    of = [targets[k % len(targets)] for k in range(simulations)]
    mass = np.array(
        [[trace.m_piece] * trace.pieces + [0.0] * (pieces - trace.pieces) for trace in of]
    )
    numbers = jax.vmap(lambda row: landing_numbers(row, impacts))(jnp.asarray(v[..., 1:]))
    z, phase = random.standard_normal(simulations), random.uniform(size=simulations)
    return LandingDraws(
        jnp.asarray(z),
        jnp.asarray(v[..., 0]),
        numbers,
        jnp.asarray(phase),
        jnp.asarray(mass),
        impacts,
    )


def portion_pulses(values: Values, draws: LandingDraws, gravity: float) -> LandingPulses:
    """The pulses of one portion (a row of `draws`) at `values`."""
    sigma = fall.sigma_height(values["gamma_low"], values["gamma_high"], draws.z)
    height, _ = fall.drop_heights(values["h_mean"], sigma, draws.v)
    extended = Landings(**{name: values[name] for name in ADDED}, impacts=draws.impacts)
    given = values["dt_impact"], values["h_mean"], gravity
    return landing_pulses(extended, height, draws.mass, *given, draws.numbers)


def acceleration(pulses: LandingPulses, draws: LandingDraws, frame: TraceFrame) -> jax.Array:
    """Force over mass [samples] (m/s2) of one portion from its first impact on, as `accelerations`
    computes it for a trace.
    """
    first = jnp.min(jnp.where(draws.mass > 0.0, pulses.first_touch, jnp.inf))
    origin = first - (BEFORE + draws.phase) * frame.bin
    grid = Grid(0.0, frame.bin, frame.samples + MARGIN)
    shifted = LandingPulses(
        pulses.start - origin,
        pulses.duration,
        pulses.force,
        pulses.step_time - origin,
        pulses.weight,
        pulses.shape,
    )
    force = interval_mean(shifted, grid) / jnp.sum(draws.mass)
    begin = jnp.argmax(force > 0.02 * force[jnp.argmax(force)])
    return lax.dynamic_slice(force, (jnp.minimum(begin, MARGIN),), (frame.samples,))


def simulated(values: Values, draws: LandingDraws, gravity: float, frame: TraceFrame) -> jax.Array:
    """Forces over mass [M, samples] (m/s2) of all portions of `draws`."""
    return jax.vmap(lambda row: acceleration(portion_pulses(values, row, gravity), row, frame))(
        draws
    )


def simulated_summaries(
    values: Values, draws: LandingDraws, gravity: float, frame: TraceFrame
) -> jax.Array:
    """Summaries [M, D] of all portions; those of single pulses without their derivatives by the
    times of impact.
    """
    fast = jnp.asarray(frame.fast)

    def one(row: LandingDraws) -> jax.Array:
        pulses = lax.optimization_barrier(portion_pulses(values, row, gravity))
        times = {name: lax.stop_gradient(getattr(pulses, name)) for name in ("start", "step_time")}
        held = LandingPulses(
            **times,
            duration=pulses.duration,
            force=pulses.force,
            weight=pulses.weight,
            shape=pulses.shape,
        )
        moving = summarize(acceleration(pulses, row, frame), frame)
        return jnp.where(fast, summarize(acceleration(held, row, frame), frame), moving)

    return jax.vmap(one)(draws)


def scattered_starts(start: Values, count: int, seed: int) -> list[Values]:
    """`start`, then others about it by up to one in each coordinate, from a Sobol sequence."""
    u, names = to_coordinates(start), [name for name in NAMES if name != "h_mean"]
    shifts = 2.0 * qmc.Sobol(len(names), seed=np.random.default_rng([seed, 8])).random(count) - 1.0
    return [u] + [
        u | {name: u[name] + shift for name, shift in zip(names, row, strict=True)}
        for row in shifts[1:]
    ]
