"""Results of a study in words and tables: its points with bands, reference values, and influences
of parameters.
"""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from dem_jax.errors import SceneError
from dem_jax.io.atomic_files import write_atomically
from dem_jax.scene.toml_text import align_columns, format_value
from dem_jax.study import trace_comparison
from dem_jax.study.batches import format_point
from dem_jax.study.config import RMSE_OUTPUTS, ReferenceValue, Study
from dem_jax.study.design import list_points
from dem_jax.study.outputs import OUTPUTS
from dem_jax.study.results_file import DONE, LOST, OPEN, StudyResults
from dem_jax.study.uncertain_parameters import describe_study_uncertainty, range_probabilities
from dem_jax.visualization.metadata import describe_peak_factors, find_softened_modulus, format_si
from dem_jax.visualization.metrics import Metric
from dem_jax.visualization.variance_decomposition import split_variance

MOST_DEGREE = 6  # of polynomials
MOST_NOTES = 3  # of runs, that are shown
FEWEST_POINTS, MANY_POINTS = 8, 128  # drawn points from which on ranks are correlated, and shares
# of the variance computed
STIFFNESS_WORDS = ("product", "youngs_modulus", "softening")  # in keys of parameters on which the
# stiffness of pieces depends


def parameter_label(study: Study, key: str) -> str:
    """A parameter in tables and figures."""
    return study.parameter[key].label or key


def output_metric(results: StudyResults, name: str, members: np.ndarray) -> Metric:
    """An output of the finished ones among selected drops. members: [M] bool."""
    output = OUTPUTS[name]
    return Metric(
        name, output.unit, results.outputs[name][members & (results.state == DONE)], output.digits
    )


def select_point(results: StudyResults, point: int) -> np.ndarray:
    """The drops of a point, [M] bool."""
    return np.arange(len(results.state)) // results.study.seeds == point


def tabulate_points(results: StudyResults) -> tuple[list[str], list[list[str]]]:
    """Head and rows: a row for each point, with the median and the band from 5 to 95 % of each
    output."""
    study = results.study
    heads = [
        f"{name} ({OUTPUTS[name].unit})" if OUTPUTS[name].unit else name for name in study.outputs
    ]
    rows = []
    for k, point in enumerate(list_points(study)):
        which = select_point(results, k)
        done = int((results.state[which] == DONE).sum())
        outputs = [format_median(output_metric(results, name, which)) for name in study.outputs]
        rows.append([*map(format_parameter, point.values()), str(done), *outputs])
    return [*(parameter_label(study, key) for key in study.parameter), "drops", *heads], rows


def write_csv(results: StudyResults, path: Path) -> Path:
    """All drops, a row each: parameters, seed, outputs (empty: none). Raises RecordError."""
    study = results.study
    points = list_points(study)
    heads = [
        f"{name} ({OUTPUTS[name].unit})" if OUTPUTS[name].unit else name for name in study.outputs
    ]
    text = io.StringIO(newline="")
    rows = csv.writer(text)
    rows.writerow([*study.parameter, "seed", *heads])
    for member in np.flatnonzero(results.state == DONE).tolist():
        values = [results.outputs[name][member] for name in study.outputs]
        told = ["" if np.isnan(v) else f"{v:.9g}" for v in values]
        rows.writerow([*points[member // study.seeds].values(), study.member_seed(member), *told])
    return write_atomically(path, text.getvalue().encode())


def format_parameter(item: Any) -> str:
    """A value of a parameter."""
    return f"{item:.4g}" if isinstance(item, float) else format_value(item)


def format_median(number: Metric) -> str:
    """The median, the band where there are several values, and the number of drops that have a
    value, unless all have one.
    """
    known = number.values[np.isfinite(number.values)]
    if not len(known):
        return "-"
    count = f" [{len(known)} of {len(number.values)}]" if len(known) < len(number.values) else ""
    if len(known) == 1 or np.ptp(known) <= 1e-9 * abs(known[0]):
        return f"{known[0]:.{number.digits}g}{count}"
    low, high = number.band
    return f"{number.median:.3g} ({low:.3g} to {high:.3g}){count}"


class ReferenceComparison(NamedTuple):
    """A reference value of another author, and the study's own value."""

    reference: ReferenceValue
    ours: Metric
    verdict: str


def compare_references(results: StudyResults) -> list[ReferenceComparison]:
    """Compare each reference with the drops at its points."""
    found = []
    for row in results.study.reference:
        which = np.zeros(len(results.state), bool)
        for k, point in enumerate(list_points(results.study)):
            if all(_is_same_value(point[key], wanted) for key, wanted in row.at.items()):
                which |= select_point(results, k)
        ours = (
            _trace_rmse(results, row.output, which)
            if row.output in RMSE_OUTPUTS
            else output_metric(results, row.output, which)
        )
        found.append(ReferenceComparison(row, ours, _judge_reference(row, ours)))
    return found


def _trace_rmse(results: StudyResults, name: str, which: np.ndarray) -> Metric:
    """Root mean square differences of traces, see RMSE_OUTPUTS."""
    if not results.force or not which.any():
        return Metric(name, "g", np.zeros(0))
    if name == "rmse_model":
        return Metric(name, "g", trace_comparison.rmse_to_model(results))
    return Metric(
        name, "g", trace_comparison.rmse_to_point(results, which, _select_compared_point(results))
    )


def _select_compared_point(results: StudyResults) -> np.ndarray:
    """The drops of the point that others are compared with, [M] bool."""
    points, wanted = list_points(results.study), results.study.compare
    k = next(
        (
            k
            for k, point in enumerate(points)
            if all(_is_same_value(point[key], v) for key, v in wanted.items())
        ),
        -1,
    )
    return select_point(results, k)


def _is_same_value(a: Any, b: Any) -> bool:
    return (
        bool(np.isclose(a, b, rtol=1e-9, atol=0))
        if isinstance(a, int | float) and isinstance(b, int | float)
        else a == b
    )


def _judge_reference(row: ReferenceValue, ours: Metric) -> str:
    low, high = ours.band
    if not np.isfinite(low):
        return "no drops"
    if row.low <= ours.median <= row.high:
        return "our median is within theirs"
    return "within our band" if low <= row.high and row.low <= high else "contradiction"


class Influence(NamedTuple):
    """Influence of a parameter on an output: its share of the variance by itself (first order), or
    with few points the correlation of ranks; low, high: 90 % interval of a share, 95 % of a
    correlation.
    """

    output: str
    parameter: str
    is_share: bool
    value: float
    low: float
    high: float


def find_influences(results: StudyResults) -> list[Influence]:
    """Influences of drawn parameters with ranges on the means of points; none for a grid or few
    points.

    Shares are those of polynomials of up to sixth degree
    (``visualization.variance_decomposition``).
    """
    study = results.study
    keys = [key for key, parameter in study.parameter.items() if parameter.values is None]
    points = list_points(study)
    if study.design == "grid" or not keys or len(points) < FEWEST_POINTS:
        return []
    inputs, found = np.array([[point[key] for key in keys] for point in points], float), []
    for name in study.outputs:
        y = _point_means(results, name)
        known = np.isfinite(y)
        if known.sum() < FEWEST_POINTS or np.ptp(y[known]) <= 1e-3 * np.abs(y[known]).max():
            continue
        shares = (
            _variance_shares(study, keys, inputs[known], y[known])
            if known.sum() >= MANY_POINTS
            else None
        )
        for k, key in enumerate(keys):
            row = _rank_correlation(inputs[known, k], y[known]) if shares is None else shares[k]
            found.append(Influence(name, key, shares is not None, *row))
    return found


def _variance_shares(
    study: Study, keys: list[str], inputs: np.ndarray, y: np.ndarray
) -> list[tuple[float, float, float]]:
    """First-order shares of each parameter with their 90 % intervals."""
    drawn = np.array(
        [range_probabilities(study.parameter[key], inputs[:, k]) for k, key in enumerate(keys)]
    ).T
    split = split_variance(drawn, keys, Metric("", "", y), range(MOST_DEGREE, 0, -1))
    assert split is not None  # as there are MANY values, which differ
    parts = {part.name: part for part in split.parts}
    return [(parts[key].value, parts[key].low, parts[key].high) for key in keys]


def _rank_correlation(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Spearman's rank correlation, with Fisher's interval."""
    r = float(stats.spearmanr(x, y).statistic)
    half = 1.96 * np.sqrt(1.06 / (len(x) - 3))
    low, high = np.tanh(np.arctanh(np.clip(r, -0.999999, 0.999999)) + np.array([-half, half]))
    return r, float(low), float(high)


def _point_means(results: StudyResults, name: str) -> np.ndarray:
    """Mean of an output over the drops of each point that are done, [points]; nan where none is."""
    values = results.group_by_point(np.where(results.state == DONE, results.outputs[name], np.nan))
    known = np.isfinite(values)
    return np.where(
        known.any(axis=1),
        np.where(known, values, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1),
        np.nan,
    )


def fit_power_laws(results: StudyResults) -> Iterator[tuple[str, str, float, float]]:
    """(output, parameter, p, half of its 95 % interval) of outputs proportional to a power p of the
    only parameter, if its range is logarithmic: least squares of logarithms over all drops.
    """
    study = results.study
    if [parameter.log for parameter in study.parameter.values()] != [True]:
        return
    (key,) = study.parameter
    points = list_points(study)
    x = np.repeat(
        [p[key] if isinstance(p[key], int | float) else np.nan for p in points], study.seeds
    ).astype(float)
    for name in study.outputs:
        y = np.where(results.state == DONE, results.outputs[name], np.nan)
        known = np.isfinite(y) & (y > 0) & (x > 0)
        if len(np.unique(x[known])) < 3 or np.ptp(y[known]) <= 1e-9 * y[known].max():
            continue
        a, b = np.log(x[known]), np.log(y[known])
        line = stats.linregress(a, b)
        yield name, key, float(line.slope), float(1.96 * line.stderr)


def describe_results(results: StudyResults) -> list[str]:
    """All results as lines of text."""
    head, rows = tabulate_points(results)
    first, *others = list_findings(results)
    return [results.study.title, first, "", *align_columns([head, *rows]), *others]


def list_findings(results: StudyResults) -> list[str]:
    """Lines beside the table of points, the first of which gives the number of drops."""
    study = results.study
    _, rows = tabulate_points(results)
    lost, left = int((results.state == LOST).sum()), int((results.state == OPEN).sum())
    lines = [
        f"{len(results.state)} drops, {study.seeds} at each of {len(rows)} points, {results.elapsed:.0f} s"
    ]
    if any("(" in cell for row in rows for cell in row):
        lines += ["medians, in brackets 5 to 95 %"]
    lines += [
        f"{name} goes with {key} to the power {p:.3f} ± {half:.3f}"
        for name, key, p, half in fit_power_laws(results)
    ]
    found = find_influences(results)
    for name in study.outputs:
        lines += _describe_influences(study, [i for i in found if i.output == name])
    lines += [*describe_study_uncertainty(results), *_describe_distances(results)]
    for row, ours, verdict in compare_references(results):
        at = "".join(f", {key} = {format_parameter(v)}" for key, v in row.at.items())
        lines.append(
            f"{row.source}{at}: {row.output} {row.low:g} to {row.high:g} {ours.unit}; ours {format_median(ours)}: {verdict}"
        )
    lines += [*describe_unsettled_drops(results), *_describe_stiffness(results)]
    lines += [f"note: {note}" for note in results.notes[:MOST_NOTES]]
    if len(results.notes) > MOST_NOTES:
        lines.append(f"{len(results.notes) - MOST_NOTES} more notes of batches are in the file")
    if lost:
        lines.append(
            f"{lost} of the drops went wrong: "
            + "; ".join(dict.fromkeys(results.failure_reasons.values()))
        )
    return lines + ([f"{left} drops are still to be done"] if left else [])


def describe_unsettled_drops(results: StudyResults) -> list[str]:
    """The outputs that are missing for drops that ended before all was at rest, and the number of
    these drops."""
    done = results.state == DONE
    outputs = [name for name in results.study.outputs if OUTPUTS[name].needs_rest]
    lacking = {name: int((done & np.isnan(results.outputs[name])).sum()) for name in outputs}
    most = max(lacking.values(), default=0)
    if not most:
        return []
    names = ", ".join(name for name, count in lacking.items() if count)
    why = "pieces still moved when their run ended (run.duration), or nothing had landed"
    return [
        f"{most} of {int(done.sum())} drops have no {names}: {why}; medians and bands are of the others"
    ]


def _describe_stiffness(results: StudyResults) -> list[str]:
    """The moduli and the softening behind the peaks of a study, or the least and the greatest of
    its points; nothing if its scene no longer exists.
    """
    study = results.study
    if not any(OUTPUTS[name].unit == "kg" for name in study.outputs):
        return []
    keys = [key for key in study.parameter if any(word in key for word in STIFFNESS_WORDS)]
    try:
        base = study.base_scene()
        if not keys:
            return [f"peaks are those of {describe_peak_factors(base)}"]
        moduli = {
            format_point(own): find_softened_modulus(base.replace(own))
            for own in ({key: point[key] for key in keys} for point in list_points(study))
        }
    except SceneError:
        return []
    ends = (
        f"{format_si(moduli[at], 'Pa')} ({at})"
        for at in (min(moduli, key=moduli.__getitem__), max(moduli, key=moduli.__getitem__))
    )
    return [f"peaks are those of moduli E NSF of each point, from {' to '.join(ends)}"]


def _describe_influences(study: Study, rows: list[Influence]) -> list[str]:
    """A line on the influences of parameters on an output, if they are known."""
    if not rows:
        return []
    said = [
        f"{parameter_label(study, i.parameter)} {i.value:.2f} ({i.low:.2f} to {i.high:.2f})"
        for i in rows
    ]
    return [
        f"{rows[0].output}, {'share of its variance' if rows[0].is_share else 'correlation of ranks'}: {', '.join(said)}"
    ]


def _describe_distances(results: StudyResults) -> list[str]:
    """Distances between traces: of two drops that differ only in their seed, and from the Product
    Model.
    """
    if not results.force:
        return []
    found = []
    for k, point in enumerate(list_points(results.study)):
        rows = trace_comparison.align_traces(results, select_point(results, k))
        at = "".join(f", {key} = {format_parameter(v)}" for key, v in point.items())
        if len(rows) > 1:
            found.append(
                f"two independent drops{at}: RMSE {format_median(Metric('rmse', 'g', trace_comparison.trace_distances(rows)))} g"
            )
        if (
            results.study.compare
            and k != int(np.argmax(_select_compared_point(results))) // results.study.seeds
        ):
            number, wanted = (
                _trace_rmse(results, "rmse", select_point(results, k)),
                results.study.compare.items(),
            )
            beside = ", ".join(f"{key} = {format_parameter(v)}" for key, v in wanted)
            found.append(f"beside {beside}{at}: RMSE {format_median(number)} g")
    if results.study.model is not None:
        found.append(
            f"a drop and the Product Model: RMSE {format_median(_trace_rmse(results, 'rmse_model', results.state == DONE))} g"
        )
    return found
