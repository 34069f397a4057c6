"""Pages that hold all that they show and load nothing: what is around their body, and pictures in them."""

import base64
import io
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from dem_jax.store.output import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 140


def part(name: str) -> str:
    """The text of a file of ``show/page``."""
    return (files("dem_jax.show") / "page" / name).read_text(encoding="utf-8")


def page(title: str, policy: str, body: str, **fields: str) -> str:
    """The page as HTML text. policy: what it may have in it; body: a file of ``show/page``, filled in with the fields."""
    filled = Template(part(body)).substitute(fields, title=escape(title))
    return Template(part("page.html")).substitute(title=escape(title), policy=policy, style=part("report.css"), body=filled)


def write(path: Path, text: str) -> Path:
    """Write the page. Returns the path. Raises RecordError."""
    return write_whole(path, text.encode())


def png(figure: "Figure") -> str:
    """A figure as PNG in base64."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return base64.b64encode(buffer.getvalue()).decode()


def image(words: str, coded: str) -> str:
    """A picture, PNG in base64; words: for those who do not see it."""
    return f'<div class="figure scrolled"><img alt="{words}" src="data:image/png;base64,{coded}"></div>'
