"""The tables of keys on the reference page: every key of every section once, with unit, default and
allowed values.
"""

import re

import pytest

from dem_jax.scene import reference
from dem_jax.scene.messages import find_named_section, find_section
from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.material import Material


def sections(model=Scene):
    """A section and all below it."""
    yield model
    for key in model.model_fields:
        if below := find_section(model, key):
            yield from sections(below)
    if by_name := find_named_section(model):
        yield by_name


@pytest.fixture(scope="module")
def tables():
    """Heading -> {key: cells} of its table."""
    found = {"": {}}
    for line in reference.key_tables().splitlines():
        if line.startswith("## "):
            found[heading := line[3:]] = {}
        elif row := re.match(r"\| `(\w+)` \| (.*) \|$", line):
            table = found[heading] if len(found) > 1 else found[""]
            assert row[1] not in table
            table[row[1]] = re.split(r"(?<!\\) \| ", row[2].replace(" |  | ", " | - | "))
    return found


def test_every_key_stands_in_a_table(tables):
    shown = {key for table in tables.values() for key in table}
    headed = {key for key in Scene.model_fields if find_section(Scene, key)}  # these are headings,
    # not rows
    keys = {key for model in sections() if model is not Scene for key in model.model_fields}
    assert shown == keys | (Scene.model_fields.keys() - headed - reference.HIDDEN_KEYS)
    assert all(f"`[{key}]`" in tables or f"`[[{key}]]`" in tables for key in headed)


def test_a_row_has_unit_default_allowed_values_and_meaning(tables):
    unit, meaning = reference.split_unit(Material.model_fields["density"].description)
    assert tables["`[material]`"]["density"] == [unit, "`300`", "a number > 0", meaning]
    assert tables["`[[region]]`"]["low"][:3] == ["m", "required", "a list of 3, each a number"]


def test_shared_keys_have_one_table_that_others_link_to(tables):
    assert "radius" in tables["Keys shared by shapes: ConvexShape"]
    assert "radius" not in tables["`[portion]`"] and "radius" not in tables["`[[piece]]`"]
    assert "[ConvexShape](#keys-shared-by-shapes-convexshape)" in reference.key_tables()


@pytest.mark.parametrize(
    ("description", "parts"),
    [
        ("kg/m3, pieces", ("kg/m3", "pieces")),
        ("m", ("m", "")),
        ("m/s; at rest", ("m/s", "at rest")),
        ("N m, at most", ("N m", "at most")),
        ("mu between pieces", ("", "mu between pieces")),
        ("", ("", "")),
    ],
)
def test_a_unit_is_told_from_the_words_after_it(description, parts):
    assert reference.split_unit(description) == parts
