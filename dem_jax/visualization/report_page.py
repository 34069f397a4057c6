"""One page on a run or several, to send: numbers, the drop in 3-D, the force, collisions, a fitted
model, and the inputs.

The page is self-contained and loads nothing. ``pdf_report`` prints the same facts.
"""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.visualization import pdf_report, webpage
from dem_jax.visualization.comparison import describe_differences
from dem_jax.visualization.comparison_figure import COLOURS, draw_comparison_figure
from dem_jax.visualization.fit_file import FitResults
from dem_jax.visualization.metadata import (
    collect_facts,
    describe_peak_band,
    describe_stiffness,
    find_main_block,
    find_main_group,
    portion_weights,
)
from dem_jax.visualization.metrics import compute_metrics, format_metric, peaks_per_window
from dem_jax.visualization.run_figure import check_format, draw_run_figure
from dem_jax.visualization.time_to_rest import find_rest
from dem_jax.visualization.variance_decomposition import (
    describe_uncertainty,
    draw_variance_shares,
    split_ensemble,
)
from dem_jax.visualization.wall_impacts import draw_wall_impacts, tabulate_impacts
from dem_jax.visualization.web_viewer import POLICY, build_view_data, load_three_js, write_controls

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_KINDS = 4  # of pieces that the first line names
SPEEDS_CAPTION = "impact speeds, and where pieces hit"
PEAKS_CAPTION = "Peak by the time that the force is averaged over, the first being the sample time."
UNCERTAINTY_TITLE, SHARES_CAPTION = "Chance and unknown numbers", "shares of the variance"


ReportPart = tuple[str, list[str], "Figure"]  # name of a run, lines and picture


class NamedRun(NamedTuple):
    """A run or an ensemble, and its name."""

    name: str
    run: Run


def write_report(
    names: Sequence[str],
    runs: Sequence[Run],
    path: str | Path,
    group: str | None = None,
    fit: FitResults | None = None,
) -> Path:
    """Write the page on runs and ensembles of these names, or a PDF without the moving view.
    Returns the path.

    group: wall group of the force; by default wb_flaps, or the first. fit: a Product Model fitted
    to them. Raises RecordError for another format than .html and .pdf, a group that a run does not
    have and a file that cannot be written, and SceneError for a scene that cannot be read.
    """
    path = Path(path)
    check_format(path, (".html", ".pdf"))
    named = [NamedRun(name, run) for name, run in zip(names, runs, strict=True)]
    if path.suffix.lower() == ".pdf":
        return pdf_report.write_pdf(path, compose_sheets(named, group, fit))
    return webpage.write_html(path, compose_page(named, group, fit))


def compose_sheets(
    named: Sequence[NamedRun], group: str | None = None, fit: FitResults | None = None
) -> list[pdf_report.ReportSheet]:
    """The sheets of the printed report; arguments and errors as ``write_report``."""
    tables = _metric_tables(named, group)
    with_force = [each for each in named if each.run.force]
    sheets = [
        pdf_report.ReportSheet(
            _report_title(named),
            [_lead_sentence(named), *tables[:1], *_difference_lines(named, group)],
            None,
        )
    ]
    if with_force:
        sheets.append(
            pdf_report.ReportSheet(
                "The force",
                [*_stiffness_lines(named), PEAKS_CAPTION, *tables[1:]],
                _draw_force_figure(named, with_force, group),
            )
        )
    shown = [_choose_median_run(each.run, group) for each in named]
    strips = [
        (each.name, pdf_report.draw_impact_strip(run))
        for each, run in zip(named, shown, strict=True)
    ]
    sheets += [
        pdf_report.ReportSheet(f"The drop: {name}", [], strip)
        for name, strip in strips
        if strip is not None
    ]
    sheets += [
        pdf_report.ReportSheet(f"Collisions: {name}", list(lines), figure)
        for name, lines, figure in _collision_parts(named, group)
    ]
    sheets += [
        pdf_report.ReportSheet(f"{UNCERTAINTY_TITLE}: {name}", list(lines), figure)
        for name, lines, figure in _uncertainty_parts(named, group)
    ]
    if fit is not None:
        sheets.append(
            pdf_report.ReportSheet(
                "The Product Model, fitted", [fit.parameter_rows(), *fit.statements], fit.picture
            )
        )
    facts = [collect_facts(each.run) for each in named]
    return [
        *sheets,
        *(
            pdf_report.ReportSheet(
                name, [_tabulate_columns(named, [dict(of[name]) for of in facts])], None
            )
            for name in facts[0]
        ),
    ]


def compose_page(
    named: Sequence[NamedRun], group: str | None = None, fit: FitResults | None = None
) -> str:
    """The page as HTML text; arguments and errors as ``write_report``."""
    views = [
        (each.name, build_view_data(_choose_median_run(each.run, group), len(named)))
        for each in named
    ]
    drawn = [{"name": name, "view": view} for name, view in views if view]
    fields = {
        "lead": escape(_lead_sentence(named)),
        "numbers": _metrics_html(named, group),
        "differences": _list_html("Differences", _difference_lines(named, group)),
        "view": _view_html(
            drawn,
            [name for name, view in views if not view],
            any(e.run.run_count is not None for e in named),
        ),
        "figure": _figure_html(named, group)
        if any(each.run.force for each in named)
        else _note_html("The runs have no walls."),
        "depends": _stiffness_html(named, group),
        "unknown": _sections_html(
            UNCERTAINTY_TITLE, SHARES_CAPTION, named, _uncertainty_parts(named, group)
        ),
        "collisions": _sections_html(
            "Collisions", SPEEDS_CAPTION, named, _collision_parts(named, group)
        ),
        "model": "" if fit is None else _model_html(fit),
        "facts": _facts_html(named),
        "footer": escape(
            f"Made by dem_jax {named[0].run.version}."
            + (" 3-D view: three.js, MIT licence." if drawn else "")
        ),
        "views": json.dumps(drawn).replace("<", "\\u003c"),
        "three": load_three_js() if drawn else "",
        "script": webpage.read_page_part("report.js"),
    }
    return webpage.fill_page(_report_title(named), POLICY, "report.html", **fields)


def _report_title(named: Sequence[NamedRun]) -> str:
    return f"Product impact of {', '.join(each.name for each in named)}"


def _difference_lines(named: Sequence[NamedRun], group: str | None) -> list[str]:
    return describe_differences([each.name for each in named], [each.run for each in named], group)


def _choose_median_run(run: Run, group: str | None) -> Run:
    """The run of an ensemble whose peak is the median."""
    if run.run_count is None:
        return run
    group = group or find_main_group(run)
    peaks = run.pif_kg(group).max(axis=1) if group else np.zeros(run.run_count)
    return run.member(int(np.argsort(peaks, kind="stable")[(run.run_count - 1) // 2]))


def _lead_sentence(named: Sequence[NamedRun]) -> str:
    return "; ".join(dict.fromkeys(_describe_product(each.run) for each in named))


def _describe_product(run: Run) -> str:
    product = collect_facts(run)["Product"]
    kinds = [f"{what} ({words})" for what, words in product if " × " in what]
    return ", ".join(
        [
            *kinds[:MOST_KINDS],
            *(["..."] if len(kinds) > MOST_KINDS else []),
            dict(product)["together"],
        ]
    )


def _note_html(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _list_html(title: str, lines: Sequence[str]) -> str:
    if not lines:
        return ""
    return (
        (f"<h2>{title}</h2>\n" if title else "")
        + "<ul>"
        + "".join(f"<li>{escape(line)}</li>" for line in lines)
        + "</ul>"
    )


def _table_html(head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table as HTML. Cells are HTML; the first of each row is its head."""
    top = f"<tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>" if any(head) else ""
    lines = [
        f"<tr><th>{row[0]}</th>{''.join(f'<td class=value>{cell}</td>' for cell in row[1:])}</tr>"
        for row in rows
    ]
    return (
        f"<table>{f'<caption>{caption}</caption>' if caption else ''}{top}{''.join(lines)}</table>"
    )


def _head_cells(named: Sequence[NamedRun]) -> list[str]:
    """Names of runs with their colours in the figure; empty for a single run."""
    if len(named) == 1:
        return [""]
    key = '<span class="key" style="background:{}"></span>{}'
    return [
        key.format(COLOURS[k % len(COLOURS)], escape(each.name)) for k, each in enumerate(named)
    ]


def _columns_html(
    named: Sequence[NamedRun], columns: Sequence[Mapping[str, str]], caption: str = ""
) -> str:
    """A table of a row for each key and a column for each run."""
    _, *rows = _tabulate_columns(named, columns)
    return _table_html(
        ["", *_head_cells(named)], [[escape(cell) for cell in row] for row in rows], caption
    )


def _tabulate_columns(
    named: Sequence[NamedRun], columns: Sequence[Mapping[str, str]]
) -> pdf_report.TextTable:
    """Rows of plain text: the heads of the columns, then a row for each key."""
    keys = dict.fromkeys(key for column in columns for key in column)
    heads = ["", *(each.name if len(named) > 1 else "" for each in named)]
    return [heads, *([key, *(column.get(key, "") for column in columns)] for key in keys)]


def _metric_columns(named: Sequence[NamedRun], group: str | None) -> list[dict[str, str]]:
    columns = [
        {number.name: format_metric(number) for number in compute_metrics(each.run, group)}
        for each in named
    ]
    for column, each in zip(columns, named, strict=True):
        if (of := group or find_main_group(each.run)) is not None:
            column["what the peak rests on"] = describe_peak_band(
                each.run, each.run.pif_kg(of).max(axis=-1)
            )
        facts = dict(collect_facts(each.run)["Product"])
        column["weight of the pieces"] = facts.get("in the runs", facts["together"])
    return columns


def _peak_columns(named: Sequence[NamedRun], group: str | None) -> list[dict[str, str]]:
    """Peaks of the force for each averaging time."""
    groups = [group or find_main_group(each.run) for each in named]
    peaks = [
        peaks_per_window(each.run, of) if of else [] for each, of in zip(named, groups, strict=True)
    ]
    return [
        {f"{1e3 * window:.3g} ms": format_metric(peak) for window, peak in rows} for rows in peaks
    ]


def _metric_tables(named: Sequence[NamedRun], group: str | None) -> list[pdf_report.TextTable]:
    return [
        _tabulate_columns(named, columns)
        for columns in (_metric_columns(named, group), _peak_columns(named, group))
    ]


def _metrics_html(named: Sequence[NamedRun], group: str | None) -> str:
    words = "Peaks are maxima of means over the sample time. Time to rest: from the first force until the settled mass is final."
    unsettled = filter(None, map(_describe_unsettled, named))
    return _columns_html(named, _metric_columns(named, group)) + _note_html(
        " ".join([words, *unsettled])
    )


def _describe_unsettled(each: NamedRun) -> str | None:
    """Note on a run that ended before all was settled; None: all was settled."""
    block = find_main_block(each.run)
    if block is None:
        return None
    weights = portion_weights(each.run)
    settled = np.broadcast_to(each.run.settled_mass[block][..., -1], weights.shape)
    grams = (1e3 * float(np.median(masses)) for masses in (settled, weights))
    why = find_rest(each.run, None, block).describe()
    said = (
        ["When {} ended, {:.4g} g of {:.4g} g had settled.".format(each.name, *grams)]
        if np.median(settled / weights) <= 0.99
        else []
    )
    return " ".join([*said, *([f"{each.name}: {why}."] if why else [])]) or None


def _view_html(drawn: Sequence[dict[str, Any]], without: Sequence[str], ensembles: bool) -> str:
    """The player as HTML, with a note on the runs without frames."""
    words = f"No poses were stored of {', '.join(without)}: set run.frame_interval to the time between them (s) to see the drop."
    missing = _note_html(words) if without else ""
    if not drawn:
        return missing
    which = " Of an ensemble, the run whose peak is the median." if ensembles else ""
    controls = write_controls([each["name"] for each in drawn])
    return f"{controls}{_note_html(f'Drag to turn, scroll to come nearer.{which}')}{missing}"


def _draw_force_figure(
    named: Sequence[NamedRun],
    with_force: Sequence[NamedRun],
    group: str | None,
    narrow: bool = False,
) -> "Figure":
    if len(named) == 1:
        return draw_run_figure(named[0].run, group, title="", narrow=narrow)
    return draw_comparison_figure(
        [each.name for each in with_force], [each.run for each in with_force], group, narrow=narrow
    )


def _figure_html(named: Sequence[NamedRun], group: str | None) -> str:
    """The figure for a wide screen, and one with its panels below each other for a narrow one; the
    style shows one of them.
    """
    with_force = [each for each in named if each.run.force]
    return _add_cursors(_draw_force_figure(named, with_force, group), "wide") + _add_cursors(
        _draw_force_figure(named, with_force, group, True), "narrow"
    )


def _add_cursors(figure: "Figure", kind: str) -> str:
    """The figure as PNG, and over each of its panels the line that follows the player."""
    picture = webpage.encode_png(figure)
    cursors = []
    for axes in {axes.get_position().bounds: axes for axes in figure.axes}.values():
        (left, bottom, width, height), (start, end) = axes.get_position().bounds, axes.get_xlim()
        span = f'data-start="{1e-3 * start:.6g}" data-end="{1e-3 * end:.6g}"'
        where = f'{span} data-left="{left:.5f}" data-right="{left + width:.5f}"'
        style = f"top:{100 * (1 - bottom - height):.3f}%;height:{100 * height:.3f}%"
        cursors.append(f'<div class="cursor" {where} style="{style}"></div>')
    return (
        f'<div class="figure {kind}"><img alt="product impact force and settled mass over time" '
        f'src="data:image/png;base64,{picture}">'
        f"{''.join(cursors)}</div>"
    )


def _stiffness_html(named: Sequence[NamedRun], group: str | None) -> str:
    """The stiffness in words, and the peaks of the force for each averaging time, as HTML."""
    lines = [f"<p>{escape(line)}</p>" for line in _stiffness_lines(named)]
    return "".join(lines) + _columns_html(named, _peak_columns(named, group), PEAKS_CAPTION)


def _stiffness_lines(named: Sequence[NamedRun]) -> list[str]:
    words: dict[str, list[str]] = {}
    for each in named:
        words.setdefault(describe_stiffness(each.run), []).append(each.name)
    return [
        ("" if len(words) == 1 else f"{', '.join(names)}: ") + text for text, names in words.items()
    ]


def _collision_parts(named: Sequence[NamedRun], group: str | None) -> Iterator[ReportPart]:
    """Name, lines and figure for each run with statistics of collisions."""
    for each in named:
        if "collisions" in each.run.info:
            yield each.name, tabulate_impacts(each.run), draw_wall_impacts(each.run, group)


def _uncertainty_parts(named: Sequence[NamedRun], group: str | None) -> Iterator[ReportPart]:
    """Name, shares of the scatter in words, and figure for each ensemble with drawn numbers."""
    for each in named:
        if splits := split_ensemble(each.run, group):
            yield each.name, describe_uncertainty(each.run, group), draw_variance_shares(splits)


def _sections_html(
    title: str, picture: str, named: Sequence[NamedRun], parts: Iterator[ReportPart]
) -> str:
    """A section for each part, with its name if there are several runs. picture: description of the
    figure.
    """
    found = []
    for name, lines, figure in parts:
        head = f"<h2>{title}{escape(f': {name}' if len(named) > 1 else '')}</h2>"
        found.append(
            f"{head}\n{webpage.image_html(picture, webpage.encode_png(figure))}{_list_html('', lines)}"
        )
    return "".join(found)


def _model_html(fit: FitResults) -> str:
    """The parameters of a fitted Product Model with their intervals, the statements of the fit, and
    its figure.
    """
    head, *rows = fit.parameter_rows()
    picture = ""
    if fit.picture is not None:
        picture = webpage.image_html(
            "traces and the fitted model", base64.b64encode(fit.picture.read_bytes()).decode()
        )
    cells = _table_html(head, [[escape(cell) for cell in row] for row in rows])
    return f"<h2>The Product Model, fitted</h2>\n{cells}{_list_html('', fit.statements)}{picture}"


def _facts_html(named: Sequence[NamedRun]) -> str:
    facts = [collect_facts(each.run) for each in named]
    tables = [_columns_html(named, [dict(of[title]) for of in facts], title) for title in facts[0]]
    return f'<div class="columns">{"".join(tables)}</div>'
