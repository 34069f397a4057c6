"""The report of a product on one page, as self-contained HTML, and as PDF."""

import base64
import io
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from calibrate.curves import Curves
from calibrate.judgement import Comparison, Judgement, number
from calibrate.models import FittedModel, ParameterRow
from calibrate.product_figures import CAPTIONS, DRAWN

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

DPI = 130
A4 = (8.27, 11.69)  # inches
WIDE, SMALL = 132, 6.6  # of the text of the PDF: characters of a line, points
LINE = 0.118  # inches, of a line of it
PARAMETER_HEAD = ["parameter", "", "value", "90 % interval"]
COMPARED_HEAD = ["", "drops: median (5 to 95 %)", "model: median (5 to 95 %)", "difference"]
STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.45 system-ui, sans-serif; color: #222; background: #fff; max-width: 64rem;
  margin: 1.5rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; }
h2 { font-size: 1.1rem; margin: 1.4rem 0 .4rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }
.lead, figcaption, footer { color: #555; }
.lead { margin-top: 0; }
.verdict { font-weight: 600; padding: .5rem .8rem; border-left: 5px solid #2e7d32; background: #f1f8f1; }
.verdict.rejected { border-color: #c0392b; background: #fdf3f2; }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; padding: .22rem .9rem .22rem 0; border-bottom: 1px solid #eee; }
td.value { font-variant-numeric: tabular-nums; white-space: nowrap; }
th { font-weight: 600; }
.differs { color: #c0392b; font-weight: 600; }
.scrolled { overflow-x: auto; }
figure { margin: .8rem 0 1.2rem; }
figure img { width: 100%; display: block; }
footer { margin-top: 1.5rem; font-size: .85rem; }
@media (max-width: 45rem) {
  body { margin: 1rem auto; padding: 0 1rem; overflow-wrap: break-word; }
  figure .scrolled img { width: auto; min-width: 40rem; max-width: none; }
}
@media print { h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""


@dataclass(frozen=True)
class Report:
    """Content of a report.

    product: its name; lead: a line on the drops; facts: name -> words, on the simulation.
    """

    product: str
    lead: str
    facts: Mapping[str, str]
    fitted: FittedModel
    judgement: Judgement
    data: Curves
    model: Curves

    @property
    def title(self) -> str:
        """The head of the page."""
        return f"Product Model of {self.product}"


def parameter_cells(row: ParameterRow) -> list[str]:
    """Cells below PARAMETER_HEAD."""
    found = f"{number(row.low)} to {number(row.high)} {row.unit}"
    interval = found if row.high > row.low else "not found" if row.free else "kept"
    return [row.symbol, row.words, f"{number(row.value)} {row.unit}", interval]


def compared_cells(row: Comparison, differs: bool) -> list[str]:
    """Cells below COMPARED_HEAD."""
    shown = [
        f"{number(q[1])} ({number(q[0])} to {number(q[2])}) {row.unit}"
        for q in (row.data, row.model)
    ]
    return [row.words, *shown, f"{100 * row.change:+.0f} %" if differs else "within chance"]


def html_page(report: Report, figures: Mapping[str, "Figure"]) -> str:
    """The report as HTML text."""
    found = report.judgement
    kind = "verdict rejected" if report.fitted.is_rejected else "verdict"
    body = [
        f"<h1>{escape(report.title)}</h1>",
        f'<p class="lead">{escape(report.lead)}</p>',
        f'<p class="{kind}">{escape(found.verdict)}</p>',
        _list(found.reasons),
        "<h2>What to do next</h2>",
        _list(found.advice),
        f"<h2>Parameters: {escape(report.fitted.title)}</h2>",
        _table(PARAMETER_HEAD, [parameter_cells(row) for row in report.fitted.rows]),
        "<h2>Drops and model in numbers</h2>",
        _table(
            COMPARED_HEAD,
            [compared_cells(row, row in found.differing) for row in found.comparisons],
        ),
        "<h2>Drops and model over time</h2>",
        *(_figure(CAPTIONS[name], figure) for name, figure in figures.items()),
        "<h2>The drops</h2>",
        _table(None, [[name, words] for name, words in report.facts.items()]),
        f"<footer>Bands hold 5 to 95 % of {len(report.data.force)} drops and of {len(report.model.force)} portions of the model."
        " Intervals are those of refits to portions of the model: they hold only within it.</footer>",
    ]
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    head = [
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(report.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>",
    ]
    return "\n".join([*head, *body, "</body>\n</html>\n"])


def _list(lines: Sequence[str]) -> str:
    items = (re.sub(r"`(.+?)`", r"<code>\1</code>", escape(line)) for line in lines)
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>" if lines else ""


def _table(head: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> str:
    top = f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>" if head else ""
    return f'<div class="scrolled"><table>{top}{"".join(map(_row, rows))}</table></div>'


def _row(cells: Sequence[str]) -> str:
    first, *others = cells
    marked = ' class="differs"' if cells[-1][:1] in "+-" else ""
    tags = [
        f"<td{marked if k == len(others) - 1 else ''}>{escape(cell)}</td>"
        for k, cell in enumerate(others)
    ]
    return f"<tr><th>{escape(first)}</th>{''.join(tags)}</tr>"


def _figure(caption: str, figure: "Figure") -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    coded = base64.b64encode(buffer.getvalue()).decode()
    image = f'<img alt="{escape(caption)}" src="data:image/png;base64,{coded}">'
    return f'<figure><figcaption>{escape(caption)}</figcaption><div class="scrolled">{image}</div></figure>'


def pdf_page(report: Report) -> "Figure":
    """The report on one sheet of A4."""
    from matplotlib.figure import Figure

    lines = list(_lines(report))
    page = Figure(figsize=A4)
    high = LINE * (len(lines) + 1) + 0.75
    heights = [high, *[(A4[1] - high) / len(DRAWN)] * len(DRAWN)]
    words, *drawn = np.asarray(page.subfigures(len(heights), 1, height_ratios=heights)).tolist()
    _write_words(words, report, lines, high)
    for figure, draw in zip(drawn, DRAWN.values(), strict=True):
        draw(figure, report.data, report.model)
        figure.subplots_adjust(left=0.11, right=0.96, top=0.88, bottom=0.2, wspace=0.24)
    return page


def _write_words(
    part: "SubFigure", report: Report, lines: Sequence[tuple[str, bool]], high: float
) -> None:
    part.text(0.06, 1.0 - 0.35 / high, report.title, fontsize=13, weight="bold", va="top")
    y = 1.0 - 0.68 / high
    for line, is_head in lines:
        weight = "bold" if is_head else "normal"
        part.text(0.06, y, line, fontsize=SMALL, family="monospace", va="top", weight=weight)
        y -= LINE / high


def _lines(report: Report) -> Iterator[tuple[str, bool]]:
    """Lines of the PDF, and whether each is a head."""
    found = report.judgement
    yield from _wrapped(report.lead)
    yield from _wrapped(found.verdict, True)
    for line in found.reasons:
        yield from _wrapped(f"- {line}")
    yield "What to do next", True
    for line in found.advice:
        yield from _wrapped(f"- {line}")
    yield f"Parameters: {report.fitted.title}", True
    yield from _columns([parameter_cells(row) for row in report.fitted.rows])
    yield "Drops and model in numbers: medians (5 to 95 %) of drops and of model", True
    yield from _columns([compared_cells(row, row in found.differing) for row in found.comparisons])
    for name, words in report.facts.items():
        yield from _wrapped(f"{name}: {words}")


def _wrapped(text: str, is_head: bool = False) -> Iterator[tuple[str, bool]]:
    yield from (
        (line, is_head)
        for line in textwrap.wrap(
            text, WIDE, subsequent_indent="  " if text.startswith("- ") else ""
        )
    )


def _columns(rows: Sequence[Sequence[str]]) -> Iterator[tuple[str, bool]]:
    wide = [max(len(row[k]) for row in rows) + 2 for k in range(len(rows[0]))]
    for row in rows:
        yield "".join(cell.ljust(w) for cell, w in zip(row, wide, strict=True)).rstrip(), False
