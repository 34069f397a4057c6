"""Summary of a run that has ended."""

import numpy as np

from dem_jax.assembly.load_cell_setup import find_load_cell
from dem_jax.assembly.system import inline_pieces
from dem_jax.assembly.wall_panels import describe_surfaces, inline_buckets, inline_wall_panels
from dem_jax.io.run_data import Run
from dem_jax.scene import PieceShape, Scene, parse_scene
from dem_jax.visualization.bucket_heap import describe_heap
from dem_jax.visualization.cell_oscillation import CellOscillation, find_cell_oscillation
from dem_jax.visualization.metadata import (
    describe_fills,
    describe_peak_band,
    describe_piece_count,
    describe_portion,
    describe_portions,
    describe_stickiness,
    find_main_block,
    find_main_group,
    format_values,
    summarize_stiffness,
)
from dem_jax.visualization.metrics import MEAN_WINDOW, peak_running_mean
from dem_jax.visualization.time_to_rest import RestState, find_rest
from dem_jax.visualization.variance_decomposition import describe_uncertainty

MISSED_SHARE = 0.01  # of a peak: samples that miss it by more get a note


def summarize_run(run: Run) -> list[str]:
    """Lines on a run or an ensemble: step, compile time, peak PIF, duration of the impact, settled
    mass.
    """
    info = run.info
    lines = [info["step"]] if "step" in info else []
    pieces = describe_portions(run) or describe_piece_count(run)
    if run.run_count is not None:
        pieces = f"{run.run_count} runs of {pieces}"
    scene = parse_scene(run.scene, "the file's scene")
    ended = "" if run.settled is None else ", then all was settled"
    lines += [f"{key}: {format_values(values)}" for key, values in run.parameters.items()]
    lines.append(
        f"{pieces}, {run.time[-1]:.6g} s in samples of {run.sample:.3g} s, {run.precision}{ended}"
    )
    if "piece_counts" in info:  # each run has a portion of its own
        lines += describe_stickiness(scene)
    else:
        lines += [
            *filter(None, [describe_portion(scene)]),
            *describe_stickiness(scene),
            *describe_fills(scene),
        ]
    if "settling" in info:
        lines.append(f"released after {info['settling']:.6g} s of settling, when all was settled")
    if "elapsed" in info:
        lines.append(
            f"{info['elapsed']:.1f} s elapsed, of which {info['compile_time']:.1f} s compiling"
        )
    lines += [f"note: {note}" for note in (*info.get("notes", ()), *_list_shape_notes(run))]
    group = find_main_group(run)
    block = find_main_block(run)
    if group:
        lines += _describe_peaks(run, group)
    if (swing := find_cell_oscillation(run)) is not None:
        lines.append(_describe_load_cell(run, swing))
    if block:
        rest = find_rest(run, group, block)
        mass = 1e3 * np.atleast_2d(run.settled_mass[block])[:, -1]
        unsettled = f"; {rest.describe()}" if rest.describe() else ""
        lines.append(
            f"settled mass in {block} at the end: {_format_band(mass, '{:.4g}')} g{unsettled}"
        )
    lines += filter(None, [describe_heap(run)])
    if group and block:
        lines.append(_describe_durations(rest, block))
    return [*lines, *describe_uncertainty(run)]


def _describe_load_cell(run: Run, swing: CellOscillation) -> str:
    """The reading of the load cell at the end and its maximum, with notes on oscillation and on an
    exceeded rated load.
    """
    most, cell = (
        np.abs(np.atleast_2d(run.load_cell["weight"])).max(axis=1),
        find_load_cell(parse_scene(run.scene, "the file's scene")),
    )
    rated = "" if cell is None else f" of the rated {cell.rated_load:g} kg"
    beyond = ": beyond the rated load" if cell is not None and most.max() > cell.rated_load else ""
    return f"load cell: {_describe_reading(swing)}, at most {_format_band(most, '{:.3g}')} kg{rated}{beyond}"


def _describe_reading(swing: CellOscillation) -> str:
    """The reading at the end in words."""
    swings = swing.is_oscillating
    if not swings.any():
        return f"{_format_band(1e3 * swing.last, '{:.4g}')} g at the end"
    by = f"still swings by ± {_format_band(1e3 * swing.amplitude[swings], '{:.3g}')} g at the end"
    by += f" in {swings.sum()} of {len(swings)} runs" if len(swings) > 1 else ""
    if np.isnan(swing.mean).any():
        return f"{by}: a period of {_format_band(1e3 * swing.period, '{:.3g}')} ms is longer than the run, which has no mean"
    number = swing.periods.min()
    over = f"its last {number} periods" if number > 1 else "its last period"
    return f"{_format_band(1e3 * swing.mean, '{:.4g}')} g, mean over {over} ({_format_band(1e3 * swing.period, '{:.3g}')} ms each); {by}"


def _list_shape_notes(run: Run) -> list[str]:
    """The scene's notes on the shapes of its pieces and walls, each once."""
    scene = parse_scene(run.scene, "the file's scene")
    pieces = scene.portion.product_rows if scene.portion else scene.piece
    parts = [part for part in (scene.weigh_bucket, scene.feed_bucket, scene.feeder) if part]
    return list(dict.fromkeys(row.note for row in (*pieces, *scene.wall, *parts) if row.note))


def list_piece_notes(scene: Scene) -> list[str]:
    """Notes on the STLs of a scene's pieces: repairs, unions, decomposition and simplification.
    Raises SceneError.
    """
    whole = inline_pieces(scene)
    rows: dict[str, PieceShape] = {f"piece.{n}": row for n, row in enumerate(whole.piece)}
    if whole.portion and whole.portion.product:
        rows.update({f"portion.product.{n}": row for n, row in enumerate(whole.portion.product)})
    elif whole.portion:
        rows["portion"] = whole.portion
    first = {row.note: key for key, row in reversed(rows.items()) if row.note}
    return [f"{key}: {note}" for note, key in reversed(first.items())]


def list_wall_notes(scene: Scene) -> list[str]:
    """Notes on the STLs of walls, buckets and feeder, and on the smooth surfaces of their facets.
    Raises SceneError.
    """
    read = {
        f"wall.{n}": inline_wall_panels(wall, scene.folder)[0].note
        for n, wall in enumerate(scene.wall)
        if wall.stl is not None
    }
    whole = inline_buckets(scene)
    read |= {
        name: getattr(whole, name).note
        for name in ("weigh_bucket", "feed_bucket", "feeder")
        if getattr(scene, name)
    }
    return [*(f"{key}: {note}" for key, note in read.items() if note), *describe_surfaces(scene)]


def _describe_peaks(run: Run, group: str) -> list[str]:
    """Lines on the peak of the force: its time, its mean over 10 ms, and the moduli behind it."""
    traces = np.atleast_2d(run.pif_kg(group))
    times, peaks = 1e3 * run.time[np.argmax(traces, axis=1)], traces.max(axis=1)
    if not peaks.any():
        return [f"peak PIF on {group}: nothing has landed"]
    instants = np.atleast_2d(run.pif_kg(group, mean=False)).max(axis=1)
    words = f"mean over a sample; instantaneous {_format_band(instants, '{:.3g}')} kg"
    every = run.peak_kg(group)
    tops = np.zeros(0) if every is None else np.atleast_2d(every).max(axis=1)
    if len(tops) and np.any(np.abs(tops / np.maximum(instants, 1e-30) - 1) > MISSED_SHARE):
        words += f" in samples, {_format_band(tops, '{:.3g}')} kg in every step"
    over = peak_running_mean(run, group, MEAN_WINDOW)
    words += "" if over is None else f"; over 10 ms {_format_band(over, '{:.3g}')} kg"
    lines = [
        f"peak PIF on {group}: {_format_band(peaks, '{:.3g}')} kg at t = {_format_band(times, '{:.4g}')} ms ({words})"
    ]
    return [
        *lines,
        f"peaks are those of {summarize_stiffness(run)}",
        describe_peak_band(run, peaks),
    ]


def impact_duration(run: Run, group: str, block: str) -> float:
    """Time (s) from the first force on a group until the settled mass in a block is at its final
    value for good.

    nan if nothing has landed or settled, or if the run ended before all was at rest. run: a single
    run.
    """
    return float(find_rest(run, group, block).duration[0])


def _describe_durations(rest: RestState, block: str) -> str:
    """Describe the duration of the impact, or the reason why it is not known."""
    ms, why = 1e3 * rest.duration[np.isfinite(rest.duration)], rest.describe()
    if not len(ms):
        bound = rest.describe_bound() if len(rest.duration) == 1 else why
        return f"duration of the impact: {bound or f'nothing has settled in {block}'}"
    without = f"; {why}, which are left out" if why else ""
    return f"duration of the impact: {_format_band(ms, '{:.4g}')} ms from first force to the last piece at rest{without}"


def _format_band(values: np.ndarray, form: str) -> str:
    """A single value, or the median and the band from 5 to 95 %."""
    if len(values) == 1:
        return form.format(values[0])
    low, middle, high = (form.format(v) for v in np.quantile(values, [0.05, 0.5, 0.95]))
    return f"median {middle} (5 to 95 %: {low} to {high})"
