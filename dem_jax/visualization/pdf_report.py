"""Reports on paper: sheets of words, tables and figures as one PDF, by matplotlib."""

import io
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem_jax.io.atomic_files import write_atomically
from dem_jax.io.run_data import Run
from dem_jax.visualization.instants import find_impact_instants
from dem_jax.visualization.rendering import Camera, build_render_scene, draw_frames
from dem_jax.visualization.scene_geometry import load_bodies

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TextTable = list[list[str]]  # rows of cells, the first heads the columns
A4 = (8.27, 11.69)  # inches
MARGIN, LINE = 0.07, 0.0165  # of the sheet
WIDE = 105  # characters of a line
DPI = 200


class ReportSheet(NamedTuple):
    """A part of a report: its head, paragraphs and tables, and a figure or the file of a picture."""

    head: str
    words: Sequence[str | TextTable]
    figure: "Figure | Path | None"


def draw_impact_strip(run: Run) -> "Figure | None":
    """The instants of the impact side by side; None: no poses were stored."""
    frames = run.pieces
    if frames is None or not np.isfinite(frames.position).any():
        return None
    scene = build_render_scene(frames, *load_bodies(run), Camera())
    instants = find_impact_instants(run)
    indices = [int(np.argmin(np.abs(frames.time - instant.time))) for instant in instants]
    return draw_frames(scene, indices, labels=[instant.label for instant in instants])


def write_pdf(path: Path, sheets: Sequence[ReportSheet]) -> Path:
    """Write the sheets, one below the other on as many pages as they need. Returns the path. Raises
    RecordError.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    image = io.BytesIO()
    with PdfPages(image) as pdf:
        for page in _lay_out_pages(sheets):
            pdf.savefig(page)
    return write_atomically(path, image.getbuffer())


def _lay_out_pages(sheets: Sequence[ReportSheet]) -> Iterator["Figure"]:
    from matplotlib.figure import Figure

    page, y = Figure(figsize=A4), 1.0 - MARGIN
    for sheet in sheets:
        lines = [line for words in sheet.words for line in [*_wrap_text(words), ("", False)]]
        picture = None if sheet.figure is None else _rasterize_figure(sheet.figure)
        wide, high = (0.0, 0.0) if picture is None else _picture_size(picture)
        if y < 1.0 - MARGIN and y - 3 * LINE - high - min(len(lines), 12) * LINE < MARGIN:
            yield page
            page, y = Figure(figsize=A4), 1.0 - MARGIN
        page.text(MARGIN, y, sheet.head, fontsize=13, weight="bold", va="top")
        y -= 2.2 * LINE
        if picture is not None:
            axes = page.add_axes((MARGIN, y - high, wide, high))
            axes.imshow(picture, interpolation="none")
            axes.set_axis_off()
            y -= high + LINE
        for line, is_head in lines:
            if y < MARGIN:
                yield page
                page, y = Figure(figsize=A4), 1.0 - MARGIN
            page.text(
                MARGIN,
                y,
                line,
                fontsize=7.5,
                family="monospace",
                va="top",
                weight="bold" if is_head else "normal",
            )
            y -= LINE if line else 0.5 * LINE
        y -= LINE
    yield page


def _picture_size(picture: np.ndarray) -> tuple[float, float]:
    """Width and height of a picture, of the sheet: as wide as the text, unless it would be higher
    than a page.
    """
    aspect = A4[0] / A4[1] * picture.shape[0] / picture.shape[1]
    wide = min(1 - 2 * MARGIN, (1 - 2 * MARGIN - 4 * LINE) / aspect)
    return wide, wide * aspect


def _wrap_text(words: str | TextTable) -> list[tuple[str, bool]]:
    """Lines of a paragraph or a table, and whether each is a head."""
    if isinstance(words, str):
        return [(line, False) for line in textwrap.wrap(words, WIDE)]
    if not words:
        return []
    rows = words if any(words[0]) else words[1:]
    first = max(len(row[0]) for row in rows) + 2
    wide = max(20, (WIDE - first) // max(1, len(rows[0]) - 1))
    found = []
    for row in rows:
        cells = [textwrap.wrap(cell, wide - 2) or [""] for cell in row[1:]]
        for k in range(max(map(len, cells), default=1)):
            name = row[0] if k == 0 else ""
            line = name.ljust(first) + "".join(
                (cell[k] if k < len(cell) else "").ljust(wide) for cell in cells
            )
            found.append((line.rstrip(), row is words[0]))
    return found


def _rasterize_figure(figure: "Figure | Path") -> np.ndarray:
    from matplotlib.image import imread

    if isinstance(figure, Path):
        return np.asarray(imread(figure))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    buffer.seek(0)
    return np.asarray(imread(buffer))
