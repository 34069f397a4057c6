"""The extended model as a smooth function of the drop, learnt from many ensembles of simulated
drops at once.

One set of coefficients (`product_model.transfer`) is fitted to all ensembles by Adam on the sum of
their losses (`landing_loss`), each in its own units: directions of the parameters that one ensemble
does not determine follow from the others, while separate fits would leave them to chance. The drop
height follows in each step from the momentum that the ensemble brought.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from calibrate.errors import BadInput
from calibrate.landing_loss import LandingProblem, loss_and_slope, pose_problem
from calibrate.landing_model import MODELS, LandingDraws, draw_landings
from calibrate.landing_summaries import BIN, TraceFrame, landing_time
from calibrate.summaries import momentum_release
from calibrate.targets import Target
from product_model.coordinates import Values, to_values
from product_model.transfer import (
    SCALED,
    Coefficients,
    DropConditions,
    TransferTable,
    measure_conditions,
    scale_parameters,
    solve_height,
)

FREE = MODELS["full"]
WINDOWS = 0.088, 0.132, 0.198, 0.297  # s; few, as each is compiled
LANDED = 1.2, 3.0  # landing times that a window has at least, and that it should have
BATCH = 8  # ensembles of a step
RATE = 0.05  # of Adam, in coordinates
RIDGE = 4e-3  # of coefficients, but for the first of each parameter
TERMS = (
    "pieces", "length", "contact time", "drop height", "opening time", "elongation",
    "restitution", "friction on the bucket", "friction between pieces",
    "opening time x opening time", "restitution x restitution", "opening time x length",
    "opening time x restitution", "pieces x length",
)  # fmt: skip
LOST_BY = (
    "pieces",
    "length",
    "opening time",
    "elongation",
    "friction on the bucket",
    "friction between pieces",
)
LOST_TERMS = (*LOST_BY, *(f"{a} x {b}" for a, b in combinations_with_replacement(LOST_BY, 2)))
LEAST_LOST = 1e-3  # share of the opening time
LOST_RIDGE = 0.1  # of the coefficients of the lost time

Rows = dict[str, np.ndarray]  # name of SCALED -> coefficients


@dataclass(frozen=True)
class Ensemble:
    """Traces of drops of one kind, and its conditions."""

    name: str
    drop: DropConditions
    targets: list[Target]

    def fall_time(self) -> float:
        """Time (s) of a fall from rest that gives the momentum of the portions, in the median."""
        release = [momentum_release(t.time, t.force, t.sample, t.weight) for t in self.targets]
        return float(np.median([t.first_impact for t in self.targets] - np.array(release)))

    def lost_time(self) -> float:
        """Time (s) by which the fall is shorter than a free fall through the drop height."""
        return max(self.drop.fall_time - self.fall_time(), LEAST_LOST * self.drop.opening_time)


@dataclass(frozen=True)
class Lesson:
    """An ensemble as the loss needs it. row: factors of the coefficients; fall_time: see
    `Ensemble`.
    """

    name: str
    start: dict[str, float]
    row: np.ndarray
    fall_time: float
    problem: LandingProblem
    draws: LandingDraws

    def coordinates(self, rows: Rows) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """Coordinates of the parameters, and the slopes of that of h_mean, which follows from the
        others.
        """
        u = {name: jnp.asarray(self.start[name] + float(self.row @ rows[name])) for name in SCALED}
        draws = self.draws.z, self.draws.v, self.draws.numbers.release
        height, slopes = height_and_slopes(
            u, self.start["h_mean"], self.fall_time, self.problem.gravity, *draws
        )
        return u | {"h_mean": height}, slopes

    def slope(self, rows: Rows) -> tuple[float, dict[str, float]]:
        """Loss, and its derivatives by the coordinates of SCALED, including those through the drop
        height."""
        u, by = self.coordinates(rows)
        of = self.problem
        data = tuple(jnp.asarray(part) for part in (of.summaries, of.centre, of.scale))
        value, slopes = loss_and_slope(u, u, self.draws, data, of.gravity, FREE, of.frame)
        whole = {name: slopes[name] + slopes["h_mean"] * by[name] for name in SCALED}
        return float(value), {
            name: float(np.clip(np.nan_to_num(x), -10.0, 10.0)) for name, x in whole.items()
        }


def _height(
    u: Values, start: float, fall_time: float, gravity: float, *draws: jax.Array
) -> jax.Array:
    values = to_values(u | {"h_mean": jnp.asarray(start)})
    return jnp.log(solve_height(values, fall_time, gravity, *draws))


height_and_slopes = jax.jit(jax.value_and_grad(_height), static_argnums=3)


def choose_frame(targets: Sequence[Target]) -> TraceFrame | None:
    """The frame, one of few, that contains the landing of `targets`, or None if they end before it
    is over.
    """
    landing = float(np.quantile([landing_time(trace) for trace in targets], 0.9))
    shortest = min(float(trace.time[-1]) - trace.first_impact for trace in targets)
    held = [window for window in WINDOWS if window <= shortest]
    if not held or held[-1] < LANDED[0] * landing:
        return None
    window = next((w for w in held if w >= LANDED[1] * landing), held[-1])
    return TraceFrame(BIN, round(window / BIN))


def empty_table(ensembles: Sequence[Ensemble], version: str) -> TransferTable:
    """A table with coefficients of zero, for the conditions of `ensembles` and their ranges."""
    found = [measure_conditions(each.drop) for each in ensembles]
    conditions = {}
    for name in found[0]:
        values = np.array([row[name] for row in found])
        ends = [
            float(values.mean()),
            float(values.std()) or 1.0,
            float(values.min()),
            float(values.max()),
        ]
        conditions[name] = ends
    none = Coefficients(
        {name: [0.0] * (1 + len(TERMS)) for name in SCALED}, [0.0] * (1 + len(LOST_TERMS))
    )
    return TransferTable(version, conditions, list(TERMS), list(LOST_TERMS), none)


def learn_lost_time(
    ensembles: Sequence[Ensemble], table: TransferTable
) -> tuple[np.ndarray, float]:
    """Coefficients of the logarithm of the lost time over the opening time by ridge regression, and
    their error.

    The error is the standard deviation of the differences of each ensemble from a regression
    without it.
    """
    rows = np.array([table.row(each.drop, table.lost_terms) for each in ensembles])
    found = np.log([each.lost_time() / each.drop.opening_time for each in ensembles])
    ridge = LOST_RIDGE * np.diag([0.0] + [1.0] * len(table.lost_terms))
    gain = np.linalg.solve(rows.T @ rows + ridge, rows.T)
    leverage = np.einsum("ij,ji->i", rows, gain)
    left = (found - rows @ (gain @ found)) / np.maximum(1.0 - leverage, 1e-6)
    return gain @ found, float(np.sqrt(np.mean(left**2)))


def prepare_lessons(
    ensembles: Sequence[Ensemble], table: TransferTable, portions: int
) -> list[Lesson]:
    """`Lesson` of each ensemble whose traces are long enough."""
    lessons = []
    for number, each in enumerate(ensembles):
        frame = choose_frame(each.targets)
        if frame is None:
            continue
        problem = pose_problem(each.targets, frame)
        draws = draw_landings(each.targets, portions, number)
        start, row = scale_parameters(each.drop), table.row(each.drop, table.terms)
        lessons.append(Lesson(each.name, start, row, each.fall_time(), problem, draws))
    return lessons


def learn_coefficients(
    lessons: Sequence[Lesson],
    start: Rows,
    epochs: int,
    rate: float = RATE,
    seed: int = 0,
    tell: Callable[[int, float], Any] = lambda *_: None,
) -> Rows:
    """Coefficients of the least mean loss that Adam finds from `start`. tell: epoch and mean loss."""
    if not lessons:
        raise BadInput("ensembles: none has traces that are long enough")
    random, steps = np.random.default_rng([seed, 12]), epochs * -(-len(lessons) // BATCH)
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.05), b1=0.9, b2=0.98)
    now: Any = {name: np.asarray(row, np.float64) for name, row in start.items()}
    state = optimiser.init(now)
    for epoch in range(epochs):
        order, losses = random.permutation(len(lessons)), []
        for first in range(0, len(order), BATCH):
            batch = [lessons[k] for k in order[first : first + BATCH]]
            slopes = {name: RIDGE * np.r_[0.0, now[name][1:]] for name in SCALED}
            for lesson in batch:
                value, slope = lesson.slope(now)
                losses.append(value)
                for name in SCALED:
                    slopes[name] = slopes[name] + slope[name] * lesson.row / len(batch)
            moves, state = optimiser.update(slopes, state)
            now = {name: now[name] + np.asarray(moves[name]) for name in SCALED}
        tell(epoch, float(np.mean(losses)))
    return now


def learn_transfer(
    ensembles: Sequence[Ensemble],
    version: str,
    portions: int = 96,
    epochs: tuple[int, int] = (40, 20),
    groups: int = 5,
    tell: Callable[[str, int, float], Any] = lambda *_: None,
) -> TransferTable:
    """The table of transfer learnt from `ensembles`.

    Args:
        ensembles: drops of products and scenes that fill the space of conditions.
        version: of the table.
        portions: simulated portions of each ensemble in a step.
        epochs: number in the fit to all, and in those that leave a group out, which begin anew.
        groups: number of these (jackknife).
        tell: called with the name of the fit, the epoch and the mean loss.

    Raises:
        BadInput: no ensemble is long enough.
    """
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        table = empty_table(ensembles, version)
        lost_time, lost_error = learn_lost_time(ensembles, table)
        zero = {name: np.zeros(len(table.terms) + 1) for name in SCALED}
        lessons = prepare_lessons(ensembles, table, portions)
        whole = learn_coefficients(lessons, zero, epochs[0], tell=lambda e, v: tell("all", e, v))
        left_out = []
        for group in range(groups):
            kept = [each for k, each in enumerate(ensembles) if k % groups != group]
            names = {each.name for each in kept}
            told = lambda e, v, group=group: tell(f"without group {group}", e, v)
            few = [lesson for lesson in lessons if lesson.name in names]
            rows = learn_coefficients(few, zero, epochs[1], seed=group, tell=told)
            left_out.append(_to_lists(rows, learn_lost_time(kept, table)[0]))
    return replace(
        table, coefficients=_to_lists(whole, lost_time), groups=left_out, lost_error=lost_error
    )


def _to_lists(rows: Rows, lost_time: np.ndarray) -> Coefficients:
    return Coefficients({name: row.tolist() for name, row in rows.items()}, lost_time.tolist())
