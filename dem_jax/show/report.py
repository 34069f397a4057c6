"""One page on a run or on several, to send: numbers, the drop in 3-D, the force, collisions, a fitted model, and what was computed.

The page holds all that it shows and loads nothing. ``paper`` prints the same facts.
"""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.show import paper, webpage
from dem_jax.show.at_rest import find_rest
from dem_jax.show.collisions import figure_of_collisions, table
from dem_jax.show.compare import compared
from dem_jax.show.facts import facts_of, main_block, main_group, peak_band_said, stiffness_said, weight_of
from dem_jax.show.fitted import Fitted
from dem_jax.show.numbers import averaged_peaks, numbers_of, said
from dem_jax.show.overlay import COLOURS, figure_of_runs
from dem_jax.show.player import POLICY, three, view_of, write_controls
from dem_jax.show.plot import check_format, figure_of_run
from dem_jax.show.uncertainty import describe_splits, figure_of_splits, split_ensemble
from dem_jax.store.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_KINDS = 4  # of pieces that the first line names
SPEEDS = "impact speeds, and where pieces hit"
PEAKS = "Peak by the time that the force is averaged over, the first being the sample time."
UNKNOWN, SHARES = "Chance and unknown numbers", "shares of the variance"


Part = tuple[str, list[str], "Figure"]  # name of a run, lines and picture


class Named(NamedTuple):
    """A run or an ensemble, and what it is called."""

    name: str
    run: Run


def write_report(
    names: Sequence[str], runs: Sequence[Run], path: str | Path, group: str | None = None, fit: Fitted | None = None
) -> Path:
    """Write the page on runs and ensembles of these names, or as PDF the same without what moves. Returns the path.

    group: wall group of the force; by default wb_flaps, or the first. fit: a Product Model fitted to them. Raises RecordError
    for another format than .html and .pdf, a group that a run does not have and a file that cannot be written, and SceneError for
    a scene that cannot be read.
    """
    path = Path(path)
    check_format(path, (".html", ".pdf"))
    named = [Named(name, run) for name, run in zip(names, runs, strict=True)]
    if path.suffix.lower() == ".pdf":
        return paper.write(path, content(named, group, fit))
    return webpage.write(path, page(named, group, fit))


def content(named: Sequence[Named], group: str | None = None, fit: Fitted | None = None) -> list[paper.Sheet]:
    """What is printed; arguments and errors as ``write_report``."""
    tables = _tables(named, group)
    with_force = [each for each in named if each.run.force]
    sheets = [paper.Sheet(_title(named), [_lead_of(named), *tables[:1], *_compared(named, group)], None)]
    if with_force:
        sheets.append(paper.Sheet("The force", [*_stiffness(named), PEAKS, *tables[1:]], _drawn(named, with_force, group)))
    shown = [_shown(each.run, group) for each in named]
    strips = [(each.name, paper.strip_of(run)) for each, run in zip(named, shown, strict=True)]
    sheets += [paper.Sheet(f"The drop: {name}", [], strip) for name, strip in strips if strip is not None]
    sheets += [paper.Sheet(f"Collisions: {name}", list(lines), figure) for name, lines, figure in _collisions_of(named, group)]
    sheets += [paper.Sheet(f"{UNKNOWN}: {name}", list(lines), figure) for name, lines, figure in _unknown_of(named, group)]
    if fit is not None:
        sheets.append(paper.Sheet("The Product Model, fitted", [fit.rows(), *fit.statements], fit.picture))
    facts = [facts_of(each.run) for each in named]
    return [*sheets, *(paper.Sheet(name, [_side_by_side(named, [dict(of[name]) for of in facts])], None) for name in facts[0])]


def page(named: Sequence[Named], group: str | None = None, fit: Fitted | None = None) -> str:
    """The page as HTML text; arguments and errors as ``write_report``."""
    views = [(each.name, view_of(_shown(each.run, group), len(named))) for each in named]
    drawn = [{"name": name, "view": view} for name, view in views if view]
    fields = {
        "lead": escape(_lead_of(named)),
        "numbers": _numbers(named, group),
        "differences": _list("Differences", _compared(named, group)),
        "view": _view(drawn, [name for name, view in views if not view], any(e.run.run_count is not None for e in named)),
        "figure": _figure(named, group) if any(each.run.force for each in named) else _note("The runs have no walls."),
        "depends": _depends(named, group),
        "unknown": _write_sections(UNKNOWN, SHARES, named, _unknown_of(named, group)),
        "collisions": _write_sections("Collisions", SPEEDS, named, _collisions_of(named, group)),
        "model": "" if fit is None else _model(fit),
        "facts": _facts(named),
        "footer": escape(f"Made by dem_jax {named[0].run.version}." + (" 3-D view: three.js, MIT licence." if drawn else "")),
        "views": json.dumps(drawn).replace("<", "\\u003c"),
        "three": three() if drawn else "",
        "script": webpage.part("report.js"),
    }
    return webpage.page(_title(named), POLICY, "report.html", **fields)


def _title(named: Sequence[Named]) -> str:
    return f"Product impact of {', '.join(each.name for each in named)}"


def _compared(named: Sequence[Named], group: str | None) -> list[str]:
    return compared([each.name for each in named], [each.run for each in named], group)


def _shown(run: Run, group: str | None) -> Run:
    """Of an ensemble the run whose peak is the median."""
    if run.run_count is None:
        return run
    group = group or main_group(run)
    peaks = run.pif_kg(group).max(axis=1) if group else np.zeros(run.run_count)
    return run.member(int(np.argsort(peaks, kind="stable")[(run.run_count - 1) // 2]))


def _lead_of(named: Sequence[Named]) -> str:
    return "; ".join(dict.fromkeys(_lead(each.run) for each in named))


def _lead(run: Run) -> str:
    product = facts_of(run)["Product"]
    kinds = [f"{what} ({words})" for what, words in product if " × " in what]
    return ", ".join([*kinds[:MOST_KINDS], *(["..."] if len(kinds) > MOST_KINDS else []), dict(product)["together"]])


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _list(title: str, lines: Sequence[str]) -> str:
    if not lines:
        return ""
    return (f"<h2>{title}</h2>\n" if title else "") + "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """Cells are HTML; the first of each row heads it."""
    top = f"<tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>" if any(head) else ""
    lines = [f"<tr><th>{row[0]}</th>{''.join(f'<td class=value>{cell}</td>' for cell in row[1:])}</tr>" for row in rows]
    return f"<table>{f'<caption>{caption}</caption>' if caption else ''}{top}{''.join(lines)}</table>"


def _heads(named: Sequence[Named]) -> list[str]:
    """Names of runs with their colours in the figure; of a single run nothing."""
    if len(named) == 1:
        return [""]
    key = '<span class="key" style="background:{}"></span>{}'
    return [key.format(COLOURS[k % len(COLOURS)], escape(each.name)) for k, each in enumerate(named)]


def _columns(named: Sequence[Named], columns: Sequence[Mapping[str, str]], caption: str = "") -> str:
    """A table of a row for each key and a column for each run."""
    _, *rows = _side_by_side(named, columns)
    return _table(["", *_heads(named)], [[escape(cell) for cell in row] for row in rows], caption)


def _side_by_side(named: Sequence[Named], columns: Sequence[Mapping[str, str]]) -> paper.Table:
    """Rows of plain text: what heads the columns, then a row for each key."""
    keys = dict.fromkeys(key for column in columns for key in column)
    heads = ["", *(each.name if len(named) > 1 else "" for each in named)]
    return [heads, *([key, *(column.get(key, "") for column in columns)] for key in keys)]


def _numbers_said(named: Sequence[Named], group: str | None) -> list[dict[str, str]]:
    columns = [{number.name: said(number) for number in numbers_of(each.run, group)} for each in named]
    for column, each in zip(columns, named, strict=True):
        if (of := group or main_group(each.run)) is not None:
            column["what the peak rests on"] = peak_band_said(each.run, each.run.pif_kg(of).max(axis=-1))
        column["weight of the pieces"] = dict(facts_of(each.run)["Product"])["together"]
    return columns


def _peaks_said(named: Sequence[Named], group: str | None) -> list[dict[str, str]]:
    """The peak by the time that the force is averaged over."""
    groups = [group or main_group(each.run) for each in named]
    peaks = [averaged_peaks(each.run, of) if of else [] for each, of in zip(named, groups, strict=True)]
    return [{f"{1e3 * window:.3g} ms": said(peak) for window, peak in rows} for rows in peaks]


def _tables(named: Sequence[Named], group: str | None) -> list[paper.Table]:
    return [_side_by_side(named, columns) for columns in (_numbers_said(named, group), _peaks_said(named, group))]


def _numbers(named: Sequence[Named], group: str | None) -> str:
    words = "Peaks are maxima of means over the sample time. Time to rest: from the first force until the settled mass is final."
    unsettled = filter(None, map(_unsettled, named))
    return _columns(named, _numbers_said(named, group)) + _note(" ".join([words, *unsettled]))


def _unsettled(each: Named) -> str | None:
    """What to say of a run that ended before all was settled."""
    block = main_block(each.run)
    if block is None:
        return None
    settled, weight = 1e3 * float(np.median(each.run.settled_mass[block][..., -1])), 1e3 * weight_of(each.run)
    why = find_rest(each.run, None, block).describe()
    said = [f"When {each.name} ended, {settled:.4g} g of {weight:.4g} g had settled."] if settled <= 0.99 * weight else []
    return " ".join([*said, *([f"{each.name}: {why}."] if why else [])]) or None


def _view(drawn: Sequence[dict[str, Any]], without: Sequence[str], ensembles: bool) -> str:
    """The player; of runs without frames what is missing."""
    words = f"No poses were stored of {', '.join(without)}: set run.frames to the time between them (s) to see the drop."
    missing = _note(words) if without else ""
    if not drawn:
        return missing
    which = " Of an ensemble, the run whose peak is the median." if ensembles else ""
    controls = write_controls([each["name"] for each in drawn])
    return f"{controls}{_note(f'Drag to turn, scroll to come nearer.{which}')}{missing}"


def _drawn(named: Sequence[Named], with_force: Sequence[Named], group: str | None, narrow: bool = False) -> "Figure":
    if len(named) == 1:
        return figure_of_run(named[0].run, group, title="", narrow=narrow)
    return figure_of_runs([each.name for each in with_force], [each.run for each in with_force], group, narrow=narrow)


def _figure(named: Sequence[Named], group: str | None) -> str:
    """The figure for a wide screen, and one with its panels below each other for a narrow one; the style shows one of them."""
    with_force = [each for each in named if each.run.force]
    return _with_cursors(_drawn(named, with_force, group), "wide") + _with_cursors(_drawn(named, with_force, group, True), "narrow")


def _with_cursors(figure: "Figure", kind: str) -> str:
    """The figure as PNG, and over each of its panels the line that follows the player."""
    picture = webpage.png(figure)
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


def _depends(named: Sequence[Named], group: str | None) -> str:
    """Stiffness in words, and the peak by the time that the force is averaged over."""
    lines = [f"<p>{escape(line)}</p>" for line in _stiffness(named)]
    return "".join(lines) + _columns(named, _peaks_said(named, group), PEAKS)


def _stiffness(named: Sequence[Named]) -> list[str]:
    words: dict[str, list[str]] = {}
    for each in named:
        words.setdefault(stiffness_said(each.run), []).append(each.name)
    return [("" if len(words) == 1 else f"{', '.join(names)}: ") + text for text, names in words.items()]


def _collisions_of(named: Sequence[Named], group: str | None) -> Iterator[Part]:
    """Of each run with statistics of collisions its name, what there is to say, and the figure."""
    for each in named:
        if "collisions" in each.run.info:
            yield each.name, table(each.run), figure_of_collisions(each.run, group)


def _unknown_of(named: Sequence[Named], group: str | None) -> Iterator[Part]:
    """Of each ensemble with drawn numbers its name, their shares of the scatter in words, and the picture."""
    for each in named:
        if splits := split_ensemble(each.run, group):
            yield each.name, describe_splits(splits), figure_of_splits(splits)


def _write_sections(title: str, picture: str, named: Sequence[Named], parts: Iterator[Part]) -> str:
    """A section for each part, with its name if there are several runs; picture: what it shows, in words."""
    found = []
    for name, lines, figure in parts:
        head = f"<h2>{title}{escape(f': {name}' if len(named) > 1 else '')}</h2>"
        found.append(f"{head}\n{webpage.image(picture, webpage.png(figure))}{_list('', lines)}")
    return "".join(found)


def _model(fit: Fitted) -> str:
    """The parameters of a fitted Product Model with their intervals, what the fit says, and its picture."""
    head, *rows = fit.rows()
    picture = ""
    if fit.picture is not None:
        picture = webpage.image("traces and the fitted model", base64.b64encode(fit.picture.read_bytes()).decode())
    cells = _table(head, [[escape(cell) for cell in row] for row in rows])
    return f"<h2>The Product Model, fitted</h2>\n{cells}{_list('', fit.statements)}{picture}"


def _facts(named: Sequence[Named]) -> str:
    facts = [facts_of(each.run) for each in named]
    tables = [_columns(named, [dict(of[title]) for of in facts], title) for title in facts[0]]
    return f'<div class="columns">{"".join(tables)}</div>'
