"""The extended model: pieces that land one after the other, several times each, in several impacts
of unequal size.

The paper's model drops every piece once, all at the same moment, and stops it in one rectangular
pulse. Real pieces leave the feed bucket over some milliseconds, touch the flaps with a corner
first, turn, rebound a little and slump with the heap. Here

1. a piece is released at `release_time` expm1(k z)/k, k = `release_skew`, z normal, in part ordered
   as in a queue;
2. it lands `len(impacts)` times: it leaves each landing with `rebound` of its speed and falls a
   random part of `slump_depth`, with gravity lessened by the share `early_weight` of its weight
   that the flaps bear already;
3. a landing gives its momentum in `impacts[j]` impacts. Their shares are those of a stick that is
broken repeatedly, and their distance is `impact_delay`, larger for later ones;
4. an impact is a pulse whose length grows with its momentum to the power `pulse_exponent`;
5. `early_weight` of the weight rests on the flaps dt_impact after the first touch, all of it
   dt_impact after the last landing.

Momentum is conserved: for all random numbers, the force of a piece that fell for the time t has
given m g (T - dt_impact) at a time T after its release when it is at rest, which is m v + m g (T -
t - dt_impact) as in the paper. `OFF`, whose additions are zero and whose pulses are rectangles, is
the paper's model.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from scipy.special import ndtri

from product_model.errors import BadInput
from product_model.fall import standard_normal
from product_model.model import Numbers, Triangles

SHAPES = ("triangle", "rectangle")
LEADING, LEADING_OFFSET = 0.33, 0.03  # share of a piece's momentum whose pulse has the length
# dt_impact; added to every share
TRAILING, TRAILING_OFFSET = 0.033, 0.004  # the same of `late_duration`: offsets keep pulses from
# vanishing with their momentum
MOST_REBOUND = 0.9  # of the speed
MOST_NORMAL = 4.0  # standard deviations beyond which a moment of release is drawn in
FIRST_GAP = 2  # impacts k and k + 1 of a landing are max(k, FIRST_GAP) impact_delay apart, in the
# mean


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Landings:
    """The additional parameters of the extended model; meaning, unit and range of each are in
    `ADDITIONS`.

    The defaults are those of nine marshmallows in the stock scene `weigh-bucket` of the discrete
    element model. All can be traced, mapped and differentiated, except `impacts`, the number of
    impacts of each landing, and `shape`, the shape of the pulses.
    """

    pulse_exponent: Numbers = 1.19
    late_duration: Numbers = 590e-6
    share_exponent: Numbers = 0.63
    impact_delay: Numbers = 870e-6
    rebound: Numbers = 0.083
    slump_depth: Numbers = 1.14e-3
    early_weight: Numbers = 0.28
    release_time: Numbers = 1.61e-3
    release_skew: Numbers = -0.57
    release_order: Numbers = 0.28
    cushioning: Numbers = 0.0
    impacts: tuple[int, ...] = field(default=(7, 3, 3, 2, 1), metadata={"static": True})
    shape: str = field(default="triangle", metadata={"static": True})

    def replace(self, **changes: Any) -> "Landings":
        """A copy with `changes`."""
        return replace(self, **changes)

    def values(self) -> dict[str, Any]:
        """Name -> value of ADDITIONS."""
        return {row.name: getattr(self, row.name) for row in ADDITIONS}


@dataclass(frozen=True)
class Addition:
    """One row of the table of additions: name, unit, meaning, least value, and the value that it
    must be below.
    """

    name: str
    unit: str
    meaning: str
    low: float
    high: float


ADDITIONS = (
    Addition(
        "pulse_exponent", "1", "power of its momentum with which a pulse becomes longer", 0.0, 5.0
    ),
    Addition(
        "late_duration",
        "s",
        "length of a pulse of 3.3 % of a piece's momentum after the first landing",
        1e-6,
        1.0,
    ),
    Addition(
        "share_exponent",
        "1",
        "evenness of the impacts of a landing; small: the last one has most momentum",
        0.0,
        100.0,
    ),
    Addition("impact_delay", "s", "mean time between the impacts of a landing", 0.0, 1.0),
    Addition(
        "rebound", "1", "mean share of its speed with which a piece leaves a landing", 0.0, 1.0
    ),
    Addition("slump_depth", "m", "mean height that a piece falls between two landings", 0.0, 1.0),
    Addition(
        "early_weight",
        "1",
        "share of a piece's weight that the flaps bear before it is at rest",
        0.0,
        1.0,
    ),
    Addition(
        "release_time", "s", "spread of the moments at which pieces leave the feed bucket", 0.0, 1.0
    ),
    Addition(
        "release_skew",
        "1",
        "skewness of these moments; below 0: a few pieces leave early",
        -5.0,
        5.0,
    ),
    Addition(
        "release_order",
        "1",
        "how regular they are: 0 independent, near 1 one after the other as in a queue",
        0.0,
        1.0,
    ),
    Addition(
        "cushioning",
        "1",
        "power of its place in the queue with which a piece's impacts lie further apart",
        -5.0,
        10.0,
    ),
)
ADDED = tuple(row.name for row in ADDITIONS)
# the paper's model
OFF = Landings(0.0, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, shape="rectangle")


def choose_impacts(pieces: int) -> tuple[int, ...]:
    """Number of impacts in each landing of a portion; fewer for portions of many pieces."""
    return (7, 3, 3, 2, 1) if pieces <= 16 else (4, 2, 2, 1) if pieces <= 64 else (3, 2, 1)


def check_landings(landings: Landings, error: type[Exception] = BadInput) -> Landings:
    """`landings`, or an error with one line. Traced numbers have no value yet and are not checked."""
    for row in ADDITIONS:
        value = getattr(landings, row.name)
        if isinstance(value, jax.core.Tracer):
            continue
        value = value.item() if hasattr(value, "item") and getattr(value, "ndim", 1) == 0 else value
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not row.low <= value < row.high
        ):
            unit = f" ({row.unit})" if row.unit != "1" else ""
            raise error(
                f"{row.name} = {value}: must be a number from {row.low:g} to below {row.high:g}{unit}"
            )
    impacts = landings.impacts
    if not (
        isinstance(impacts, tuple)
        and impacts
        and all(isinstance(k, int) and 1 <= k <= 32 for k in impacts)
    ):
        raise error(
            f"impacts = {impacts!r}: must be a tuple of whole numbers from 1 to 32, one for each landing"
        )
    if landings.shape not in SHAPES:
        raise error(f"shape = {landings.shape!r}: must be one of {', '.join(SHAPES)}")
    return landings


def landings(**values: Any) -> Landings:
    """Checked `Landings` from keywords. Raises `BadInput` (unknown name, wrong type or range)."""
    known = tuple(f.name for f in fields(Landings))
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise BadInput(f"{unknown[0]}: unknown; known are {', '.join(known)}")
    return check_landings(Landings(**values))


# ---- random numbers ----


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LandingNumbers:
    """Random numbers of a portion, given so that a fit can keep them while the parameters move.

    release: [pieces] normal
    rebound, slump: [landings - 1, pieces] exponential of mean 1
    share: [impacts - landings, pieces] uniform on (0, 1)
    delay: [impacts - landings, pieces] exponential of mean 1
    """

    release: jax.Array
    rebound: jax.Array
    slump: jax.Array
    share: jax.Array
    delay: jax.Array


def count_numbers(impacts: tuple[int, ...]) -> int:
    """Number of random numbers of a piece beside its drop height."""
    return 1 + 2 * (len(impacts) - 1) + 2 * (sum(impacts) - len(impacts))


def landing_numbers(v: jax.Array, impacts: tuple[int, ...]) -> LandingNumbers:
    """The random numbers from `v` [pieces, count_numbers(impacts)] uniform on (-1, 1)."""
    flights, gaps = len(impacts) - 1, sum(impacts) - len(impacts)
    release, rebound, slump, share, delay = jnp.split(v.T, np.cumsum([1, flights, flights, gaps]))
    exponential = [_exponential(values) for values in (rebound, slump, delay)]
    return LandingNumbers(
        standard_normal(release[0]),
        exponential[0],
        exponential[1],
        0.5 * (share + 1.0),
        exponential[2],
    )


def _exponential(v: jax.Array) -> jax.Array:
    return -jnp.log(0.5 * (v + 1.0))


# ---- pulses ----


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LandingPulses:
    """Forces of the pieces of a portion on the weigh bucket: impact pulses, and their weight in two
    steps each.

    start: [impacts pieces] (s) beginning of each pulse; first those of the first touch of each
    piece
    duration: [impacts pieces] (s)
    force: [impacts pieces] (N) mean force of each pulse
    step_time: [2 pieces] (s) moments at which weight comes to rest on the flaps
    weight: [2 pieces] (N) that weight
    shape: static, shape of the pulses, one of SHAPES
    """

    start: jax.Array
    duration: jax.Array
    force: jax.Array
    step_time: jax.Array
    weight: jax.Array
    shape: str = field(metadata={"static": True})

    @property
    def first_touch(self) -> jax.Array:
        """[..., pieces] (s) moment of the first impact of each piece."""
        return self.start[..., : self.weight.shape[-1] // 2]

    def edges(self) -> tuple[jax.Array, jax.Array]:
        """Times (s) and jumps (N) of the force."""
        if self.shape == "triangle":
            return self.step_time, self.weight
        times = jnp.concatenate([self.start, self.start + self.duration, self.step_time])
        return times, jnp.concatenate([self.force, -self.force, self.weight])

    def triangles(self, dtype: Any) -> Triangles | None:
        """The pulses as triangles, computed in `dtype`; None: they are rectangles."""
        if self.shape != "triangle":
            return None
        half = 0.5 * self.duration.astype(dtype)
        return Triangles(self.start.astype(dtype), half, 2.0 * self.force.astype(dtype) / half)

    def ends(self) -> jax.Array:
        """[..., impacts pieces] (s) ends of the pulses."""
        return self.start + self.duration

    def weight_steps(self) -> tuple[jax.Array, jax.Array]:
        """Times (s), and weights (N) that come to rest at them."""
        return self.step_time, self.weight


def release_times(extended: Landings, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Moments of release (s) and places in the queue on (0, 1), [pieces] each, from normal numbers
    [pieces].
    """
    pieces = normal.shape[-1]
    scores = ndtri((np.arange(pieces) + 0.5) / pieces)  # of a regular queue, in units of their
    # standard deviation
    scores = scores / scores.std() if pieces > 1 else scores
    order = extended.release_order
    z = jnp.sqrt(1.0 - order**2) * normal + order * jnp.asarray(scores, normal.dtype)
    z = jnp.clip(z, -MOST_NORMAL, MOST_NORMAL)
    skewed = jnp.abs(extended.release_skew) > 1e-3
    skew = jnp.where(skewed, extended.release_skew, 1.0)
    near_zero = z * (1.0 + 0.5 * extended.release_skew * z)
    return extended.release_time * jnp.where(skewed, jnp.expm1(skew * z) / skew, near_zero), ndtr(z)


def break_stick(share_exponent: Numbers, uniform: jax.Array) -> jax.Array:
    """Break a stick: shares [impacts, ...] that add up to 1, from numbers on (0, 1) [impacts - 1,
    ...].

    Each share takes 1 - u^p of the rest.
    """
    whole = jnp.ones((1, *uniform.shape[1:]), uniform.dtype)
    left = jnp.cumprod(jnp.concatenate([whole, uniform**share_exponent]), axis=0)
    return jnp.concatenate([left[:-1] - left[1:], left[-1:]])


def pulse_duration(
    extended: Landings, dt_impact: Numbers, share: jax.Array, is_first: bool
) -> jax.Array:
    """Lengths (s) of pulses with these shares [...] of a piece's momentum, of the first landing or
    of a later one.
    """
    if is_first:
        return dt_impact * ((share + LEADING_OFFSET) / LEADING) ** extended.pulse_exponent
    return (
        extended.late_duration * ((share + TRAILING_OFFSET) / TRAILING) ** extended.pulse_exponent
    )


def landing_pulses(
    extended: Landings,
    height: jax.Array,
    mass: jax.Array,
    dt_impact: Numbers,
    h_mean: Numbers,
    gravity: Numbers,
    numbers: LandingNumbers,
) -> LandingPulses:
    """The pulses of a portion.

    Args:
        extended: the additions.
        height: [pieces] (m) drop heights.
        mass: [pieces] (kg).
        dt_impact: (s) length of a pulse of a third of a piece's momentum.
        h_mean: (m) mean drop height.
        gravity: (m/s2).
        numbers: random numbers.
    """
    release, place = release_times(extended, numbers.release)
    fall = jnp.sqrt(2.0 * height / gravity)
    touch, speed = release + fall, gravity * fall
    reference = jnp.sqrt(2.0 * gravity * h_mean)
    delay = extended.impact_delay * (2.0 * place + 0.02) ** extended.cushioning
    less = (1.0 - extended.early_weight) * gravity
    starts, durations, forces = [], [], []
    landing, used = touch, 0
    for j, count in enumerate(extended.impacts):
        last = j + 1 == len(extended.impacts)
        again = (
            jnp.zeros_like(speed)
            if last
            else jnp.minimum(extended.rebound * numbers.rebound[j], MOST_REBOUND) * speed
        )
        share = break_stick(extended.share_exponent, numbers.share[used : used + count - 1])
        start = landing[None] + _delays(delay, numbers.delay[used : used + count - 1])
        momentum = (speed + again)[None] * share
        duration = pulse_duration(extended, dt_impact, momentum / reference, j == 0)
        starts.append(start)
        durations.append(jnp.broadcast_to(duration, start.shape))
        forces.append(mass[None] * momentum / duration)
        used += count - 1
        if not last:
            speed, time = _flight(again, extended.slump_depth * numbers.slump[j] ** 3 / 6.0, less)
            landing = landing + time
    flat = lambda parts: jnp.concatenate(parts).reshape(-1)
    return LandingPulses(
        start=flat(starts),
        duration=flat(durations),
        force=flat(forces),
        step_time=jnp.concatenate([touch, landing]) + dt_impact,
        weight=jnp.concatenate([mass * (gravity - less), mass * less]),
        shape=extended.shape,
    )


def _delays(delay: jax.Array, exponential: jax.Array) -> jax.Array:
    """Times [impacts, pieces] (s) of the impacts of a landing after its first touch."""
    steps = np.maximum(np.arange(1, len(exponential) + 1), FIRST_GAP)[:, None]
    gaps = delay[None] * exponential * jnp.asarray(steps, exponential.dtype)
    return jnp.concatenate([jnp.zeros_like(delay)[None], jnp.cumsum(gaps, axis=0)])


def _flight(speed: jax.Array, depth: jax.Array, gravity: Numbers) -> tuple[jax.Array, jax.Array]:
    """Speed (m/s) and time (s) at the next landing, up with `speed` and then down to `depth` (m)
    below.
    """
    square = speed**2 + 2.0 * gravity * depth
    moves = square > 0.0
    below = jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)
    return below, (speed + below) / gravity


def latest_end(
    extended: Mapping[str, float], fall: float, dt_impact: float, gravity: float
) -> float:
    """Time (s) at which nearly all pulses are over, for pieces that fall for at most `fall` (s).
    extended: its `values`.
    """
    skew = extended["release_skew"]
    release = extended["release_time"] * (np.expm1(3.5 * skew) / skew if abs(skew) > 1e-3 else 3.5)
    less, speed = (
        (1.0 - extended["early_weight"]) * gravity,
        min(3.0 * extended["rebound"], MOST_REBOUND) * gravity * fall,
    )
    deepest = 8.0 * extended["slump_depth"]  # once in fifty flights
    flight = (speed + np.sqrt(speed**2 + 2.0 * less * deepest)) / less + np.sqrt(
        2.0 * deepest / less
    )
    return fall + release + flight + 10.0 * extended["impact_delay"] + dt_impact
