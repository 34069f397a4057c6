"""The house of dem_jax: a room imports only from those below it, and the page that draws it names what there is."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "dem_jax"
PAGE = (ROOT / "docs" / "house.md").read_text()
BASE = {"types", "errors", "compiling", "maths", "process"}
MAY_IMPORT = {  # room -> rooms below it
    "errors": set(),
    "compiling": {"errors"},
    "process": set(),
    "types": set(),
    "maths": set(),
    "shapes": {"errors", "maths"},
    "scene": {"errors"},
    "contact": BASE | {"scene"},
    "pairs": BASE | {"contact"},
    "step": BASE | {"contact", "pairs"},
    "store": BASE | {"step", "scene"},
    "weighing": {"errors", "scene", "store"},
    "build": BASE | {"contact", "pairs", "step", "scene", "shapes"},
    "drive": BASE | {"contact", "pairs", "step", "scene", "build", "store", "__version__"},
    "show": BASE | {"contact", "scene", "shapes", "build", "store", "weighing"},
    "study": BASE | {"scene", "build", "step", "drive", "store", "show", "weighing"},
    "validation": BASE | {"contact", "pairs", "step", "scene", "build", "drive", "store"},
    "app": BASE | {"scene", "shapes", "build", "store", "show", "study"},
    "cli": BASE | {"app", "step", "scene", "build", "drive", "store", "show", "study", "weighing", "__version__"},
    "__main__": {"cli"},
    "__init__": set(),
    "scenes": set(),
    "studies": set(),
    "products": set(),
    "buckets": set(),
}


def files():
    return sorted(PACKAGE.rglob("*.py"))


def room_of(path):
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported(path):
    """Modules of the package that a file imports, anywhere in it, and all modules from elsewhere."""
    own, others = set(), set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = [f"{node.module}.{a.name}" for a in node.names] if node.module == "dem_jax" else [node.module]
        elif isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        for name in names:
            (own if name.split(".")[0] == "dem_jax" else others).add(name)
    return own, others


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_room_imports_only_from_those_below_it(path):
    room = room_of(path)
    own, others = imported(path)
    rooms = {name.split(".")[1] for name in own if name != "dem_jax"} - {room}
    assert rooms <= MAY_IMPORT[room], f"{path} imports {sorted(rooms - MAY_IMPORT[room])}"
    assert not [name for name in others if name.startswith("jax._src")]


def test_no_room_is_below_itself():
    below = dict(MAY_IMPORT)
    while below:
        free = [room for room, rooms in below.items() if not rooms & below.keys()]
        assert free, f"a circle among {sorted(below)}"
        for room in free:
            del below[room]


def test_the_page_names_every_room():
    rooms = {room_of(path) for path in files()} - {"__init__", "__main__", "scenes", "studies", "products", "buckets"}
    assert not [room for room in rooms if f"`{room}" not in PAGE]


def test_the_drawing_has_each_room_above_all_that_it_imports():
    drawing = re.search(r"```text\n(.*?)```", PAGE, re.DOTALL)[1]
    line = {room: n for n, row in enumerate(drawing.splitlines()) for room in re.findall(r"[a-z]+", row)}
    drawn = MAY_IMPORT.keys() - {"__main__", "__init__", "scenes", "studies", "products", "buckets", "validation"}
    assert line.keys() == drawn
    assert not [(room, of) for room in drawn for of in MAY_IMPORT[room] & drawn if line[room] >= line[of]]


def test_what_the_page_names_is_there():
    named = re.findall(r"`(dem_jax/[\w/]+\.py)(?::(\w+))?`", PAGE)
    assert len(named) > 15
    for path, name in named:
        tree = ast.parse((ROOT / path).read_text())
        known = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        assert not name or name in known, (path, name)
    for path in re.findall(r"`((?:contact|scene|step|shapes|maths|build|cli|notebooks)/[\w/]+(?:\.\w+)?/?)`", PAGE):
        assert (ROOT / path).exists() or (PACKAGE / path).exists(), path


@pytest.mark.parametrize("package", ["dem_jax", "product_model", "calibrate"])
def test_text_files_are_utf8_whatever_the_language_of_the_machine(package):
    """Each call that opens a text file names its encoding."""
    found = []
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            attribute = isinstance(node.func, ast.Attribute)
            name = node.func.attr if attribute else getattr(node.func, "id", "")
            modes = [arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
            of_text = name in ("read_text", "write_text", "loadtxt", "savetxt", "genfromtxt") or (
                name == "open" and not attribute and not any("b" in mode for mode in modes if len(mode) <= 3)
            )
            if of_text and not any(keyword.arg == "encoding" for keyword in node.keywords):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found
