"""What a run says when it has ended."""

import numpy as np

from dem_jax.build.load_cell import section_of
from dem_jax.build.system import with_pieces_read
from dem_jax.build.walls import describe_surfaces, with_buckets_read, written_out
from dem_jax.scene import PieceShape, Scene, parse
from dem_jax.show.at_rest import Rest, find_rest
from dem_jax.show.facts import (
    fills_said,
    listed,
    main_block,
    main_group,
    peak_band_said,
    pieces_said,
    portion_said,
    stickiness_said,
    stiffness_in_short,
)
from dem_jax.show.heap import heap_said
from dem_jax.show.numbers import MEAN_WINDOW, peak_of_means
from dem_jax.show.swing import Swing, find_swing
from dem_jax.show.uncertainty import describe_uncertainty
from dem_jax.store.run import Run

MISSED = 0.01  # of a peak: by how much samples may miss it before it is said


def summary(run: Run) -> list[str]:
    """Lines on a run or an ensemble: step, compile time, peak PIF, duration of the impact, settled mass."""
    info = run.info
    lines = [info["step"]] if "step" in info else []
    pieces = pieces_said(run)
    if run.run_count is not None:
        pieces = f"{run.run_count} runs of {pieces}"
    scene = parse(run.scene, "the file's scene")
    ended = "" if run.settled is None else ", then all was settled"
    lines += [f"{key}: {listed(values)}" for key, values in run.parameters.items()]
    lines.append(f"{pieces}, {run.time[-1]:.6g} s in samples of {run.sample:.3g} s, {run.precision}{ended}")
    if "piece_counts" in info:  # each run has a portion of its own
        lines += stickiness_said(scene)
    else:
        lines += [*filter(None, [portion_said(scene)]), *stickiness_said(scene), *fills_said(scene)]
    if "settling" in info:
        lines.append(f"released after {info['settling']:.6g} s of settling, when all was settled")
    if "elapsed" in info:
        lines.append(f"{info['elapsed']:.1f} s elapsed, of which {info['compile_time']:.1f} s compiling")
    lines += [f"note: {note}" for note in (*info.get("notes", ()), *_notes_on_shapes(run))]
    group = main_group(run)
    block = main_block(run)
    if group:
        lines += _peaks(run, group)
    if (swing := find_swing(run)) is not None:
        lines.append(_weighed(run, swing))
    if block:
        rest = find_rest(run, group, block)
        mass = 1e3 * np.atleast_2d(run.settled_mass[block])[:, -1]
        unsettled = f"; {rest.describe()}" if rest.describe() else ""
        lines.append(f"settled mass in {block} at the end: {_range(mass, '{:.4g}')} g{unsettled}")
    lines += filter(None, [heap_said(run)])
    if group and block:
        lines.append(_durations(rest, block))
    return [*lines, *describe_uncertainty(run)]


def _weighed(run: Run, swing: Swing) -> str:
    """What the load cell reads at the end and at most, whether it still swings, and whether that is more than it is made for."""
    most, cell = np.abs(np.atleast_2d(run.load_cell["weight"])).max(axis=1), section_of(parse(run.scene, "the file's scene"))
    rated = "" if cell is None else f" of the rated {cell.rated_load:g} kg"
    beyond = ": beyond the rated load" if cell is not None and most.max() > cell.rated_load else ""
    return f"load cell: {_reading(swing)}, at most {_range(most, '{:.3g}')} kg{rated}{beyond}"


def _reading(swing: Swing) -> str:
    """The reading at the end in words."""
    swings = swing.is_swinging
    if not swings.any():
        return f"{_range(1e3 * swing.last, '{:.4g}')} g at the end"
    by = f"still swings by ± {_range(1e3 * swing.amplitude[swings], '{:.3g}')} g at the end"
    by += f" in {swings.sum()} of {len(swings)} runs" if len(swings) > 1 else ""
    if np.isnan(swing.mean).any():
        return f"{by}: a period of {_range(1e3 * swing.period, '{:.3g}')} ms is longer than the run, which has no mean"
    number = swing.periods.min()
    over = f"its last {number} periods" if number > 1 else "its last period"
    return f"{_range(1e3 * swing.mean, '{:.4g}')} g, mean over {over} ({_range(1e3 * swing.period, '{:.3g}')} ms each); {by}"


def _notes_on_shapes(run: Run) -> list[str]:
    """What the scene says of the shapes of its pieces and of its walls, each thing once."""
    scene = parse(run.scene, "the file's scene")
    pieces = scene.portion.rows if scene.portion else scene.piece
    parts = [part for part in (scene.weigh_bucket, scene.feed_bucket, scene.feeder) if part]
    return list(dict.fromkeys(row.note for row in (*pieces, *scene.wall, *parts) if row.note))


def notes_on_pieces(scene: Scene) -> list[str]:
    """What is read of the STLs of a scene's pieces: what was mended, united, cut or simplified. Raises SceneError."""
    whole = with_pieces_read(scene)
    rows: dict[str, PieceShape] = {f"piece.{n}": row for n, row in enumerate(whole.piece)}
    if whole.portion and whole.portion.product:
        rows.update({f"portion.product.{n}": row for n, row in enumerate(whole.portion.product)})
    elif whole.portion:
        rows["portion"] = whole.portion
    first = {row.note: key for key, row in reversed(rows.items()) if row.note}
    return [f"{key}: {note}" for note, key in reversed(first.items())]


def notes_on_walls(scene: Scene) -> list[str]:
    """What is read of the STLs of walls, buckets and feeder, and the smooth surfaces of their facets. Raises SceneError."""
    read = {f"wall.{n}": written_out(wall, scene.folder)[0].note for n, wall in enumerate(scene.wall) if wall.stl is not None}
    whole = with_buckets_read(scene)
    read |= {name: getattr(whole, name).note for name in ("weigh_bucket", "feed_bucket", "feeder") if getattr(scene, name)}
    return [*(f"{key}: {note}" for key, note in read.items() if note), *describe_surfaces(scene)]


def _peaks(run: Run, group: str) -> list[str]:
    """The peak of the force, when it is, its mean over 10 ms and what it rests on."""
    traces = np.atleast_2d(run.pif_kg(group))
    times, peaks = 1e3 * run.time[np.argmax(traces, axis=1)], traces.max(axis=1)
    if not peaks.any():
        return [f"peak PIF on {group}: nothing has landed"]
    instants = np.atleast_2d(run.pif_kg(group, mean=False)).max(axis=1)
    words = f"mean over a sample; instantaneous {_range(instants, '{:.3g}')} kg"
    every = run.peak_kg(group)
    tops = np.zeros(0) if every is None else np.atleast_2d(every).max(axis=1)
    if len(tops) and np.any(np.abs(tops / np.maximum(instants, 1e-30) - 1) > MISSED):
        words += f" in samples, {_range(tops, '{:.3g}')} kg in every step"
    over = peak_of_means(run, group, MEAN_WINDOW)
    words += "" if over is None else f"; over 10 ms {_range(over, '{:.3g}')} kg"
    lines = [f"peak PIF on {group}: {_range(peaks, '{:.3g}')} kg at t = {_range(times, '{:.4g}')} ms ({words})"]
    return [*lines, f"peaks are those of {stiffness_in_short(run)}", peak_band_said(run, peaks)]


def impact_duration(run: Run, group: str, block: str) -> float:
    """Time (s) from the first force on a group until the settled mass in a block is at its final value for good.

    nan if nothing has landed or settled, or if the run ended before all was at rest. run: a single run.
    """
    return float(find_rest(run, group, block).duration[0])


def _durations(rest: Rest, block: str) -> str:
    """How long the impact lasted, or why that is not known."""
    ms, why = 1e3 * rest.duration[np.isfinite(rest.duration)], rest.describe()
    if not len(ms):
        bound = rest.describe_bound() if len(rest.duration) == 1 else why
        return f"duration of the impact: {bound or f'nothing has settled in {block}'}"
    without = f"; {why}, which are left out" if why else ""
    return f"duration of the impact: {_range(ms, '{:.4g}')} ms from first force to the last piece at rest{without}"


def _range(values: np.ndarray, form: str) -> str:
    """A single value, or the median and the band from 5 to 95 %."""
    if len(values) == 1:
        return form.format(values[0])
    low, middle, high = (form.format(v) for v in np.quantile(values, [0.05, 0.5, 0.95]))
    return f"median {middle} (5 to 95 %: {low} to {high})"
