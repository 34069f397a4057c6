"""A study as one page to send: its results as text and numbers, its figure, and the study itself."""

from html import escape
from pathlib import Path

from dem_jax.show import paper, webpage
from dem_jax.show.plot import check_format
from dem_jax.study import file, results
from dem_jax.study.figure import figure_of

POLICY = "style-src 'unsafe-inline'; img-src data:"


def write_page(source: str | Path, path: str | Path) -> Path:
    """Write the page on a study's file as .html or .pdf. Returns the path. Raises RecordError."""
    path, found = Path(path), file.load(source)
    check_format(path, (".html", ".pdf"))
    head, rows = results.table(found)
    title, words = found.study.title, results.findings(found)
    if path.suffix.lower() == ".pdf":
        sheet = [paper.Sheet(title, words, figure_of(found)), paper.Sheet("The points", [[head, *rows]], None)]
        return paper.write(path, [*sheet, paper.Sheet("The study", found.study.text().splitlines(), None)])
    cells = "".join(f"<tr>{''.join(f'<td class=value>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    fields = {
        "words": "".join(f"<li>{escape(line)}</li>" for line in words),
        "picture": webpage.image("outputs over parameters", webpage.png(figure_of(found))),
        "table": f"<table><tr>{heads}</tr>{cells}</table>",
        "study": escape(found.study.text()),
    }
    return webpage.write(path, webpage.page(title, POLICY, "study.html", **fields))

