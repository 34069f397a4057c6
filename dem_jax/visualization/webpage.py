"""Self-contained pages that load nothing: the frame around their body, and pictures in them."""

import base64
import io
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from dem_jax.io.atomic_files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 140


def read_page_part(name: str) -> str:
    """The text of a file of ``visualization/page``."""
    return (files("dem_jax.visualization") / "page" / name).read_text(encoding="utf-8")


def fill_page(title: str, policy: str, body: str, **fields: str) -> str:
    """The page as HTML text.

    policy: content security policy of the page. body: a file of ``visualization/page``, filled in
    with the fields.
    """
    filled = Template(read_page_part(body)).substitute(fields, title=escape(title))
    return Template(read_page_part("page.html")).substitute(
        title=escape(title), policy=policy, style=read_page_part("report.css"), body=filled
    )


def write_html(path: Path, text: str) -> Path:
    """Write the page. Returns the path. Raises RecordError."""
    return write_atomically(path, text.encode())


def encode_png(figure: "Figure") -> str:
    """A figure as PNG in base64."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return base64.b64encode(buffer.getvalue()).decode()


def image_html(words: str, coded: str) -> str:
    """The HTML of a picture. coded: PNG in base64; words: its alternative text."""
    return f'<div class="figure scrolled"><img alt="{words}" src="data:image/png;base64,{coded}"></div>'
