"""A study as one page to send: its results as text and numbers, its figure, and the study itself."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax.show import paper, webpage
from dem_jax.show.plot import check_format
from dem_jax.show.uncertainty import figure_of_splits
from dem_jax.study import file, results
from dem_jax.study.figure import figure_of
from dem_jax.study.uncertain import split_outputs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICY = "style-src 'unsafe-inline'; img-src data:"


def write_page(source: str | Path, path: str | Path) -> Path:
    """Write the page on a study's file as .html or .pdf. Returns the path. Raises RecordError."""
    path, found = Path(path), file.load(source)
    check_format(path, (".html", ".pdf"))
    head, rows = results.table(found)
    title, words, splits = found.study.title, results.findings(found), split_outputs(found)
    shares = figure_of_splits(splits) if splits else None
    if path.suffix.lower() == ".pdf":
        sheet = [paper.Sheet(title, words, shares or figure_of(found)), paper.Sheet("The points", [[head, *rows]], None)]
        return paper.write(path, [*sheet, paper.Sheet("The study", found.study.text().splitlines(), None)])
    cells = "".join(f"<tr>{''.join(f'<td class=value>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    fields = {
        "words": "".join(f"<li>{escape(line)}</li>" for line in words),
        "picture": _picture("shares of the variance", shares) + _picture("outputs over parameters", figure_of(found)),
        "table": f"<table><tr>{heads}</tr>{cells}</table>",
        "study": escape(found.study.text()),
    }
    return webpage.write(path, webpage.page(title, POLICY, "study.html", **fields))


def _picture(words: str, figure: "Figure | None") -> str:
    return "" if figure is None else webpage.image(words, webpage.png(figure))
