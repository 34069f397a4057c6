"""Products true to life: pieces of the stated weight, volume and extent, and numbers with a range,
a grade and a source.
"""

import numpy as np
import pytest

from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
from dem_jax.cli.main import main
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene, parse_scene
from dem_jax.scene.evidence import read_evidence
from dem_jax.scene.library import ONE_PIECE, list_product_states, list_products, load_product
from dem_jax.scene.material_properties import build_material_table

EVERY = [
    full
    for name in list_products()
    for full in (name, *(f"{name}:{state}" for state in list_product_states(name)))
]


def piece_of(name):
    """The shape of a piece, its weight (kg) and the evidence of its product."""
    scene = load_scene("weigh-bucket", {"product": name, **ONE_PIECE})
    goods = build_piece_set(scene)
    return (
        goods.shapes[0],
        compute_masses(goods, build_material_table(scene))[0],
        read_evidence(load_product(name, "test"), name),
    )


def extent_of(shape):
    """Lengths (m) of a piece along the axes in which it is given."""
    parts = (
        [part.shape.vertices + part.centre for part in shape.parts]
        if shape.parts
        else [shape.vertices]
    )
    corners = np.concatenate(parts)
    return np.full(3, 2 * shape.radius) if shape.radius else np.ptp(corners, axis=0)


@pytest.mark.parametrize("name", EVERY)
def test_a_piece_has_the_weight_the_volume_and_the_extent_of_the_product(name):
    """5 %: what flat faces that keep the volume exactly need; the weight is the density times the
    volume.
    """
    shape, weight, rows = piece_of(name)
    assert shape.volume == pytest.approx(rows["volume"].value, rel=2e-3), (
        "hulls are scaled to the volume, to a micrometre"
    )
    assert weight == pytest.approx(rows["piece_weight"].value, rel=0.05)
    assert extent_of(shape) == pytest.approx(np.array(rows["extent"].value), rel=0.05)


@pytest.mark.parametrize("name", ["almond", "chocolate-lentil", "peanut", "raisin"])
def test_hulls_of_ellipsoids_are_symmetric_and_turn_like_them(name):
    """Moments of inertia over mass of an ellipsoid: (b^2 + c^2) / 20 with its axes b, c. 24 corners
    outside of it add 2 to 3 %.
    """
    shape, _, rows = piece_of(name)
    a, b, c = rows["extent"].value
    exact = np.sort([(b * b + c * c) / 20, (a * a + c * c) / 20, (a * a + b * b) / 20])
    assert np.sort(shape.gyration) == pytest.approx(exact, rel=0.03)
    assert len(shape.vertices) == 24 and len(shape.faces) == 44
    opposite = np.linalg.norm(shape.vertices[:, None] + shape.vertices, axis=2).min(axis=1)
    assert opposite.max() < 2e-6, (
        "each corner has one across the centre, to the micrometres of the file"
    )


@pytest.mark.parametrize("name", EVERY)
def test_every_number_has_a_grade_and_a_source_or_is_called_a_judgement(name):
    """All numbers of [material] but those of the model; those that are drawn lie within their
    range.
    """
    scene = load_scene("weigh-bucket", {"product": name})
    tree, rows = load_product(name, "test"), read_evidence(load_product(name, "test"), name)
    of_model = {"numerical_softening", "youngs_modulus_range"}
    assert set(tree["material"]) - of_model <= set(rows) and {
        "piece_weight",
        "volume",
        "extent",
    } <= set(rows)
    for key, row in rows.items():
        assert (row.source == "judgement") == (row.grade == "C"), key
        assert bool(row.address) == (row.grade != "C"), key
    drawn = {row.key: row for row in scene.uncertain}
    assert set(drawn) == {
        f"material.{key}" for key in tree["material"] if rows.get(key) and rows[key].range
    }
    assert all(
        row.distribution == "log-uniform"
        for key, row in drawn.items()
        if key.endswith(("modulus", "pull_off"))
    )
    assert parse_scene(scene.to_toml()) == scene


def test_a_state_changes_what_it_says_and_has_its_own_evidence():
    frozen, thawing = (
        load_scene("weigh-bucket", {"product": name})
        for name in ("frozen-pea", "frozen-pea:thawing")
    )
    assert (frozen.material.friction_wall, thawing.material.friction_wall) == (0.22, 0.64)
    assert frozen.portion == thawing.portion and frozen.material.density == thawing.material.density
    assert {row.key: row.range for row in thawing.uncertain}["material.friction_wall"] == (
        0.57,
        0.72,
    )
    with pytest.raises(
        SceneError, match="product = 'frozen-pea:dry': no state 'dry'; allowed: thawing"
    ):
        load_scene("weigh-bucket", {"product": "frozen-pea:dry"})
    with pytest.raises(SceneError, match="no state 'dry'; it has one state only"):
        load_scene("weigh-bucket", {"product": "toffee:dry"})


def test_a_number_that_is_replaced_loses_its_range():
    """In the order of the scenes: another product's ranges replace those of the one before, and a
    value of one's own has none.
    """
    scene = load_scene("weigh-bucket", {"product": "hazelnut", "material.restitution": 0.4})
    keys = [row.key for row in scene.uncertain]
    assert "material.restitution" not in keys and "material.friction_wall" in keys
    other = scene.replace({"product": "toffee"})
    assert {row.key: row.range for row in other.uncertain}["material.restitution"] == (0.1, 0.45)
    own = {"uncertain": [{"key": "drop.height", "range": [0.2, 0.3]}]}
    kept = scene.replace(own).replace({"product": "toffee"})
    assert [row.key for row in kept.uncertain][0] == "drop.height" and len(kept.uncertain) == 6


def test_a_mixture_has_the_ranges_of_its_products_by_name():
    rows = '[[portion.product]]\nproduct = "hazelnut"\n[[portion.product]]\nproduct = "frozen-pea:thawing"\nsize_spread = 0.1\n'
    scene = parse_scene(
        f'base = "weigh-bucket"\n[portion]\n{rows}[material.hazelnut]\nrestitution = 0.4\n'
    )
    keys = {row.key: row.range for row in scene.uncertain}
    assert "material.hazelnut.restitution" not in keys and keys["material.hazelnut.density"] == (
        780.0,
        1020.0,
    )
    assert keys["material.frozen-pea-thawing.friction_wall"] == (0.57, 0.72)


def test_the_law_of_foams_comes_and_goes_with_the_product():
    foam = load_scene("weigh-bucket", {"product": "marshmallow-soft"})
    assert (
        foam.contact.law == "densifying"
        and foam.replace({"product": "hazelnut"}).contact.law == "walton-braun"
    )
    assert foam.replace({"contact.law": "hertz-mindlin"}).contact.law == "hertz-mindlin"
    tablet = foam.replace(
        {"product": "hazelnut", "contact.law": "elastic-plastic", "contact.yield_pressure": 2e6}
    )
    assert (
        tablet.contact.yield_pressure == 2e6
        and tablet.replace({"product": "toffee"}).contact.law == "walton-braun"
    )
    rows = '[[portion.product]]\nproduct = "hazelnut"\n[[portion.product]]\nproduct = "marshmallow-soft"\n'
    assert parse_scene(f'base = "weigh-bucket"\n[portion]\n{rows}').contact.law == "densifying"
    assert (
        parse_scene(
            f'base = "weigh-bucket"\n[contact]\nlaw = "linear-dashpot"\n[portion]\n{rows}'
        ).contact.law
        == "linear-dashpot"
    )


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            'range = [0.3, 0.6]\ngrade = "A"',
            "evidence.restitution.address: missing; grade A needs source, address and says",
        ),
        (
            'range = [0.3, 0.6]\ngrade = "D"',
            'evidence.restitution.grade = "D": allowed: "A" or "B" or "C"',
        ),
        (
            'range = [0.6, 0.3]\ngrade = "C"',
            r"range = \[0.6, 0.3\]: allowed: low, high, the first below the second",
        ),
        (
            'range = [0.3, 0.6]\ngrade = "C"\nsorce = ""',
            "sorce = .*unknown key; did you mean 'source'",
        ),
        (
            'range = [0.5, 0.6]\ngrade = "C"',
            r"restitution = 0.4: outside of evidence.restitution.range = \[0.5, 0.6\]",
        ),
        ('value = 0.4\ngrade = "C"', "evidence.restitution.value = 0.4: allowed: to leave it out"),
    ],
)
def test_evidence_that_is_not_valid_is_one_line(tmp_path, row, message):
    (tmp_path / "nut.toml").write_text(
        f'[portion]\nshape = "sphere"\nradius = 6e-3\n[material]\nrestitution = 0.4\n[evidence.restitution]\n{row}\n'
    )
    with pytest.raises(SceneError, match=message):
        load_scene("weigh-bucket", {"product": "nut.toml"})


SHAPE = '[portion]\nshape = "sphere"\nradius = 6e-3\n'


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (
            f"material = 5\n{SHAPE}",
            "nut.toml",
            r"product = 'nut.toml': material = 5: allowed: a table \[material\]",
        ),
        (
            "portion = 5\n",
            "nut.toml",
            r"product = 'nut.toml': portion = 5: allowed: a table \[portion\]",
        ),
        (
            f"state = 5\n{SHAPE}",
            "nut.toml:wet",
            r"product = 'nut.toml:wet': state: allowed: tables \[state.NAME\]",
        ),
        (
            f"{SHAPE}[state]\nwet = 5\n",
            "nut.toml:wet",
            r"product = 'nut.toml:wet': state: allowed: tables \[state.NAME\]",
        ),
        (
            f"{SHAPE}[state.wet]\nmaterial = 5\n",
            "nut.toml:wet",
            r"'nut.toml:wet': material = 5: allowed: a table \[material\]",
        ),
    ],
)
def test_sections_of_a_product_that_are_no_tables_are_refused(tmp_path, text, name, message):
    (tmp_path / "nut.toml").write_text(text)
    with pytest.raises(SceneError, match=message):
        load_scene("weigh-bucket", {"product": name})
    with pytest.raises(SceneError, match=message):
        parse_scene(f'base = "weigh-bucket"\n[[portion.product]]\nproduct = "{name}"\n')


def test_ranges_that_are_no_tables_are_refused_beside_products():
    for rows in ('product = "hazelnut"\n', '[[portion.product]]\nproduct = "hazelnut"\n'):
        with pytest.raises(SceneError, match=r"uncertain = 5: allowed: tables \[\[uncertain\]\]"):
            parse_scene(f'base = "weigh-bucket"\nuncertain = 5\n{rows}')


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            {"key": "material.bounce"},
            r'uncertain.0.key = "material.bounce": allowed: the dotted key',
        ),
        ({"key": "drop.height", "distribution": "log-uniform"}, "numbers above 0"),
        ({"key": "portion.shape"}, 'uncertain.0.key = "portion.shape"'),
    ],
)
def test_a_range_of_no_number_is_refused(row, message):
    with pytest.raises(SceneError, match=message):
        load_scene("weigh-bucket", {"uncertain": [{"range": [0, 1], **row}]})


def test_the_command_prints_values_ranges_grades_and_sources(capsys, tmp_path):
    assert main(["products", "peanut"]) == 0
    printed = capsys.readouterr().out
    row = next(line for line in printed.splitlines() if "youngs_modulus (Pa)" in line)
    assert (
        row.split()[3:8] == ["8e+06", "2.5e+06", "to", "2.5e+07", "A,"]
        and "Nader, Assaf, Debs and Louka 2023" in row
        and "doi:10.3390/pr11092532" in row
    )
    assert "C, judgement" in printed and "# states: peanut:moist" in printed
    (tmp_path / "again.toml").write_text(printed)
    by_file, by_name = (
        load_scene("weigh-bucket", {"product": name}) for name in ("again.toml", "peanut")
    )
    sections = ("portion", "material", "uncertain")
    assert [getattr(by_file, key) for key in sections] == [
        getattr(by_name, key) for key in sections
    ]


def test_a_wall_surface_multiplies_friction_and_pull_off_on_that_wall_alone():
    """On PTFE 0.7 times the friction of stainless steel, on dimples 0.85 times, with 0.4 times the
    pull-off; listed pairs stay.
    """
    base = {
        "product": "gummy-bear",
        "material.wall_surface": "ptfe",
        "feed_bucket.material": "tray",
    }
    walls = load_scene("weigh-bucket", {**base, "material.tray.wall_surface": "dimpled"})
    table = build_material_table(walls)
    piece, weigh, feed = (table.names.index(name) for name in ("default", "wall", "tray"))
    own = walls.material
    assert (
        table.friction[piece, weigh] == own.friction_wall * 0.7
        and table.pull_off[piece, weigh] == own.pull_off
    )
    assert (
        table.friction[piece, feed] == own.friction_wall * 0.85
        and table.pull_off[piece, feed] == own.pull_off * 0.4
    )
    assert (
        table.friction[piece, piece] == own.friction_piece
        and table.pull_off[piece, piece] == own.pull_off
    )
    listed = build_material_table(
        walls.replace({"pair": [{"of": ["default", "tray"], "friction": 0.5}]})
    )
    assert listed.friction[piece, feed] == 0.5
    with pytest.raises(
        SceneError,
        match='material.wall_surface = "teflon": allowed: "stainless" or "galvanised" or "dimpled"',
    ):
        load_scene("weigh-bucket", {"material.wall_surface": "teflon"})
