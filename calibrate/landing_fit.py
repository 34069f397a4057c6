"""The fit of the extended model: traces in, the smallest model that they do not contradict, its
parameters with intervals.

The loss is an energy distance between summaries of measured and simulated traces, jointly and one
by one. A coarse search finds the valley and Adam descends in it, at first with common random
numbers, finally with new ones in each step, as a fit to the same few portions adapts to them. A
third of the traces is kept out of the fit for the judgement.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.errors import BadInput, checked_seed
from calibrate.fit import Fit, fit
from calibrate.goodness import simulated_targets
from calibrate.landing_intervals import LEAST_REFITS, refit_intervals
from calibrate.landing_loss import (
    LandingProblem,
    loss_alone,
    minimize_landing_loss,
    minimize_with_fresh_draws,
    pose_problem,
    summarize_rows,
)
from calibrate.landing_model import (
    MODELS,
    NAMES,
    LandingDraws,
    Values,
    draw_landings,
    portion_pulses,
    scattered_starts,
    simulated,
    to_coordinates,
    to_values,
)
from calibrate.landing_summaries import TraceFrame, accelerations, count_peaks, find_common_frame
from calibrate.targets import Target
from calibrate.two_samples import SampleComparison, compare_summaries
from calibrate.uncertainty import ProgressCallback
from product_model import Landings
from product_model.extended import ADDED

ALARM = 0.05  # p below which a model is rejected
LEAST_TRACES = 24  # a third of which is judged
SEARCHED, SEARCH_SIMULATIONS = 64, 64  # starts of the coarse search, and simulated portions of each
BEST = 3  # starts that Adam tries
STEPS = (25, 160)  # of Adam from each of these, and from the best of them
RATES = 0.08, 0.05  # of the same
SETS, SET_SEED = 16, 8_000_009  # sets of random numbers that the latter takes in turn; between
# their seeds
JUDGED = 256  # simulated traces of a judgement
NO_INTERVALS = f"no intervals were asked for: {LEAST_REFITS} refits or more (--bootstrap) give them"


@dataclass(frozen=True)
class LandingFit:
    """Result of a fit of the extended model. All SI.

    model: name of the chosen one of paper, pulses, landings, full
    parameters: name -> {"value", "low", "high", "sd", "free"} of it, low and high of the 90 %
    interval
    impacts: number of impacts in each landing
    judgements: model -> {"distance", "p", "cell_distance", "cell_p", "passed", "of", "worst"} from
    traces that were not fitted, in all summaries and in those of a load cell; "traces": the fitted
    traces in the place of a model's
    statements: in words
    paper: the fit of the paper's model
    """

    model: str
    parameters: dict[str, dict[str, Any]]
    impacts: tuple[int, ...]
    judgements: dict[str, dict[str, Any]]
    statements: list[str]
    paper: Fit
    info: dict[str, Any] = field(default_factory=dict)

    def landings(self) -> Landings | None:
        """The additions of the chosen model; None: it is the paper's."""
        if self.model == "paper":
            return None
        return Landings(
            **{name: self.parameters[name]["value"] for name in ADDED}, impacts=self.impacts
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, as written to fit.json."""
        tree = asdict(self)
        paper = tree.pop("paper")
        return tree | {
            "impacts": list(self.impacts),
            "paper": paper["parameters"],
            "p_values": paper["p_values"],
        }


def default_start(paper: Fit, targets: list[Target]) -> Values:
    """Start values: drop height and lengths from the fit of the paper's model, the rest as in the
    stock scene, times with the length of pulses.
    """
    known = {
        name: paper.parameters[name]["value"] for name in ("gamma_low", "gamma_high", "h_mean")
    }
    stock = Landings()
    # lengths of pieces beside the stock's
    size = (float(np.mean([t.m_piece for t in targets])) / 5.832e-3) ** (1.0 / 3.0)
    times = {name: size * getattr(stock, name) for name in ("late_duration", "impact_delay")}
    known["gamma_high"] = min(known["gamma_high"], known["gamma_low"] + 0.02)
    return stock.values() | times | {"dt_impact": 690e-6 * size} | known


def fit_landings(
    traces: Iterable[Target],
    start: dict[str, float] | None = None,
    *,
    models: tuple[str, ...] = tuple(MODELS),
    align: str = "first-impact",
    simulations: int = 256,
    bootstrap: int = 0,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    force: bool = False,
) -> LandingFit:
    """Fit the extended model to `traces`, and choose the smallest of the nested models that traces
    kept out do not contradict.

    Args:
        traces: list of `Target`, at least LEAST_TRACES, every third of which is kept for the
            judgement.
        start: start values of any parameters; the others from the fit of the paper's model and the
            stock scene.
        models: names of MODELS that are tried, the smallest first.
        align: of the paper's fit.
        simulations: simulated portions of a step.
        bootstrap: number of refits for the intervals, at least LEAST_REFITS, or 0 for none. Each
            takes a quarter of the fit.
        seed: of all random numbers.
        progress: called with (name of the stage, done, total).
        force: also fit traces that are not plausible as they were read.

    Raises:
        BadInput: one line.
    """
    targets = list(traces)
    if len(targets) < LEAST_TRACES:
        raise BadInput(
            f"{len(targets)} traces: the extended model needs at least {LEAST_TRACES}; fit the paper's (--model paper)"
        )
    unknown = sorted(set(start or {}) - set(NAMES)) + sorted(set(models) - set(MODELS))
    if unknown:
        raise BadInput(f"{unknown[0]}: unknown; known are {', '.join((*NAMES, *MODELS))}")
    if bootstrap and bootstrap < LEAST_REFITS:
        raise BadInput(f"bootstrap = {bootstrap}: must be 0, or at least {LEAST_REFITS}")
    with jax.enable_x64(True):
        seed = checked_seed(seed)
        paper = fit(targets, align=align, bootstrap=0, seed=seed, force=force)
        return _fit(
            targets,
            paper,
            start or {},
            models,
            simulations,
            bootstrap,
            seed,
            progress or (lambda *_: None),
        )


def _fit(
    targets: list[Target],
    paper: Fit,
    given: dict[str, float],
    models: tuple[str, ...],
    simulations: int,
    bootstrap: int,
    seed: int,
    progress: ProgressCallback,
) -> LandingFit:
    frame = find_common_frame(targets)
    kept_out = targets[2::3]
    fitted = [trace for k, trace in enumerate(targets) if k % 3 != 2]
    problem = pose_problem(fitted, frame)
    sets = [draw_landings(fitted, simulations, seed + SET_SEED * k) for k in range(SETS)]
    draws = sets[0]
    start = default_start(paper, targets) | given
    judgements = {"paper": judge_paper(paper, kept_out, frame, seed)}
    reference = _judge(kept_out, accelerations(fitted, frame), frame, seed)
    found: dict[str, Values] = {}
    chosen = "paper" if judgements["paper"].joint.p >= ALARM else None
    steps = (BEST * STEPS[0] + STEPS[1]) * len(models)
    done = iter(range(1, steps + 1))
    for name in models if chosen is None else ():
        found[name] = _descend_from_all(
            start, MODELS[name], problem, sets, seed, lambda: progress("fit", next(done), steps)
        )
        judgements[name] = judge_landings(
            to_values(found[name], MODELS[name]), kept_out, frame, seed
        )
        if judgements[name].joint.p >= ALARM:
            chosen = name
            break
        start = start | {
            k: float(v)
            for k, v in to_values(found[name], MODELS[name]).items()
            if k in MODELS[name]
        }
    best = chosen or min(judgements, key=lambda name: judgements[name].joint.distance)
    parameters = _parameters(best, found, paper, problem, draws, targets, bootstrap, seed, progress)
    return LandingFit(
        model=best,
        parameters=parameters,
        impacts=draws.impacts,
        judgements={
            name: _plain(judgement)
            for name, judgement in (judgements | {"traces": reference}).items()
        },
        statements=statements(best, chosen, judgements, reference)
        + ([] if bootstrap else [NO_INTERVALS]),
        paper=paper,
        info=paper.info
        | {
            "align": "first-impact",
            "bootstrap": bootstrap,
            "kept_out": len(kept_out),
            "simulations": simulations,
        }
        | {
            "release_delay": release_delay(found[best], MODELS[best], draws, targets)
            if best != "paper"
            else 0.0
        },
    )


def release_delay(
    u: Values, free: tuple[str, ...], draws: LandingDraws, targets: list[Target]
) -> float:
    """Mean delay (s) of the first impact of the traces after that of the model.

    A fit from the first impact on does not see it. It is the time for which the feed bucket still
    bears the portion, if times count from its opening.
    """
    pulses = jax.vmap(lambda row: portion_pulses(to_values(u, free), row, targets[0].gravity))(
        draws
    )
    first = jnp.min(jnp.where(draws.mass > 0.0, pulses.first_touch, jnp.inf), axis=1)
    return float(np.mean([trace.first_impact for trace in targets]) - jnp.mean(first))


def _descend_from_all(
    start: Values,
    free: tuple[str, ...],
    problem: LandingProblem,
    draws: Sequence[LandingDraws],
    seed: int,
    tell: Callable[[], object],
) -> Values:
    """Coordinates of the least loss: a coarse search, Adam from the best few with the first of the
    `draws`, and from the best of these with all of them in turn.
    """
    u0 = to_coordinates(start)
    data = jnp.asarray(problem.summaries), jnp.asarray(problem.centre), jnp.asarray(problem.scale)
    others = data, problem.gravity, free, problem.frame
    few = jax.tree.map(lambda leaf: leaf[:SEARCH_SIMULATIONS], draws[0])
    starts = scattered_starts(start, SEARCHED, seed)
    values = [float(loss_alone(u, u0, few, *others)) for u in starts]
    order = np.argsort(np.nan_to_num(values, nan=np.inf))
    tried = [0, *(k for k in order if k != 0)][:BEST]
    ends = [
        minimize_landing_loss(starts[k], (u0, draws[0], *others), STEPS[0], RATES[0], tell)
        for k in tried
    ]
    best = min(ends, key=lambda end: end[0])[1]
    return minimize_with_fresh_draws(best, draws, others, STEPS[1], RATES[1], tell)


def _all_summaries(rows: np.ndarray, frame: TraceFrame) -> np.ndarray:
    return np.concatenate(
        [np.asarray(summarize_rows(jnp.asarray(rows), frame)), count_peaks(rows, frame)], axis=1
    )


def judge_landings(
    values: Values, targets: list[Target], frame: TraceFrame, seed: int, simulations: int = JUDGED
) -> SampleComparison:
    """Compare traces that were not fitted with simulated ones at `values`, with other random
    numbers than any fit.
    """
    draws = draw_landings(targets, simulations, seed + 4_000_003)
    rows = np.asarray(
        _simulated(jax.tree.map(jnp.asarray, values), draws, targets[0].gravity, frame)
    )
    return _judge(targets, rows, frame, seed)


_simulated = jax.jit(simulated, static_argnames=("frame", "gravity"))


def judge_paper(
    paper: Fit, targets: list[Target], frame: TraceFrame, seed: int, simulations: int = JUDGED
) -> SampleComparison:
    """Compare traces that were not fitted with simulated ones of the paper's model."""
    theta = {name: row["value"] for name, row in paper.parameters.items()}
    model = simulated_targets(theta, targets, simulations, seed + 4_000_003)
    return _judge(targets, accelerations(model, frame), frame, seed)


def _judge(
    targets: list[Target], rows: np.ndarray, frame: TraceFrame, seed: int
) -> SampleComparison:
    names = (*frame.names, "number of peaks", "time between peaks")
    return compare_summaries(
        _all_summaries(accelerations(targets, frame), frame),
        _all_summaries(rows, frame),
        names,
        seed=seed,
    )


def _plain(judgement: SampleComparison) -> dict[str, Any]:
    worst = [
        {
            "name": name,
            "p": judgement.single[name].p,
            "shift": judgement.shift[name],
            "spread": judgement.spread[name],
        }
        for name in judgement.worst(5)
    ]
    joint, cell = judgement.joint, judgement.cell
    of_cell = {"cell_distance": cell.distance, "cell_p": cell.p}
    singles = {"passed": judgement.passed, "of": len(judgement.single), "worst": worst}
    return {"distance": joint.distance, "p": joint.p} | of_cell | singles


def statements(
    best: str,
    chosen: str | None,
    judgements: dict[str, SampleComparison],
    reference: SampleComparison,
) -> list[str]:
    """The model that describes the traces, and the differences of the others, in words."""
    lines = [
        f"model {name}: {'not rejected' if j.joint.p >= ALARM else 'rejected'} by the traces kept out (p = {j.joint.p:.2g}, energy "
        f"distance {j.joint.distance:.3g}; load cell p = {j.cell.p:.2g}; {j.passed} of {len(j.single)} single comparisons pass)"
        for name, j in judgements.items()
    ]
    joint = reference.joint
    lines.append(
        f"the fitted traces themselves differ from those kept out by {joint.distance:.3g} (p = {joint.p:.2g})"
    )
    if chosen is None:
        worst = "; ".join(
            f"{name} by {judgements[best].shift[name]:+.2f} standard deviations, spread x {judgements[best].spread[name]:.2f}"
            for name in judgements[best].worst()
        )
        lines.append(
            f"no model describes the traces in all; nearest is {best}, which differs in {worst or 'no single number'}"
        )
    return lines


def _parameters(
    model: str,
    found: dict[str, Values],
    paper: Fit,
    problem: LandingProblem,
    draws: LandingDraws,
    targets: list[Target],
    bootstrap: int,
    seed: int,
    progress: ProgressCallback,
) -> dict[str, dict[str, Any]]:
    """name -> value, low, high, sd, free of the chosen model."""
    if model == "paper":
        return paper.parameters
    free = MODELS[model]
    values = {name: float(value) for name, value in to_values(found[model], free).items()}
    none = {name: (value, value, 0.0) for name, value in values.items()}
    ends = none
    if bootstrap:
        ends = refit_intervals(
            found[model], free, problem, targets, len(draws.z), bootstrap, seed, progress
        )
    return {
        name: {
            "value": values[name],
            "low": ends[name][0],
            "high": ends[name][1],
            "sd": ends[name][2],
            "free": name in free,
        }
        for name in NAMES
    }
