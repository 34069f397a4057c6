"""What the pages tell people to type is there: commands with their flags, scenes and studies, names
that Python code imports.

Command help and tables of keys are computed when the site is built; the tutorials are followed word
for word by .ci/stories.
"""

import ast
import importlib
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from calibrate.__main__ import _parser as parser_of_calibrate
from dem_jax.cli.main import build_parser
from dem_jax.cluster.places import SITE_KEYS
from dem_jax.scene.scene import Scene
from dem_jax.scene.tree_merging import parse_setting
from dem_jax.study.config import Study
from product_model.__main__ import _parser as parser_of_product_model

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = {
    "dem_jax": build_parser,
    "product_model": parser_of_product_model,
    "calibrate": parser_of_calibrate,
}
COMMAND = re.compile(
    r"(?:python -m (dem_jax|product_model|calibrate)|\b(dem-jax|product-model|calibrate)) ([^`|#>]*)"
)


def blocks(kind):
    """(page, code) of the fenced blocks of a kind."""
    found = [
        (page, code)
        for page in PAGES
        for code in re.findall(rf"^```{kind}\n(.*?)^```$", page.read_text(), re.M | re.S)
    ]
    return [
        pytest.param(code, id=f"{page.relative_to(ROOT)}-{k}")
        for k, (page, code) in enumerate(found)
    ]


def commands():
    """Command lines in blocks of sh, and those between backquotes that have an argument."""
    for page in PAGES:
        text = page.read_text()
        code = "".join(re.findall(r"^```sh\n(.*?)^```$", text, re.M | re.S))
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
        lines = code.replace("\\\n", " ").splitlines()
        lines += re.findall(r"`((?:python -m |dem-jax|product-model|calibrate )[^`\n]+)`", prose)
        for line in lines:
            for program, name, arguments in COMMAND.findall(line):
                yield program or name.replace("-", "_"), arguments.split("&&")[0].strip()


@pytest.mark.parametrize(("program", "line"), sorted({c for c in commands() if "..." not in c[1]}))
def test_a_command_is_one_that_the_program_takes(program, line):
    if line.endswith("--help"):
        return
    arguments = shlex.split(line)
    try:
        found = PROGRAMS[program]().parse_args(arguments)
    except SystemExit as end:
        pytest.fail(f"{program} {line}: ends with {end.code}")
    for setting in getattr(found, "settings", None) or ():
        key, _ = parse_setting(setting)
        assert key.split(".")[0] in {*Scene.model_fields, "product", "bucket"}, key


@pytest.mark.parametrize("code", blocks("toml"))
def test_a_piece_of_toml_is_of_a_scene_a_study_or_a_site(code):
    tree = tomllib.loads(code)
    known = (
        {*Study.model_fields}
        if "outputs" in tree
        else {*SITE_KEYS}
        if "system" in tree
        else {*Scene.model_fields, "base", "product", "bucket"}
    )
    assert tree.keys() <= known
    for key, section in tree.items():
        model = Scene.model_fields.get(key)
        rows = section if isinstance(section, list) else [section]
        for row in rows if model is not None and "outputs" not in tree else ():
            inner = list(_models(model.annotation))
            extra = inner and inner[0].model_config.get("extra") == "allow"
            assert not inner or extra or row.keys() <= inner[0].model_fields.keys(), (key, row)


def _models(annotation):
    if isinstance(annotation, type) and hasattr(annotation, "model_fields"):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _models(part)


@pytest.mark.parametrize("code", blocks("python"))
def test_what_python_code_imports_is_there(code):
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in PROGRAMS:
            module = importlib.import_module(node.module)
            for name in node.names:
                assert hasattr(module, name.name) or importlib.import_module(
                    f"{node.module}.{name.name}"
                )
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "dem_jax"
        ):
            assert hasattr(
                importlib.import_module("dem_jax"), node.attr
            ) or importlib.import_module(f"dem_jax.{node.attr}")


def test_the_readme_is_short_and_its_test_command_is_that_of_ci():
    text = (ROOT / "README.md").read_text()
    assert len(text.encode()) <= 7000
    assert (
        "python -m pytest -n 2\n" in text
        and "python -m pytest -n 2\n" in (ROOT / ".ci/run").read_text()
    )
