"""Hook of mkdocs: notebooks become pages, with the outputs that they were committed with.

mkdocs-jupyter is not used because its pages draw formulas by a script that they load from
elsewhere.
"""

import posixpath
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parent.parent


class NotebookPage(File):
    """A page whose source is called .ipynb, so that links to the notebook lead to it."""

    def is_documentation_page(self) -> bool:
        """True: mkdocs renders its content."""
        return True


def on_files(files: Files, config: Any) -> Files:
    """Add a page for each notebook, and its pictures."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        resources = {"output_files_dir": f"{path.stem}_files", "unique_key": path.stem}
        text, found = MarkdownExporter().from_filename(str(path), resources=resources)
        files.remove(files.src_uris[f"notebooks/{path.name}"])
        files.append(NotebookPage.generated(config, f"notebooks/{path.name}", content=text))
        for picture, content in found["outputs"].items():
            files.append(
                File.generated(config, posixpath.join("notebooks", picture), content=content)
            )
    return files
