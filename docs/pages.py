"""What the site (mkdocs.yml) takes from elsewhere in the repository, so that each text has one home.

In a page, a line ``<!-- include: README.md#Studies -->`` stands for that section of another file, one like
``<!-- prints: dem_jax products -->`` for what a command prints, ``<!-- lists: benchmarks/results -->`` for links to the pages of
a folder, and ``<!-- api: product_model -->`` for the docstrings of what a package offers. Notebooks become pages with the outputs
that they are committed with, and TeX becomes MathML. Links are those of the repository.
"""

import contextlib
import html
import importlib
import io
import os
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md")
FOLDERS = {"benchmarks/results": (".md", ".png"), "notebooks": (".ipynb",)}  # of which files of these kinds are taken
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]*)(#[^)\s]*)?\)")
INSTRUCTION = re.compile(r"^<!-- (include|prints|lists|api): (.+) -->$", re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    """Add what is not in docs/."""
    paths = [ROOT / page for page in PAGES]
    paths += [path for folder, kinds in FOLDERS.items() for path in sorted((ROOT / folder).iterdir()) if path.suffix in kinds]
    for path in paths:
        name = path.relative_to(ROOT).as_posix()
        if path.suffix == ".ipynb":
            _add_notebook(files, config, path, name)
        else:
            files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def _add_notebook(files: Files, config: Any, path: Path, name: str) -> None:
    from nbconvert import MarkdownExporter

    pictures = f"{path.stem}_files"
    text, found = MarkdownExporter().from_filename(str(path), resources={"output_files_dir": pictures, "unique_key": path.stem})
    files.append(File.generated(config, name.replace(".ipynb", ".md"), content=text))
    for picture, content in found["outputs"].items():
        files.append(File.generated(config, posixpath.join(posixpath.dirname(name), picture), content=content))


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Instructions carried out, links those of the site."""
    uri = page.file.src_uri
    own = uri if uri.partition("/")[0] in ("benchmarks", "notebooks") or uri in PAGES else f"docs/{uri}"
    text = linked(markdown, own, uri, files)
    return INSTRUCTION.sub(lambda found: _carried_out(found[1], found[2], uri, files), text)


def on_page_content(html_text: str, page: Any, config: Any, files: Files) -> str:
    """TeX as MathML, which browsers draw by themselves."""
    inline = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda m: _mathml(m[1], "inline"), html_text, flags=re.DOTALL)
    return re.sub(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', lambda m: _mathml(m[1], "block"), inline, flags=re.DOTALL)


def _mathml(tex: str, display: str) -> str:
    return convert(html.unescape(tex).strip(), display=display)


def linked(text: str, source: str, uri: str, files: Files) -> str:
    """A text of the repository's file ``source`` with links that hold on the page ``uri``; without those to what is no page."""

    def replaced(found: re.Match[str]) -> str:
        picture, words, target, place = found.groups()
        if not target or ":" in target:
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        there = _page_of(path)
        if files.get_file_from_path(there) is None:  # mkdocs warns of what is not there at all
            return words if (ROOT / path).exists() else found[0]
        return f"{picture}[{words}]({posixpath.relpath(there, posixpath.dirname(uri))}{place or ''})"

    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else LINK.sub(replaced, part) for part in parts)


def _page_of(path: str) -> str:
    """The page of the site on a file of the repository."""
    known = {"README.md": "index.md", "benchmarks/results": "benchmarks.md"}
    return known.get(path, path.removeprefix("docs/").replace(".ipynb", ".md"))


def _carried_out(what: str, of: str, uri: str, files: Files) -> str:
    if what == "include":
        name, _, heading = of.partition("#")
        return linked(section(ROOT / name, heading), name, uri, files)
    if what == "lists":
        lines = [f"- [{_title(page)}]({of}/{page.name})\n" for page in sorted((ROOT / of).glob("*.md"))]
        return linked("".join(lines), "README.md", uri, files)
    if what == "prints":
        return f"```text\n$ {of.replace('_', '-', 1)}\n{_printed(of)}\n```"
    return "\n\n".join(f"::: {name}" for name in offered(of))


def section(path: Path, heading: str) -> str:
    """The text under a heading of a Markdown file, up to the next that is as high, or the first chapter; all of it without one."""
    text = path.read_text(encoding="utf-8")
    if not heading:
        return text
    found = re.search(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE)
    if found is None:
        raise ValueError(f"{path}: no heading {heading!r}")
    hidden = lambda block: block[0].replace("\n#", "\n\0")  # noqa: E731  # comments of code are no headings
    rest = re.sub(r"^```.*?^```$", hidden, text[found.end() :], flags=re.MULTILINE | re.DOTALL)
    return re.split(rf"^#{{1,{max(2, len(found[1]))}}} ", rest, maxsplit=1, flags=re.MULTILINE)[0].replace("\n\0", "\n#").strip()


def _title(page: Path) -> str:
    """The first heading of a Markdown file."""
    return next(line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("# "))[2:]


def _printed(line: str) -> str:
    """What a command of the project prints."""
    program, *arguments = line.removeprefix("python -m ").split()
    modules = {"dem_jax": "dem_jax.cli.main"}
    main = importlib.import_module(modules.get(program, f"{program}.__main__")).main
    out = io.StringIO()
    os.environ["COLUMNS"] = "110"  # of argparse's help
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(arguments)
    return out.getvalue().rstrip()


def offered(package: str) -> list[str]:
    """Where each name that a package offers is defined."""
    module = importlib.import_module(package)
    found = []
    for name in module.__all__:
        item = getattr(module, name)
        if isinstance(item, type(module)):
            found.append(item.__name__)
        elif not name.startswith("__"):
            found.append(f"{item.__module__}.{name}")
    return found
