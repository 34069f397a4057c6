"""A study as one page to send: its results as text and numbers, its figure, and the study itself."""

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax.study import analysis, results_file
from dem_jax.study.study_figure import draw_study_figure
from dem_jax.study.uncertain_parameters import split_outputs
from dem_jax.visualization import pdf_report, webpage
from dem_jax.visualization.run_figure import check_format
from dem_jax.visualization.variance_decomposition import draw_variance_shares

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICY = "style-src 'unsafe-inline'; img-src data:"


def write_study_page(source: str | Path, path: str | Path) -> Path:
    """Write the page on a study's file as .html or .pdf. Returns the path. Raises RecordError."""
    path, found = Path(path), results_file.load_results(source)
    check_format(path, (".html", ".pdf"))
    head, rows = analysis.tabulate_points(found)
    title, words, splits = found.study.title, analysis.list_findings(found), split_outputs(found)
    shares = draw_variance_shares(splits) if splits else None
    if path.suffix.lower() == ".pdf":
        sheet = [
            pdf_report.ReportSheet(title, words, shares or draw_study_figure(found)),
            pdf_report.ReportSheet("The points", [[head, *rows]], None),
        ]
        return pdf_report.write_pdf(
            path,
            [*sheet, pdf_report.ReportSheet("The study", found.study.to_toml().splitlines(), None)],
        )
    cells = "".join(
        f"<tr>{''.join(f'<td class=value>{escape(cell)}</td>' for cell in row)}</tr>"
        for row in rows
    )
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    fields = {
        "words": "".join(f"<li>{escape(line)}</li>" for line in words),
        "picture": _picture_html("shares of the variance", shares)
        + _picture_html("outputs over parameters", draw_study_figure(found)),
        "table": f"<table><tr>{heads}</tr>{cells}</table>",
        "study": escape(found.study.to_toml()),
    }
    return webpage.write_html(path, webpage.fill_page(title, POLICY, "study.html", **fields))


def _picture_html(words: str, figure: "Figure | None") -> str:
    return "" if figure is None else webpage.image_html(words, webpage.encode_png(figure))
