"""What a run says when it has ended."""

from collections.abc import Sequence

import numpy as np

from dem_jax.build.load_cell import section_of
from dem_jax.build.system import with_pieces_read
from dem_jax.build.walls import describe_surfaces, with_buckets_read, written_out
from dem_jax.scene import PieceShape, Scene, parse
from dem_jax.show.facts import fills_said, portion_said, stickiness_said, stiffness_in_short
from dem_jax.show.heap import heap_said
from dem_jax.store.run import Run

MISSED = 0.01  # of a peak: by how much samples may miss it before it is said


def summary(run: Run) -> list[str]:
    """Lines on a run or an ensemble: step, compile time, peak PIF, duration of the impact, settled mass."""
    info, count = run.info, run.header.piece_count
    lines = [info["step"]] if "step" in info else []
    pieces = f"{count} piece{'s' if count != 1 else ''}"
    if run.run_count is not None:
        pieces = f"{run.run_count} runs of {pieces}"
    asked = portion_said(parse(run.scene, "the file's scene"))
    ended = "" if run.settled is None else ", then all was settled"
    lines += [f"{key}: {_listed(values)}" for key, values in run.parameters.items()]
    lines.append(f"{pieces}, {run.time[-1]:.6g} s in samples of {run.sample:.3g} s, {run.precision}{ended}")
    lines += [] if asked is None else [asked]
    scene = parse(run.scene, "the file's scene")
    lines += [*stickiness_said(scene), *fills_said(scene)]
    if "settling" in info:
        lines.append(f"released after {info['settling']:.6g} s of settling, when all was settled")
    if "elapsed" in info:
        lines.append(f"{info['elapsed']:.1f} s elapsed, of which {info['compile_time']:.1f} s compiling")
    lines += [f"note: {note}" for note in (*info.get("notes", ()), *_notes_on_shapes(run))]
    group = main_group(run)
    block = main_block(run)
    members = [run] if run.run_count is None else [run.member(k) for k in range(run.run_count)]
    if group:
        lines += [_peaks(members, group), f"peaks are those of {stiffness_in_short(run)}"]
    if "signal" in getattr(run, "load_cell", {}):
        lines.append(_weighed(run))
    if block:
        mass = 1e3 * np.array([m.settled_mass[block][-1] for m in members])
        lines.append(f"settled mass in {block} at the end: {_range(mass, '{:.4g}')} g")
    lines += filter(None, [heap_said(run)])
    if group and block:
        lines.append(_durations(members, group, block))
    return lines


def _listed(values: np.ndarray) -> str:
    """The values of a parameter, one for each run, in few words."""
    if values.ndim > 1 or values.dtype.kind not in "iuf":
        return f"{len(values)} values"
    return f"{values.min():.4g} to {values.max():.4g} ({len(np.unique(values))} values)"


def _weighed(run: Run) -> str:
    """What the load cell reads at the end and at most, and whether that is more than it is made for."""
    weight = np.atleast_2d(run.load_cell["weight"])
    most, cell = np.abs(weight).max(axis=1), section_of(parse(run.scene, "the file's scene"))
    rated = "" if cell is None else f" of the rated {cell.rated_load:g} kg"
    beyond = ": beyond the rated load" if cell is not None and most.max() > cell.rated_load else ""
    return f"load cell: {_range(1e3 * weight[:, -1], '{:.4g}')} g at the end, at most {_range(most, '{:.3g}')} kg{rated}{beyond}"


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


def main_group(run: Run) -> str | None:
    """The wall group whose force is the PIF: the weigh bucket's flaps, or the first; None: no walls."""
    return "wb_flaps" if "wb_flaps" in run.force else next(iter(run.force), None)


def main_block(run: Run) -> str | None:
    """The block whose settled mass counts: the weigh bucket's, or the first; None: there is none."""
    return "wb" if "wb" in run.settled_mass else next(iter(run.settled_mass), None)


def _peaks(members: Sequence[Run], group: str) -> str:
    traces = [m.pif_kg(group) for m in members]
    times = np.array([1e3 * m.time[np.argmax(t)] for m, t in zip(members, traces, strict=True)])
    peaks = np.array([t.max() for t in traces])
    if not peaks.any():
        return f"peak PIF on {group}: nothing has landed"
    instants = np.array([m.pif_kg(group, mean=False).max() for m in members])
    words = f"mean over a sample; instantaneous {_range(instants, '{:.3g}')} kg"
    every = [m.peak_kg(group) for m in members]
    tops = np.array([trace.max() for trace in every if trace is not None])
    if len(tops) and np.any(np.abs(tops / np.maximum(instants, 1e-30) - 1) > MISSED):
        words += f" in samples, {_range(tops, '{:.3g}')} kg in every step"
    return f"peak PIF on {group}: {_range(peaks, '{:.3g}')} kg at t = {_range(times, '{:.4g}')} ms ({words})"


def impact_duration(run: Run, group: str, block: str) -> float:
    """Time (s) from the first force on a group until the settled mass in a block is at its final value for good.

    nan if nothing has landed or settled. run: a single run.
    """
    felt = np.flatnonzero(run.mean_force[group].any(axis=-1))
    mass = run.settled_mass[block]
    if not len(felt) or not mass[-1] > 0:
        return np.nan
    unsettled = np.flatnonzero(mass < mass[-1] * (1 - 1e-6))
    end = run.time[unsettled[-1] + 1] if len(unsettled) else run.time[0]
    return max(0.0, float(end - run.time[felt[0]]))


def _durations(members: Sequence[Run], group: str, block: str) -> str:
    ms = np.array([1e3 * impact_duration(m, group, block) for m in members])
    if not np.isfinite(ms).any():
        return f"duration of the impact: nothing has settled in {block}"
    return (
        f"duration of the impact: {_range(ms[np.isfinite(ms)], '{:.4g}')} ms from first force to the last piece at rest"
    )


def _range(values: np.ndarray, form: str) -> str:
    """A single value, or the median and the band from 5 to 95 %."""
    if len(values) == 1:
        return form.format(values[0])
    low, middle, high = (form.format(v) for v in np.quantile(values, [0.05, 0.5, 0.95]))
    return f"median {middle} (5 to 95 %: {low} to {high})"
