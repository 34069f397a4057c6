"""The public fit: traces in, parameters with intervals, statements and a goodness of fit out."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate import goodness, plausibility, uncertainty
from calibrate.errors import BadInput, checked_seed
from calibrate.fit_data import draw_random_numbers, measure_summaries
from calibrate.loss import BLOCKS, MeasuredSummaries, RandomDraws
from calibrate.solve import scan_lengths, solve_starts
from calibrate.targets import Target
from calibrate.uncertainty import ProgressCallback
from calibrate.unconstrained import NAMES, FreeParameters, ModelParameters

Rows = dict[str, dict[str, Any]]  # Fit.parameters
Ends = dict[str, list[float]]  # Fit.starts

STARTS = 4
SCAN = (0.7, 90.0, 12)  # least and greatest dt_impact (bins) that the first guess looks at, and how
# many
LEAST_TRACES = 4  # half of the traces say nothing of gamma_high; two of the rest are needed to tell
# a scatter
AGREEMENT = 0.1  # share of the interval's half width: starts that differ by less agree, one whose
# last round changed less converged


@dataclass(frozen=True)
class Fit:
    """Result of a fit. All SI.

    parameters: name -> {"value", "low", "high", "sd", "local_sd"}: 90 % interval of the parametric
    bootstrap, its standard deviation and the fast local estimate
    free: names of the fitted parameters
    starts: name -> [S]; losses: [S]; converged, agreed: [S]
    distances: block -> energy distance
    p_values: name -> p-value
    rmse_g: the paper's figure, for comparison only
    statements: the conclusions that the data allow, and those that they do not, in words
    warnings: those of the statements that doubt the traces or the inputs with them
    absurd: parameters that are not plausible, in words
    """

    parameters: dict[str, dict[str, Any]]
    free: FreeParameters
    starts: dict[str, list[float]]
    losses: list[float]
    converged: list[bool]
    agreed: list[bool]
    distances: dict[str, float]
    p_values: dict[str, float]
    rmse_g: float
    statements: list[str]
    info: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    absurd: list[str] = field(default_factory=list)

    def landings(self) -> None:
        """None: the paper's model has no additions."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, as written to fit.json."""
        return asdict(self)


def default_start(
    targets: list[Target], measured: MeasuredSummaries, draws: RandomDraws
) -> dict[str, float]:
    """Start values from the traces: h_mean and the limits from their own mean drop heights and
    spreads, dt_impact as the best of a coarse scan of the increments.

    Raises `BadInput` where the momentum of the traces is not that of falling portions of their
    weight.
    """
    height = float(np.mean(np.asarray(measured.height)))
    if not (np.isfinite(height) and height > 0):
        raise BadInput(plausibility.find_impossible(targets, measured)[-1])
    low, high = np.quantile(np.asarray(measured.spread), [0.25, 0.95])
    start = {"gamma_low": float(low), "gamma_high": float(1.5 * high), "h_mean": height}
    lengths = measured.grid.sample * np.geomspace(*SCAN)
    return start | {
        "dt_impact": float(lengths[int(np.argmin(scan_lengths(lengths, start, draws, measured)))])
    }


def several_starts(
    start: ModelParameters, own: ModelParameters, free: FreeParameters, count: int = STARTS
) -> ModelParameters:
    """`count` starts: `start`, then `own`, from the traces, and others about that by factors of up
    to two: name
    -> [count]. The parameters that are not `free` have the value of `start` in all.
    """
    factors = {
        "dt_impact": (1.0, 2.0, 0.6, 1.3),
        "gamma_low": (1.0, 0.5, 1.4, 0.8),
        "gap": (1.0, 2.0, 0.5, 1.2),
        "h_mean": (1.0, 1.1, 0.9, 1.03),
    }
    rows = [start]
    for k in range(4):
        row = {name: own[name] * factors[name][k] for name in ("dt_impact", "gamma_low", "h_mean")}
        row["gamma_high"] = (
            row["gamma_low"] + (own["gamma_high"] - own["gamma_low"]) * factors["gap"][k]
        )
        row |= {name: start[name] for name in NAMES if name not in free}
        row["gamma_high"] = max(row["gamma_high"], row["gamma_low"])
        if "gamma_low" in free and "gamma_high" not in free:
            row["gamma_low"] = min(row["gamma_low"], row["gamma_high"])
        if row != start:
            rows.append(row)
    return {name: jnp.asarray([row[name] for row in rows[:count]]) for name in NAMES}


def _checked_start(
    start: ModelParameters | None, fixed: ModelParameters, own: ModelParameters
) -> dict[str, float]:
    unknown = sorted((set(start or {}) | set(fixed or {})) - set(NAMES))
    if unknown:
        raise BadInput(f"{unknown[0]}: unknown; known are {', '.join(NAMES)}")
    given = dict(start or {}) | dict(fixed or {})
    values = own | given
    if "gamma_low" not in given:
        values["gamma_low"] = min(values["gamma_low"], values["gamma_high"])
    elif "gamma_high" not in given:
        values["gamma_high"] = max(values["gamma_low"], values["gamma_high"])
    for name, value in values.items():
        if not (np.isfinite(value) and (value > 0 or (name == "gamma_low" and value == 0))):
            raise BadInput(
                f"{name} = {value:g}: must be greater than 0 ({'s' if name == 'dt_impact' else 'm'})"
            )
    if values["gamma_high"] < values["gamma_low"]:
        raise BadInput(
            f"gamma_high = {values['gamma_high']:g} m: must be at least gamma_low = {values['gamma_low']:g} m"
        )
    return {name: float(values[name]) for name in NAMES}


def fit(
    traces: Iterable[Target],
    start: dict[str, float] | None = None,
    *,
    fixed: dict[str, float] | None = None,
    align: str = "release",
    simulations: int = 512,
    fine: int = 128,
    bootstrap: int = 100,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    force: bool = False,
) -> Fit:
    """Fit dt_impact, gamma_low, gamma_high and h_mean to `traces`, a list of `Target`.

    start: dict of start values, any subset (the others from the traces)
    fixed: dict of parameters that are not fitted
    align: "release" or "first-impact"
    simulations, fine: simulated portions of the moments and of the increments
    bootstrap: number of refits for the intervals, 0 for the local estimate only
    seed: of all random numbers
    progress: called with (name of the stage, done, total) while it works
    force: also fit traces that are not plausible as they were read

    Runs in double precision regardless of the global flag. Raises `BadInput`.
    """
    targets = list(traces)
    seed = checked_seed(seed)
    with jax.enable_x64(True):
        measured, impossible = _measure_possible(targets, align, force)
        arguments = (
            start,
            fixed or {},
            align,
            simulations,
            fine,
            bootstrap,
            seed,
            progress or (lambda *_: None),
        )
        return _fit(targets, measured, impossible, *arguments)


def _measure_possible(
    targets: list[Target], align: str, force: bool
) -> tuple[MeasuredSummaries, list[str]]:
    """The summaries of the traces, and reasons why these are not plausible as they were read, which
    raise `BadInput` unless `force`.
    """
    if align == "release" and (names := [t.name for t in targets if not t.from_release]):
        raise BadInput(
            f"{names[0]}: times of a clock do not tell when the portion was released: give --align first-impact"
        )
    impossible = plausibility.find_impossible(targets)
    if not impossible or force:
        measured = measure_summaries(targets, align)
        impossible = plausibility.find_impossible(targets, measured)
    if impossible and not force:
        raise BadInput(f"{impossible[0]}; --force fits nevertheless")
    return measured, impossible


def _fit(
    targets: list[Target],
    measured: MeasuredSummaries,
    impossible: list[str],
    given: dict[str, float] | None,
    fixed: dict[str, float],
    align: str,
    simulations: int,
    fine: int,
    bootstrap: int,
    seed: int,
    progress: ProgressCallback,
) -> Fit:
    draws = draw_random_numbers(targets, simulations, seed)
    fine = min(fine, draws.z.shape[0])
    own = default_start(targets, measured, draws)
    start = _checked_start(given, fixed, own)
    free = _free_parameters(fixed, len(targets))
    progress("starts", 0, 1)
    solutions = jax.block_until_ready(
        solve_starts(several_starts(start, own, free), draws, measured, free, fine)
    )
    progress("starts", 1, 1)
    losses = np.asarray(solutions.loss)
    if not np.isfinite(losses).any():
        raise BadInput(
            "the fit diverged from every start: look at the traces, or give a start nearer to them"
        )
    best = int(np.nanargmin(losses))
    theta = {name: solutions.theta[name][best] for name in NAMES}
    local = uncertainty.local_estimate(theta, targets, draws, measured, free, fine, seed)
    refits = uncertainty.bootstrap(
        theta, targets, draws, measured, free, fine, bootstrap, seed, progress
    )
    parameters = uncertainty.table(theta, free, local, refits)
    ends = {name: [float(v) for v in solutions.theta[name]] for name in NAMES}
    result = Fit(
        parameters=parameters,
        free=free,
        starts=ends,
        losses=[float(v) for v in losses],
        converged=_converged_starts(ends, solutions.change, parameters, free),
        agreed=_agreeing_starts(ends, best, parameters, free),
        distances={
            name: float(value)
            for name, value in zip(BLOCKS, solutions.distances[best], strict=True)
        },
        p_values=goodness.p_values(
            theta, targets, measured, solutions.distances[best], refits, seed
        ),
        rmse_g=goodness.rmse_g(theta, targets, align, seed),
        statements=[],
        info={
            "traces": len(targets),
            "pieces": sorted({t.pieces for t in targets}),
            "m_piece": sorted({t.m_piece for t in targets}),
            "align": align,
            "bootstrap": 0 if refits is None else len(np.asarray(refits.solution.loss)),
            "simulations": int(draws.z.shape[0]),
            "seed": seed,
            "best_start": best,
        },
    )
    result.absurd.extend(plausibility.find_absurd(parameters))
    result.warnings.extend(
        impossible
        + plausibility.find_doubtful(targets, align)
        + uncertainty.without_spread(measured)
    )
    result.statements.extend(
        [*result.absurd, *result.warnings, *uncertainty.statements(result, targets)]
    )
    result.statements.extend(goodness.statements(result.p_values, result.info["bootstrap"]))
    return result


def _free_parameters(fixed: dict[str, float], count: int) -> FreeParameters:
    free = tuple(name for name in NAMES if name not in fixed)
    if not free:
        raise BadInput("fixed: at least one parameter must be free")
    if "gamma_high" in free and count < LEAST_TRACES:
        raise BadInput(
            f"{count} {'trace is' if count == 1 else 'traces are'} too few to tell gamma_high; at least {LEAST_TRACES} are "
            "needed, or a fixed gamma_high (--fix-gamma-high)"
        )
    return free


def _agreeing_starts(ends: Ends, best: int, parameters: Rows, free: FreeParameters) -> list[bool]:
    """[S] whether each start ended where the best one did, within a share of the intervals."""
    return _within_share(
        lambda name, s: abs(ends[name][s] - ends[name][best]), len(ends["h_mean"]), parameters, free
    )


def _converged_starts(
    ends: Ends, change: ModelParameters, parameters: Rows, free: FreeParameters
) -> list[bool]:
    """[S] whether the last round of each start changed nothing by more than a share of the
    intervals.
    """
    return _within_share(
        lambda name, s: float(change[name][s]) * ends[name][s],
        len(ends["h_mean"]),
        parameters,
        free,
    )


def _within_share(
    distance: Callable[[str, int], float], count: int, parameters: Rows, free: FreeParameters
) -> list[bool]:
    """[count] whether distance(name, s) is within a share of the intervals of all free parameters."""
    return [
        all(distance(name, s) <= AGREEMENT * _half_width(parameters[name]) for name in free)
        for s in range(count)
    ]


def _half_width(row: dict[str, Any]) -> float:
    return max(0.5 * (row["high"] - row["low"]), 1e-3 * abs(row["value"]))
