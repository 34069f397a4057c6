"""A study as one page to send: what it found in words and numbers, its figure, and the study itself."""

import base64
import io
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from dem_jax.errors import RecordError
from dem_jax.show import paper
from dem_jax.show.plot import check_format
from dem_jax.study import file, results
from dem_jax.study.figure import figure_of

DPI = 140


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
    buffer = io.BytesIO()
    figure_of(found).savefig(buffer, format="png", dpi=DPI)
    folder = files("dem_jax.show") / "page"
    fields = {
        "title": escape(title),
        "style": (folder / "report.css").read_text(),
        "words": "".join(f"<li>{escape(line)}</li>" for line in words),
        "picture": base64.b64encode(buffer.getvalue()).decode(),
        "table": f"<table><tr>{heads}</tr>{cells}</table>",
        "study": escape(found.study.text()),
    }
    try:
        path.write_text(Template((folder / "study.html").read_text()).substitute(fields), encoding="utf-8")
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {error.strerror or error}") from error
    return path

