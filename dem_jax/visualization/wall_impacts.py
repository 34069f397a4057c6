"""Collisions with walls in numbers and as a figure: impact speeds, and maps over panels."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from dem_jax import assembly
from dem_jax.errors import RecordError
from dem_jax.io.run_data import Run
from dem_jax.scene import parse_scene
from dem_jax.visualization import run_figure
from dem_jax.visualization.comparison_figure import COLOURS
from dem_jax.visualization.metadata import find_main_group
from dem_jax.visualization.metrics import Metric, format_metric

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAPPED_QUANTITIES = {
    "energy": ("energy dissipated", "mJ", 1e3),
    "impulse": ("normal impulse", "mN s", 1e3),
    "number": ("collisions", "1", 1.0),
}
MOST_PANELS = 4  # of which maps are drawn: those with most
CM2 = 1e4  # in a m2


class ImpactMap(NamedTuple):
    """Impacts on a panel by places in the box around it, mean of the runs.

    group: wall group of the panel. number, impulse (N s), energy (J): [cells, cells], the second
    axis along the panel's own x. half_extent: [2] (m), of the box. axes: [2, 3], its own x and y in
    the scene's rest pose. corners: [k, 2] (m), of the panel in its own frame.
    """

    group: str
    number: np.ndarray
    impulse: np.ndarray
    energy: np.ndarray
    half_extent: np.ndarray
    axes: np.ndarray
    corners: np.ndarray


def load_statistics(run: Run) -> dict[str, Any]:
    """The statistics of collisions in a file, see dynamics.collision_summary.summarize_collisions.

    Raises RecordError for a run without.
    """
    found = run.info.get("collisions")
    if found is None:
        raise RecordError(
            "the run has no statistics of collisions; allowed: one of a scene with [statistics]"
        )
    return found


def count_impact_speeds(run: Run) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Edges (m/s) of the classes of impact speeds, [classes + 1], and reported group -> collisions
    in each, [K, classes] for K runs; the last class includes all faster ones. Raises RecordError.
    """
    told = load_statistics(run)
    with _convert_errors():
        each = np.array([one["speeds"] for one in told["runs"]], float)  # [K, G, classes]
        members = _group_members(run, told["groups"])
        return np.linspace(0.0, told["fastest"], each.shape[2] + 1), {
            n: each[:, rows].sum(axis=1) for n, rows in members.items()
        }


def map_impacts(run: Run, group: str) -> list[ImpactMap]:
    """The maps of the panels of a reported wall group. Raises RecordError."""
    told = load_statistics(run)
    _check_group(run, group)
    with jax.enable_x64(True):
        scene = parse_scene(run.scene, "the file's scene")
        panels, motions, joint, *_ = assembly.wall_panels.lay_out_walls(scene)
        walls = assembly.wall_panels.build_walls(scene, panels, motions, joint, np.float64)[0]
        half, turn, centre, number = (
            np.asarray(x) for x in (walls.half_extent, walls.rotation, walls.centre, walls.group)
        )
    with _convert_errors():
        cells, rows = told["cells"], _group_members(run, told["groups"])[group]
        sums = np.zeros((3, len(number), cells, cells))
        for one in told["runs"]:
            for k, name in enumerate(("number", "impulse", "energy")):
                np.add.at(
                    sums[k].reshape(-1),
                    np.array(one["place"], int),
                    np.array(one[name]) / len(told["runs"]),
                )
    found = []
    for panel in np.flatnonzero(np.isin(number, rows)):
        corners = (panels[panel][1] - centre[:, panel]) @ turn[:, :, panel]
        name = told["groups"][number[panel]]
        number_of, impulse, energy = sums[:, panel]
        found.append(
            ImpactMap(
                name,
                number_of,
                impulse,
                energy,
                half[:2, panel],
                turn[:, :2, panel].T,
                corners[:, :2],
            )
        )
    return found


def tabulate_impacts(run: Run) -> list[str]:
    """Lines on each wall group: collisions, mean and largest impact speed, impulse, energy. Raises
    RecordError.
    """
    told, lines = load_statistics(run), []
    with _convert_errors():
        # [K, G]
        total, largest = (
            np.array([one[name] for one in told["runs"]]) for name in ("sum", "largest")
        )
        for name, rows in _group_members(run, told["groups"]).items():
            count, impulse, energy = (
                np.atleast_2d(getattr(run, series)[name])[:, -1].astype(np.float64)
                for series in ("collision_count", "collision_impulse", "collision_energy")
            )
            if not count.any():
                lines.append(f"{name}: no collisions")
                continue
            mean = np.divide(
                total[:, rows].sum(axis=1), count, where=count > 0, out=np.full(len(count), np.nan)
            )
            numbers = (
                Metric("number", "collisions", count),
                Metric("mean speed", "m/s", mean),
                Metric("fastest", "m/s", largest[:, rows].max(axis=1)),
                Metric("normal impulse", "mN s", 1e3 * impulse),
                Metric("dissipated", "mJ", 1e3 * energy),
            )
            lines += [f"{name}: {number.name}: {format_metric(number)}" for number in numbers]
    return lines


def plot_wall_impacts(
    run: Run, path: str | Path, group: str | None = None, of: str = "energy"
) -> Path:
    """Save ``draw_wall_impacts`` as PNG, PDF or SVG. Returns the path. Raises RecordError."""
    path = Path(path)
    run_figure.check_format(path, run_figure.PICTURE_FORMATS)
    return run_figure.save_figure(draw_wall_impacts(run, group, of), path, dpi=200)


def draw_wall_impacts(run: Run, group: str | None = None, of: str = "energy") -> "Figure":
    """Figure (matplotlib.figure.Figure): impact speeds on each wall group, and maps over the panels
    of one group (by default the weigh bucket's flaps, or the first).

    of: quantity of the maps, a key of MAPPED_QUANTITIES. Ensembles are shown by the mean of their
    runs. Raises RecordError.
    """
    from matplotlib.figure import Figure

    group = group or find_main_group(run) or "none"
    maps = map_impacts(run, group)
    most = sorted(maps, key=lambda each: -float(np.abs(getattr(each, of)).sum()))[:MOST_PANELS]
    shown = [each for each in maps if any(each is one for one in most)]
    figure = Figure(figsize=(4.6 + 3.2 * len(shown), 4.0), layout="constrained")
    first, *others = figure.subplots(
        1, 1 + len(shown), squeeze=False, width_ratios=[1.3] + [1.0] * len(shown)
    )[0]
    _draw_speeds(first, run)
    words, unit, scale = MAPPED_QUANTITIES[of]
    dense = [scale * getattr(each, of) / _place_area(each) for each in shown]
    top = max((float(each.max()) for each in dense), default=0.0)
    for axes, each, values in zip(others, shown, dense, strict=True):
        image = _draw_map(axes, each, values, top)
    if shown:
        figure.colorbar(
            image,
            ax=others,
            label=f"{words} ({unit}/cm²)" if unit != "1" else f"{words} (1/cm²)",
            shrink=0.8,
        )
    figure.suptitle(f"{run_figure.run_title(run)}: collisions, and where on {group}", fontsize=11)
    return figure


def _draw_speeds(axes: "Axes", run: Run) -> None:
    edges, groups = count_impact_speeds(run)
    for k, (name, counts) in enumerate((name, c) for name, c in groups.items() if c.any()):
        axes.stairs(counts.mean(axis=0), edges, color=COLOURS[k % len(COLOURS)], lw=1.2, label=name)
    axes.set_xlim(
        0.0,
        edges[
            1
            + max(
                (int(np.flatnonzero(c.any(axis=0)).max(initial=0)) for c in groups.values()),
                default=0,
            )
        ],
    )
    axes.set_xlabel("impact speed (m/s)")
    axes.set_ylabel("collisions" + ("" if run.run_count is None else ", mean of the runs"))
    axes.set_ylim(0.0, None)
    axes.grid(alpha=0.25, lw=0.5)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=False)


def _draw_map(axes: "Axes", of: ImpactMap, values: np.ndarray, top: float) -> Any:
    """Draw a panel with its axes along the scene's; returns the image for the colour bar."""
    flips, names = [], []
    for direction in of.axes:
        main = int(np.abs(direction).argmax())
        flips.append(np.sign(direction[main]))
        names.append("xyz"[main])
    x, y = 1e3 * of.half_extent
    turned = values[:: int(flips[1]), :: int(flips[0])]
    image = axes.imshow(
        turned, origin="lower", extent=(-x, x, -y, y), cmap="magma_r", vmin=0.0, vmax=top or 1.0
    )
    outline = 1e3 * np.vstack([of.corners, of.corners[:1]]) * flips
    axes.plot(*outline.T, color="#333333", lw=0.8)
    axes.set_title(of.group, fontsize=9)
    axes.set_xlabel(f"along {names[0]} (mm)")
    axes.set_ylabel(f"along the panel, towards {names[1]} (mm)")
    return image


def _place_area(of: ImpactMap) -> float:
    """Area of a place (cm2)."""
    return float(CM2 * 4 * of.half_extent.prod() / of.number.size)


def _group_members(run: Run, groups: Sequence[str]) -> dict[str, list[int]]:
    """Reported group -> the places of its groups among the G."""
    scene = parse_scene(run.scene, "the file's scene")
    joint = assembly.wall_panels.lay_out_walls(scene)[2]
    found: dict[str, list[int]] = {}
    for k, name in enumerate(groups):
        found.setdefault(joint.get(name, name), []).append(k)
    return found


def _check_group(run: Run, group: str) -> None:
    if group not in run.force:
        raise RecordError(
            f"group = {group!r} is not in this run; it has: {', '.join(run.force) or 'none'}"
        )


@contextmanager
def _convert_errors() -> Iterator[None]:
    """Turn an error in the file's numbers into one clear line, as RecordError."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError) as error:
        if isinstance(error, RecordError):
            raise
        raise RecordError(f"the file is damaged: its statistics of collisions ({error})") from error
