"""The layers of dem_jax: a package imports only from those below it, and the architecture page
names all of them.
"""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import dem_jax

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "dem_jax"
PAGE = (ROOT / "docs" / "architecture.md").read_text()
BASE = {"types", "errors", "xla_flags", "math", "process", "program_store", "user_cache"}
CORE = BASE | {
    "scene",
    "walls",
    "contact_laws",
    "narrow_phase",
    "contacts",
    "broad_phase",
    "dynamics",
}
MAY_IMPORT = {  # package -> packages below it
    "errors": set(),
    "xla_flags": {"errors"},
    "program_store": {"user_cache"},
    "user_cache": set(),
    "process": set(),
    "deprecation": set(),
    "types": set(),
    "math": set(),
    "shapes": {"errors", "math", "user_cache"},
    "scene": {"errors", "deprecation", "math"},
    "walls": BASE | {"scene"},
    "contact_laws": BASE,
    "narrow_phase": BASE | {"walls"},
    "contacts": BASE | {"walls", "contact_laws", "narrow_phase"},
    "broad_phase": BASE | {"walls", "contact_laws", "narrow_phase", "contacts"},
    "dynamics": CORE - {"dynamics", "scene"},
    "io": BASE | {"deprecation", "dynamics", "scene"},
    "weighing": {"errors", "scene", "io"},
    "assembly": CORE | {"shapes", "deprecation"},
    "cluster": {"errors", "xla_flags", "process", "program_store", "user_cache", "__version__"},
    "runner": CORE | {"assembly", "cluster", "io", "__version__"},
    "visualization": BASE | {"walls", "scene", "shapes", "assembly", "io", "weighing"},
    "study": BASE
    | {"scene", "assembly", "dynamics", "cluster", "runner", "io", "visualization", "weighing"},
    "validation": CORE | {"assembly", "runner", "io"},
    "app": BASE | {"scene", "shapes", "assembly", "cluster", "io", "visualization", "study"},
    "cli": BASE
    | {
        "app",
        "cluster",
        "deprecation",
        "dynamics",
        "scene",
        "assembly",
        "runner",
        "io",
        "visualization",
        "study",
        "weighing",
        "__version__",
    },
    "__main__": {"cli"},
    "__init__": {"assembly", "deprecation", "dynamics", "errors", "io", "math", "runner", "scene"},
    "scenes": set(),
    "studies": set(),
    "products": set(),
    "buckets": set(),
}


def files():
    return sorted(PACKAGE.rglob("*.py"))


def package_of(path):
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported(path):
    """Modules of the package that a file imports, anywhere in it, and all modules from elsewhere."""
    own, others = set(), set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = (
                [f"{node.module}.{a.name}" for a in node.names]
                if node.module == "dem_jax"
                else [node.module]
            )
        elif isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        for name in names:
            (own if name.split(".")[0] == "dem_jax" else others).add(name)
    return own, others


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_package_imports_only_from_those_below_it(path):
    package = package_of(path)
    own, others = imported(path)
    packages = {name.split(".")[1] for name in own if name != "dem_jax"} - {package}
    assert packages <= MAY_IMPORT[package], (
        f"{path} imports {sorted(packages - MAY_IMPORT[package])}"
    )
    assert not [name for name in others if name.startswith("jax._src")]


def test_no_package_is_below_itself():
    below = dict(MAY_IMPORT)
    while below:
        free = [package for package, packages in below.items() if not packages & below.keys()]
        assert free, f"a circle among {sorted(below)}"
        for package in free:
            del below[package]


def test_the_page_names_every_package():
    packages = {package_of(path) for path in files()} - {
        "__init__",
        "__main__",
        "scenes",
        "studies",
        "products",
        "buckets",
    }
    assert not [package for package in packages if f"`{package}" not in PAGE]


def test_the_drawing_has_each_package_above_all_that_it_imports():
    drawing = re.search(r"```text\n(.*?)```", PAGE, re.DOTALL)[1]
    line = {
        package: n
        for n, row in enumerate(drawing.splitlines())
        for package in re.findall(r"[a-z_]+", row)
    }
    drawn = MAY_IMPORT.keys() - {
        "__main__",
        "__init__",
        "scenes",
        "studies",
        "products",
        "buckets",
        "validation",
    }
    assert line.keys() == drawn
    assert not [
        (package, of)
        for package in drawn
        for of in MAY_IMPORT[package] & drawn
        if line[package] >= line[of]
    ]


def test_what_the_page_names_is_there():
    named = re.findall(r"`(dem_jax/[\w/]+\.py)(?::(\w+))?`", PAGE)
    assert len(named) > 15
    for path, name in named:
        tree = ast.parse((ROOT / path).read_text())
        known = {
            node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        assert not name or name in known, (path, name)
    for path in re.findall(
        r"`((?:contacts|contact_laws|narrow_phase|walls|scene|dynamics|shapes|math|assembly|runner|io|cli|notebooks)/[\w/]+(?:\.\w+)?/?)`",
        PAGE,
    ):
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
            modes = [
                arg.value
                for arg in node.args
                if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
            ]
            of_text = name in ("read_text", "write_text", "loadtxt", "savetxt", "genfromtxt") or (
                name == "open"
                and not attribute
                and not any("b" in mode for mode in modes if len(mode) <= 3)
            )
            if of_text and not any(keyword.arg == "encoding" for keyword in node.keywords):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found


def test_type_checkers_know_every_public_name():
    """The imports for type checkers are those that happen at run time when a name is used first."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    block = next(
        node
        for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    known = {
        alias.asname: node.module
        for node in block.body
        for alias in node.names
        if alias.asname == alias.name
    }
    assert known == {name: f"dem_jax.{module}" for name, module in dem_jax._HOME.items()}
    assert sorted(dem_jax.__all__) == sorted([*known, "__version__"]) and all(
        hasattr(dem_jax, name) for name in known
    )


def test_mypy_refuses_what_the_interface_has_not(tmp_path):
    """With the options of the project, and with what mypy knows of it if it ran before."""
    own = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[tool.mypy]")
    config = tmp_path / "pyproject.toml"
    config.write_text("".join(own[1:]).replace("packages =", "# packages ="), encoding="utf-8")
    program = (
        "import dem_jax\ndem_jax.simulate(nonsense=3)\ndem_jax.nonsense\ndem_jax.load_scene(3)"
    )
    command = [sys.executable, "-m", "mypy", f"--config-file={config}", "-c", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    errors = re.findall(r":(\d): error: .*\[(.*)\]", done.stdout)
    assert errors == [("2", "call-arg"), ("3", "attr-defined"), ("4", "arg-type")], (
        done.stdout + done.stderr
    )


def test_the_reference_lists_every_public_name(capsys):
    """The page makes its list of the names of the package."""
    page = (ROOT / "docs" / "reference" / "dem_jax.md").read_text(encoding="utf-8")
    exec(re.search(r"```python exec=.*?\n(.*?)```", page, re.DOTALL)[1])
    listed = [
        line.removeprefix("::: ").rpartition(".")[2]
        for line in capsys.readouterr().out.split("\n")
        if line
    ]
    assert sorted(listed) == sorted(set(dem_jax.__all__) - {"__version__"})
