"""One page on a run or on several, to send: numbers, the drop in 3-D, the force, and what was computed.

The page holds all that it shows and loads nothing.
"""

import base64
import io
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.show.compare import compared
from dem_jax.show.facts import facts_of, stiffness_said, weight_of
from dem_jax.show.numbers import averaged_peaks, numbers_of, said
from dem_jax.show.overlay import COLOURS, figure_of_runs
from dem_jax.show.player import three, view_of
from dem_jax.show.plot import check_format, figure_of_run
from dem_jax.show.summary import main_group
from dem_jax.store.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 140
MOST_KINDS = 4  # of pieces that the first line names
SLOWER = (1, 2, 5, 10, 20, 50, 100, 200)  # than in truth: what the player offers


class Named(NamedTuple):
    """A run or an ensemble, and what it is called."""

    name: str
    run: Run


def write_report(names: Sequence[str], runs: Sequence[Run], path: str | Path, group: str | None = None) -> Path:
    """Write the page on runs and ensembles of these names. Returns the path.

    group: wall group of the force; by default wb_flaps, or the first. Raises RecordError for another format than .html, a
    group that a run does not have and a file that cannot be written, and SceneError for a scene that cannot be read.
    """
    path = Path(path)
    check_format(path, (".html",))
    text = page([Named(name, run) for name, run in zip(names, runs, strict=True)], group)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {error.strerror or error}") from error
    return path


def page(named: Sequence[Named], group: str | None = None) -> str:
    """The page as HTML text; arguments and errors as ``write_report``."""
    folder = files("dem_jax.show") / "page"
    views = [(each.name, view_of(_shown(each.run, group), len(named))) for each in named]
    drawn = [{"name": name, "view": view} for name, view in views if view]
    fields = {
        "title": escape(f"Product impact of {', '.join(each.name for each in named)}"),
        "style": (folder / "report.css").read_text(),
        "lead": escape("; ".join(dict.fromkeys(_lead(each.run) for each in named))),
        "numbers": _numbers(named, group),
        "differences": _list("Differences", compared([e.name for e in named], [e.run for e in named], group)),
        "view": _view(drawn, [name for name, view in views if not view], any(e.run.run_count is not None for e in named)),
        "figure": _figure(named, group) if any(each.run.force for each in named) else _note("The runs have no walls."),
        "depends": _depends(named, group),
        "facts": _facts(named),
        "footer": escape(f"Made by dem_jax {named[0].run.version}." + (" 3-D view: three.js, MIT licence." if drawn else "")),
        "views": json.dumps(drawn).replace("<", "\\u003c"),
        "three": three() if drawn else "",
        "script": (folder / "report.js").read_text(),
    }
    return Template((folder / "report.html").read_text()).substitute(fields)


def _shown(run: Run, group: str | None) -> Run:
    """Of an ensemble the run whose peak is the median."""
    if run.run_count is None:
        return run
    group = group or main_group(run)
    peaks = run.pif_kg(group).max(axis=1) if group else np.zeros(run.run_count)
    return run.member(int(np.argsort(peaks, kind="stable")[(run.run_count - 1) // 2]))


def _lead(run: Run) -> str:
    product = facts_of(run)["Product"]
    kinds = [f"{what} ({words})" for what, words in product if " × " in what]
    return ", ".join([*kinds[:MOST_KINDS], *(["..."] if len(kinds) > MOST_KINDS else []), dict(product)["together"]])


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _list(title: str, lines: Sequence[str]) -> str:
    if not lines:
        return ""
    return f"<h2>{title}</h2>\n<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


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
    keys = dict.fromkeys(key for column in columns for key in column)
    return _table(["", *_heads(named)], [[escape(k), *(escape(column.get(k, "")) for column in columns)] for k in keys], caption)


def _numbers(named: Sequence[Named], group: str | None) -> str:
    columns = [{number.name: said(number) for number in numbers_of(each.run, group)} for each in named]
    for column, each in zip(columns, named, strict=True):
        column["weight of the pieces"] = dict(facts_of(each.run)["Product"])["together"]
    words = "Peaks are of means over the sample time. Time to rest: from the first force until the settled mass stays as it is."
    return _columns(named, columns) + _note(" ".join([words, *filter(None, map(_unsettled, named))]))


def _unsettled(each: Named) -> str | None:
    """What to say of a run that ended before all was settled: its time to rest is that of a part."""
    settled = [number.median for number in numbers_of(each.run) if number.name.startswith("settled mass")]
    weight = 1e3 * weight_of(each.run)
    if not settled or settled[0] > 0.99 * weight:
        return None
    return f"When {each.name} ended, {settled[0]:.4g} g of {weight:.4g} g had settled."


def _view(drawn: Sequence[dict[str, Any]], without: Sequence[str], ensembles: bool) -> str:
    """The player; of runs without frames what is missing."""
    words = f"No poses were stored of {', '.join(without)}: set run.frames to the time between them (s) to see the drop."
    missing = _note(words) if without else ""
    if not drawn:
        return missing
    which = " Of an ensemble, the run whose peak is the median." if ensembles else ""
    runs = "".join(f'<option value="{k}">{escape(each["name"])}</option>' for k, each in enumerate(drawn))
    paces = "".join(f'<option value="{n}">{"real time" if n == 1 else f"{n} times slower"}</option>' for n in SLOWER)
    return f"""<div class="view"><canvas id="drop"></canvas><div class="controls">
<button id="play">Play</button><input type="range" id="time" min="0" value="0" step="1" aria-label="instant">
<output id="shown"></output><select id="pace" aria-label="pace">{paces}</select>
<select id="run" aria-label="run"{"" if len(drawn) > 1 else " hidden"}>{runs}</select><button id="again">Reset view</button>
</div></div>{_note(f"Drag to turn, scroll to come nearer.{which}")}{missing}"""


def _figure(named: Sequence[Named], group: str | None) -> str:
    """The figure as PNG, and over each of its panels the line that goes along with the player."""
    with_force = [each for each in named if each.run.force]
    if len(named) == 1:
        figure = figure_of_run(named[0].run, group, title="")
    else:
        figure = figure_of_runs([each.name for each in with_force], [each.run for each in with_force], group)
    picture = _png(figure)
    cursors = []
    for axes in {axes.get_position().bounds: axes for axes in figure.axes}.values():
        (left, bottom, width, height), (start, end) = axes.get_position().bounds, axes.get_xlim()
        span = f'data-start="{1e-3 * start:.6g}" data-end="{1e-3 * end:.6g}"'
        where = f'{span} data-left="{left:.5f}" data-right="{left + width:.5f}"'
        style = f"top:{100 * (1 - bottom - height):.3f}%;height:{100 * height:.3f}%"
        cursors.append(f'<div class="cursor" {where} style="{style}"></div>')
    return (
        f'<div class="figure"><img alt="product impact force and settled mass over time" src="data:image/png;base64,{picture}">'
        f"{''.join(cursors)}</div>"
    )


def _png(figure: "Figure") -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return base64.b64encode(buffer.getvalue()).decode()


def _depends(named: Sequence[Named], group: str | None) -> str:
    """Stiffness in words, and the peak by the time that the force is averaged over."""
    words: dict[str, list[str]] = {}
    for each in named:
        words.setdefault(stiffness_said(each.run), []).append(each.name)
    said_of = {text: "" if len(words) == 1 else f"{', '.join(names)}: " for text, names in words.items()}
    lines = [f"<p>{escape(whose + text)}</p>" for text, whose in said_of.items()]
    groups = [group or main_group(each.run) for each in named]
    peaks = [averaged_peaks(each.run, of) if of else [] for each, of in zip(named, groups, strict=True)]
    columns = [{f"{1e3 * window:.3g} ms": said(peak) for window, peak in rows} for rows in peaks]
    caption = "Peak by the time that the force is averaged over, the first being the sample time."
    return "".join(lines) + _columns(named, columns, caption)


def _facts(named: Sequence[Named]) -> str:
    facts = [facts_of(each.run) for each in named]
    tables = [_columns(named, [dict(of[title]) for of in facts], title) for title in facts[0]]
    return f'<div class="columns">{"".join(tables)}</div>'
