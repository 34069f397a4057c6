"""What the pages show of products, scenes and results, as plain data; computed in the helper
process.
"""

import json
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dem_jax.app.card_store import recall_cards
from dem_jax.errors import RecordError, SceneError

MOST_POINTS = 1200  # of a curve on the page; each has the least and the largest sample of its span
INSTANTS = 121  # of the moving flaps in the view of the buckets
NO_LETTERS = "nothing was mended"


class ProductCard(NamedTuple):
    """A product as the page shows it.

    name: of the library, or of a file. text: what it is. weight: (g) of a piece. picture: SVG.
    rows: (number, value, range, grade and source) as text. states: names of its further states.
    notes: what was mended, cut or simplified in its STL.
    """

    name: str
    text: str
    weight: float
    picture: str
    rows: list[tuple[str, str, str, str]]
    states: list[str]
    notes: list[str]


class BucketCard(NamedTuple):
    """A bucket of the library: name, what it is for, litres of the weigh bucket to its brim, and
    drop height (m).
    """

    name: str
    text: str
    litres: float
    height: float


class SceneFacts(NamedTuple):
    """What is known of a scene before it is computed: notes and fill levels in words, and its
    buckets in 3-D as JSON text, for player.js. error: why it cannot be computed as the buckets
    stand; "": it can.
    """

    notes: list[str]
    view: str
    error: str


class Curve(NamedTuple):
    """A curve for a chart: [k] times (ms) and values."""

    time: list[float]
    value: list[float]


class RunFacts(NamedTuple):
    """A run or an ensemble as the page shows it.

    name: of its file. run_count: of its runs. numbers: (name, value in words). notes: what it
    depends on, in words. force, settled: curves (kg; g) of the chosen run. peak_time: (ms) of its
    force. member: its number. settings: key of the scene -> value, as text.
    """

    name: str
    run_count: int
    numbers: list[tuple[str, str]]
    notes: list[str]
    force: Curve | None
    settled: Curve | None
    peak_time: float
    member: int
    settings: dict[str, str]


class ShareFacts(NamedTuple):
    """What chance and unknown numbers have in the scatter of an ensemble, as the report shows it.

    title, caption: of the picture. lines: in words. picture: PNG in base64; "": of too few runs.
    """

    title: str
    caption: str
    lines: list[str]
    picture: str


class Comparison(NamedTuple):
    """Runs beside the first: differing keys (key, value in each), and differences in words."""

    keys: list[tuple[str, list[str]]]
    lines: list[str]


class StlFacts(NamedTuple):
    """An STL file before its unit is chosen.

    size: largest extents in units of the file. unit: guessed, m per unit. notes: what was mended.
    excess: of the hull's volume over the body's. is_hull: whether the hull may stand for it.
    volume: in units of the file.
    """

    size: list[float]
    unit: float
    notes: list[str]
    excess: float
    is_hull: bool
    volume: float


class BucketStlFacts(NamedTuple):
    """An STL of a bucket: extents (units of the file), guessed unit (m), and what was read."""

    size: list[float]
    unit: float
    notes: list[str]


def describe_products() -> list[ProductCard]:
    """The products of the library."""
    return [
        ProductCard(**{**card, "rows": [tuple(row) for row in card["rows"]]})
        for card in recall_cards("product-cards", _compute_product_cards)
    ]


def _compute_product_cards() -> list[dict[str, Any]]:
    from dem_jax.scene import library

    found = library.list_products().items()
    return [_describe_product(name, name, text)._asdict() for name, text in found]


def describe_own_product(path: str, name: str) -> ProductCard:
    """A product in a TOML file, or a state of one of the library; name: what the page calls it.
    Raises SceneError.
    """
    plain, _, state = name.partition(":")
    if state:
        from dem_jax.scene import library

        title, _, text = library.list_products()[plain].partition(": ")
        return _describe_product(path, name, f"{title}, {state}: {text}")
    return _describe_product(path, name, f"{Path(name).stem}: your own part")


def _describe_product(source: str, name: str, text: str) -> ProductCard:
    from dem_jax.app.drawing import draw_piece
    from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
    from dem_jax.scene import evidence, library, load_scene
    from dem_jax.scene.material_properties import build_material_table
    from dem_jax.visualization.summary import list_piece_notes

    scene = load_scene("weigh-bucket", {"product": source, **library.ONE_PIECE})
    goods = build_piece_set(scene)
    weight = 1e3 * float(compute_masses(goods, build_material_table(scene))[0])
    picture = draw_piece(goods.shapes[0])
    tree = library.load_product(source, "products")
    rows = [
        _split_row(row, evidence.find_number_unit(key), key)
        for key, row in _list_evidence(tree, source)
    ]
    states = library.list_product_states(source)
    return ProductCard(name, text, weight, picture, rows, states, list_piece_notes(scene))


def _list_evidence(tree: dict[str, Any], source: str) -> Iterator[tuple[str, tuple[Any, Any]]]:
    from dem_jax.scene import evidence

    for key, row in evidence.read_evidence(tree, source).items():
        yield key, (evidence.find_evidence_value(tree, key, row), row)


def _split_row(found: tuple[Any, Any], unit: str, key: str) -> tuple[str, str, str, str]:
    """A number of a product in four texts."""
    value, row = found
    name = f"{key.replace('_', ' ')} ({unit})" if unit else key.replace("_", " ")
    span = "" if row.range is None else " to ".join(f"{each:.4g}" for each in row.range)
    source = "judgement" if row.grade == "C" else row.source
    return name, _format_value(value), span, f"{row.grade}: {source}"


def _format_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " × ".join(f"{each:.4g}" for each in value)
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def describe_buckets() -> list[BucketCard]:
    """The buckets of the library."""
    from dem_jax.scene import library, load_scene
    from dem_jax.scene.bucket_geometry import bucket_volume

    found = []
    for name, text in library.list_buckets().items():
        scene = load_scene("weigh-bucket", {"bucket": name})
        assert scene.weigh_bucket is not None
        found.append(
            BucketCard(name, text, 1e3 * bucket_volume(scene.weigh_bucket), scene.drop.height)
        )
    return sorted(found, key=lambda each: each.litres)


def describe_stl(path: str) -> StlFacts:
    """What an STL of a piece holds, and a guess of its unit. Raises SceneError for one that cannot
    be used.
    """
    from dem_jax.shapes import HULL_TOLERANCE, convex_hull, read_body

    body = read_body(path)
    mesh = body.outer
    size = [float(edge) for edge in np.ptp(mesh.vertices, axis=0)]
    excess = float(convex_hull(np.asarray(mesh.vertices)).volume / mesh.volume - 1)
    notes = list(body.notes) or [NO_LETTERS]
    return StlFacts(
        size,
        guess_unit(max(size)),
        notes,
        excess,
        excess <= HULL_TOLERANCE,
        float(body.mass.volume),
    )


def guess_unit(largest: float) -> float:
    """The unit (m per unit of the file) with which a piece is of the size of food: 3 mm to 0.3 m,
    if possible millimetres.
    """
    for unit in (1e-3, 1.0, 1e-2, 25.4e-3):
        if 3e-3 <= largest * unit <= 0.3:
            return unit
    return 1e-3


def describe_bucket_stl(path: str) -> BucketStlFacts:
    """What an STL of a bucket holds, and a guess of its unit. Raises SceneError."""
    from dem_jax.shapes import wall_meshes

    found = wall_meshes.read_wall_mesh(path)
    size = [float(edge) for edge in np.ptp(np.concatenate(found.panels), axis=0)]
    return BucketStlFacts(size, 1e-3 if max(size) > 2.0 else 1.0, [str(found)])


def describe_scene(text: str, folder: str) -> SceneFacts:
    """What is known of a scene before it is computed.

    Args:
        text: TOML.
        folder: that its files are in.

    Raises:
        SceneError: it cannot be computed, wherever its buckets are.
    """
    from dem_jax.assembly.bucket_fill import bucket_capacity, check_buckets_meet
    from dem_jax.assembly.piece_arrays import build_piece_set
    from dem_jax.assembly.wall_panels import inline_buckets
    from dem_jax.scene import parse_scene
    from dem_jax.visualization.metadata import describe_fills, describe_portion, describe_stickiness
    from dem_jax.visualization.summary import list_piece_notes, list_wall_notes
    from dem_jax.visualization.web_viewer import view_walls

    scene = parse_scene(text, Path(folder) / "new.toml")
    read = inline_buckets(scene)
    notes, error = [*filter(None, [describe_portion(scene)]), *describe_fills(read)], ""
    try:
        notes += check_buckets_meet(scene, read)
    except SceneError as told:
        error = str(told)
    notes += [*describe_stickiness(scene), *list_wall_notes(scene), *list_piece_notes(scene)]
    capacity = bucket_capacity(read, "weigh_bucket")
    goods = build_piece_set(scene)
    number = goods.numbers[0] if goods.numbers else 0
    level = (
        None
        if capacity is None
        else find_level(capacity, sum(s.volume for s in goods.shapes[:number]) / 0.6)
    )
    assert scene.feed_bucket is not None
    end = (
        scene.feed_bucket.opening_start
        + scene.feed_bucket.opening_time
        + scene.feed_bucket.hold_time
    )
    times = np.linspace(0.0, end + scene.feed_bucket.closing_time, INSTANTS)
    view = {"view": view_walls(read, times, level), "more": False, "span": 0.0}
    return SceneFacts(notes, json.dumps(view), error)


def find_level(capacity: Any, heap: float) -> np.ndarray | None:
    """Two triangles [2, 3, 3] (m): the surface of a heap of a volume (m3) that lies flat in a
    bucket; None: it is over the brim.
    """
    cells = np.argwhere(capacity.is_wet)
    floor = capacity.surface.floor[capacity.is_wet]
    is_known = np.isfinite(floor)
    order = np.argsort(floor[is_known])
    heights, cells = floor[is_known][order], cells[is_known][order]
    area = capacity.surface.cell**2
    below = area * (
        heights * np.arange(1, len(heights) + 1) - np.cumsum(heights)
    )  # volume up to each height
    count = int(np.searchsorted(below, heap))
    if not 0.0 < heap <= capacity.volume:
        return None
    z = (heap / area + heights[:count].sum()) / count
    low = capacity.surface.origin + capacity.surface.cell * cells[:count].min(axis=0)
    high = capacity.surface.origin + capacity.surface.cell * (cells[:count].max(axis=0) + 1)
    corners = np.array(
        [[low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z]]
    )
    return corners[[[0, 1, 2], [0, 2, 3]]]


def describe_run(path: str, member: int | None = None) -> RunFacts:
    """Numbers and curves of a file of results; member: which run of an ensemble, None: the one
    whose peak is the median.

    Raises RecordError and SceneError.
    """
    from dem_jax.visualization.metadata import find_main_block, find_main_group

    whole = _load(path)
    chosen = _choose_member(whole, member)
    run = whole if whole.run_count is None else whole.member(chosen)
    group, block = find_main_group(run), find_main_block(run)
    force = None if group is None else run.pif_kg(group)
    peak = 0.0 if force is None else 1e3 * float(run.time[int(np.argmax(force))])
    return RunFacts(
        name=Path(path).name,
        run_count=whole.run_count or 1,
        numbers=_list_numbers(whole),
        notes=_list_notes(whole),
        force=None if force is None else thin_curve(1e3 * run.time, force),
        settled=None
        if block is None
        else thin_curve(1e3 * run.time, 1e3 * run.settled_mass[block]),
        peak_time=peak,
        member=chosen,
        settings=flatten_tree(tomllib.loads(whole.scene)),
    )


def describe_shares(path: str) -> ShareFacts | None:
    """The shares of chance and of unknown numbers in a run or an ensemble; None: none was drawn.

    Raises RecordError and SceneError.
    """
    from dem_jax.visualization.report_page import SHARES_CAPTION, UNCERTAINTY_TITLE
    from dem_jax.visualization.variance_decomposition import (
        describe_uncertainty,
        draw_variance_shares,
        split_ensemble,
    )
    from dem_jax.visualization.webpage import encode_png

    run = _load(path)
    if not (lines := describe_uncertainty(run)):
        return None
    splits = split_ensemble(run)
    picture = encode_png(draw_variance_shares(splits)) if splits else ""
    return ShareFacts(UNCERTAINTY_TITLE, SHARES_CAPTION, lines, picture)


def remove_empty_results(path: str) -> None:
    """Remove a file of results whose run was ended before it had computed a sample."""
    from dem_jax.io.run_files import load_restart

    with suppress(RecordError):  # it is damaged, which the page says
        if load_restart(path)[2] == 0:
            Path(path).unlink()


def _load(path: str) -> Any:
    """A file of results; the two that were read last are kept until they change."""
    found = Path(path).stat()
    return _load_state(path, (found.st_mtime_ns, found.st_size))


@lru_cache(maxsize=2)
def _load_state(path: str, state: tuple[int, int]) -> Any:
    from dem_jax.io.run_files import load_run

    return load_run(path)


def _choose_member(run: Any, member: int | None) -> int:
    """The number of a run of an ensemble: the one asked for, or the one whose peak is the median."""
    from dem_jax.visualization.metadata import find_main_group

    if run.run_count is None:
        return 0
    if member is not None:
        if not 0 <= member < run.run_count:
            raise RecordError(f"run {member}: allowed: 0 to {run.run_count - 1}")
        return member
    group = find_main_group(run)
    peaks = run.pif_kg(group).max(axis=1) if group else np.zeros(run.run_count)
    return int(np.argsort(peaks, kind="stable")[(run.run_count - 1) // 2])


def _list_numbers(run: Any) -> list[tuple[str, str]]:
    """The numbers of a run with their bands, and the time to weigh."""
    from dem_jax.study.outputs import evaluate_outputs
    from dem_jax.visualization.metadata import find_main_block
    from dem_jax.visualization.metrics import Metric, compute_metrics, format_metric

    found = [(number.name, format_metric(number)) for number in compute_metrics(run)]
    if find_main_block(run) is not None:
        times = evaluate_outputs(run, ["time_to_weigh"])["time_to_weigh"]
        words = format_metric(
            Metric("time to weigh", "ms", times, missing="not within 1 g until the end")
        )
        found.append(("time to weigh (within 1 g)", words))
    return found


def _list_notes(run: Any) -> list[str]:
    """What the numbers depend on, fill levels and the notes of a run."""
    from dem_jax.scene import parse_scene
    from dem_jax.visualization.bucket_heap import describe_heap
    from dem_jax.visualization.metadata import (
        describe_fills,
        describe_peak_band,
        find_main_group,
        summarize_stiffness,
    )

    scene = parse_scene(run.scene, "the file's scene")
    notes = [
        f"peaks are those of {summarize_stiffness(run)}, and of samples of {1e6 * run.sample:.3g} µs"
    ]
    if (group := find_main_group(run)) is not None:
        notes.append(describe_peak_band(run, run.pif_kg(group).max(axis=-1)))
    heap = describe_heap(run) if run.run_count is None else None
    return [*notes, *describe_fills(scene), *filter(None, [heap]), *run.info.get("notes", ())]


def thin_curve(time: np.ndarray, values: np.ndarray) -> Curve:
    """A curve of at most 2 ``MOST_POINTS`` points that keeps the least and the largest value of
    each span.

    Args:
        time: [T].
        values: [T].
    """
    time, values = np.asarray(time, float), np.asarray(values, float)
    if len(time) > 2 * MOST_POINTS:
        edges = np.linspace(0, len(time), MOST_POINTS + 1).astype(int)
        kept = {0, len(time) - 1}
        for start, stop in zip(edges[:-1], edges[1:], strict=True):
            part = values[start:stop]
            kept |= {start + int(part.argmin()), start + int(part.argmax())}
        index = np.array(sorted(kept))
        time, values = time[index], values[index]
    return Curve([round(float(t), 4) for t in time], [float(f"{v:.5g}") for v in values])


def flatten_tree(tree: Any, key: str = "") -> dict[str, str]:
    """Dotted key -> value as text, of a tree of TOML."""
    from dem_jax.scene.messages import shorten_value

    if isinstance(tree, dict):
        found: dict[str, str] = {}
        for name, item in tree.items():
            found |= flatten_tree(item, f"{key}.{name}" if key else name)
        return found
    return {key: shorten_value(tree)}


def compare_runs(paths: list[str]) -> Comparison:
    """By how much files differ from the first, in keys and in numbers, and whether that is beyond
    chance.

    Raises RecordError and SceneError.
    """
    from dem_jax.visualization.comparison import describe_differences

    runs = [_load(path) for path in paths]
    trees = [flatten_tree(tomllib.loads(run.scene)) for run in runs]
    keys = sorted({key for tree in trees for key in tree} - {"name"})
    rows = [(key, [tree.get(key, "not set") for tree in trees]) for key in keys]
    differing = [row for row in rows if len(set(row[1])) > 1]
    return Comparison(differing, describe_differences([Path(path).stem for path in paths], runs))


def write_empty_player(script: str) -> str:
    """The page of the 3-D view, without a view, as HTML text. script: runs behind the player's."""
    from dem_jax.visualization.web_viewer import write_player

    return write_player("3-D view", None, script)


def write_view(path: str, member: int, grows: bool) -> str:
    """The 3-D view of a run as JSON text, for player.js; "" while there are no poses.

    Args:
        path: of the results.
        member: number of the run, of an ensemble.
        grows: whether the run is being computed.

    Raises:
        RecordError: it cannot be read, or has no poses.
        SceneError: its scene cannot be read.
    """
    from dem_jax.scene import parse_scene
    from dem_jax.visualization.web_viewer import build_view_data

    try:
        whole = _load(path)
        run = whole if whole.run_count is None else whole.member(_choose_member(whole, member))
        view = build_view_data(run)
    except (OSError, RecordError):  # of a file without samples
        if not grows:
            raise
        view = None
    if view is None:
        if grows:
            return ""
        raise RecordError(
            f"{Path(path).name}: no poses were stored; allowed: a run with run.frame_interval above 0"
        )
    span = parse_scene(run.scene, path).run.duration if grows else 0.0
    return json.dumps({"view": view, "more": grows, "span": span})


def call_safely(function: Callable[..., Any], *arguments: Any) -> tuple[Any, str]:
    """The result of a function and "", or None and why there is none, in one line."""
    try:
        return function(*arguments), ""
    except (SceneError, RecordError, OSError, ValueError) as error:
        return None, " ".join(str(error).split())
    except MemoryError:
        return None, "there is not enough memory"


def prepare() -> None:
    """Import what the functions need, so that the first call is quick."""
    import dem_jax.study.outputs
    import dem_jax.visualization.summary
    import dem_jax.visualization.web_viewer  # noqa: F401
    from dem_jax.cluster.compile_cache import use_cache

    use_cache()
