"""Materials by name: what they inherit, the rules of pairs, which piece and which wall is of which,
mistakes.
"""

import numpy as np
import pytest

from dem_jax import assembly, types
from dem_jax.errors import SceneError
from dem_jax.scene import describe_scene, load_scene, material_properties, parse_scene
from dem_jax.scene.sections.material import Pair

SCENE = """
base = "plate-drop"

[material]
density = 400.0
restitution = 0.2
friction_wall = 0.25
pull_off = 0.01
wall_poisson_ratio = 0.28

[material.gummy]
density = 1300.0
youngs_modulus = 2e7
restitution = 0.6
friction_wall = 0.9
poisson_ratio = 0.45
pull_off = 0.05

[material.nut]
friction_piece = 0.5

[material.steel]
youngs_modulus = 2e11
poisson_ratio = 0.29

[material.unused]

[[pair]]
of = ["steel", "gummy"]
restitution = 0.35
friction = 1.1

[[pair]]
of = ["default", "nut"]
pull_off = 0.0

[[pair]]
of = ["nut", "nut"]
restitution = 0.15

[[pair]]
of = ["wall", "default"]
friction = 0.05

[[piece]]
material = "gummy"
position = [0, 0, 0.1]
[[piece]]
position = [0, 0, 0.2]
[[piece]]
material = "nut"
position = [0, 0, 0.3]
[[piece]]
material = "gummy"
position = [0, 0, 0.4]

[[wall]]
group = "plate"
corners = [[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]
[[wall]]
group = "side"
material = "steel"
corners = [[0.5, -0.5, 0.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.0], [0.5, 0.5, 0.0]]
[[wall]]
group = "chute"
material = "nut"
corners = [[-0.5, -0.5, 0.0], [-0.5, 0.5, 0.0], [-0.5, 0.5, 1.0], [-0.5, -0.5, 1.0]]
"""


@pytest.fixture
def scene():
    return parse_scene(SCENE)


def test_a_single_material_is_two_rows_and_four_numbers():
    table = material_properties.build_material_table(load_scene("weigh-bucket"))
    assert table.names == ("default", "wall") and table.is_wall.tolist() == [False, True]
    np.testing.assert_array_equal(table.density, 300.0)
    np.testing.assert_array_equal(table.youngs_modulus, [1e8, 1e11])
    np.testing.assert_array_equal(table.poisson_ratio, 0.3)
    np.testing.assert_array_equal(table.restitution, 0.1)
    np.testing.assert_array_equal(table.friction[0], [0.7, 0.3])
    np.testing.assert_array_equal(table.friction[:, 0], [0.7, 0.3])
    np.testing.assert_array_equal(table.pull_off, 0.0)


def test_what_a_material_does_not_set_is_that_of_the_scene(scene):
    """Of a wall E_b and its Poisson's ratio: "nut" is of pieces with E_p and of a wall with E_b."""
    table = material_properties.build_material_table(scene)
    assert table.names == ("default", "gummy", "nut", "wall", "steel", "nut")
    assert table.is_wall.tolist() == [False] * 3 + [True] * 3
    assert table.density[:3].tolist() == [400.0, 1300.0, 400.0]
    assert table.youngs_modulus.tolist() == [1e8, 2e7, 1e8, 1e11, 2e11, 1e11]
    assert table.poisson_ratio.tolist() == [0.3, 0.45, 0.3, 0.28, 0.29, 0.28]


def test_the_rules_of_pairs(scene):
    """Listed; else two of one material, the mean of two different ones, the piece's on a wall."""
    table = material_properties.build_material_table(scene)
    default, gummy, nut, wall, steel, chute = range(6)
    expected = {
        (default, default): (0.2, 0.7, 0.01),
        (gummy, gummy): (0.6, 0.7, 0.05),
        (nut, nut): (0.15, 0.5, 0.01),  # listed: restitution
        (default, gummy): (0.4, 0.7, 0.03),
        (default, nut): (0.2, 0.6, 0.0),  # listed: pull_off
        (gummy, nut): (0.4, 0.6, 0.03),
        (default, wall): (0.2, 0.05, 0.01),  # listed: friction
        (gummy, wall): (0.6, 0.9, 0.05),
        (nut, wall): (0.2, 0.25, 0.01),
        (default, steel): (0.2, 0.25, 0.01),
        (gummy, steel): (0.35, 1.1, 0.05),  # listed: restitution and friction
        (nut, steel): (0.2, 0.25, 0.01),
        (default, chute): (0.2, 0.25, 0.0),  # the pair of names holds for pieces and walls
        (gummy, chute): (0.6, 0.9, 0.05),
        (nut, chute): (0.15, 0.25, 0.01),
    }
    for (a, b), numbers in expected.items():
        for i, j in ((a, b), (b, a)):
            found = table.restitution[i, j], table.friction[i, j], table.pull_off[i, j]
            assert found == pytest.approx(numbers, rel=1e-15), (table.names[i], table.names[j])


def test_which_piece_and_which_wall_is_of_which(scene):
    table = material_properties.build_material_table(scene)
    goods = assembly.piece_arrays.build_piece_set(scene)
    assert material_properties.find_piece_rows(table, goods.materials).tolist() == [1, 0, 2, 1]
    assert material_properties.find_group_rows(
        table, scene, ("plate", "side", "chute")
    ).tolist() == [3, 4, 5]
    named = {"material.steel.restitution": 0.5, "material.felt.density": 1.0}
    station = load_scene(
        "weighing-station", named | {"weigh_bucket.material": "steel", "feeder.material": "felt"}
    )
    walls = assembly.assemble_system(station).system.walls
    table = material_properties.build_material_table(station)
    assert table.names == ("default", "wall", "steel", "felt")
    of_group = dict(
        zip(
            walls.groups,
            material_properties.find_group_rows(table, station, walls.groups).tolist(),
            strict=True,
        )
    )
    assert of_group == {group: {"wb": 2, "fb": 1, "lf": 3}[group[:2]] for group in walls.groups}


def test_mass_inertia_and_stiffness_follow_the_material_of_each_piece(scene):
    """One shape of three materials: a piece keeps the numbers of its material, and the step is that
    of the stiffest.
    """
    built = assembly.assemble_system(scene.replace(run={"precision": "f64"}))
    pieces = built.system.pieces
    np.testing.assert_allclose(
        pieces.mass, 19440e-9 * np.array([1300.0, 400.0, 400.0, 1300.0]), rtol=1e-12
    )
    np.testing.assert_allclose(
        pieces.inertia[0] / pieces.mass, float(pieces.inertia[0, 0] / pieces.mass[0]), rtol=1e-12
    )
    stiffness = built.system.materials.youngs_modulus[pieces.material] * pieces.size
    np.testing.assert_allclose(stiffness / stiffness[1], [0.2, 1.0, 1.0, 0.2], rtol=1e-12)
    assert built.system.alike == ("hulls",)
    order = scene.piece[::-1]
    assert assembly.assemble_system(scene.replace(piece=order)).step.critical == pytest.approx(
        built.step.critical, rel=1e-12
    )
    assert built.step.critical == pytest.approx(
        critical_step(scene, np.asarray(pieces.mass), float(pieces.size[0])), rel=1e-12
    )


def critical_step(scene, mass, size):
    """The smallest over all pairs of pieces, and of pieces and walls, of 15 steps per loading and
    10 per unloading quarter.
    """
    table = material_properties.build_material_table(scene)
    row = material_properties.find_piece_rows(table, [piece.material for piece in scene.piece])
    modulus = scene.material.numerical_softening * table.youngs_modulus * size
    found = []
    for i, a in enumerate(row):
        bodies = [(b, mass[i] * mass[j] / (mass[i] + mass[j])) for j, b in enumerate(row) if j != i]
        for b, m in [*bodies, *((b, mass[i]) for b in np.flatnonzero(table.is_wall))]:
            load = np.pi / 2 * np.sqrt(m * (modulus[a] + modulus[b]) / (modulus[a] * modulus[b]))
            found.append(min(load / 15, table.restitution[a, b] * load / 10))
    return min(found)


def test_materials_are_changed_by_key_and_by_section(scene):
    assert (
        scene.replace({"material.gummy.restitution": 0.4})
        .material.named_materials["gummy"]
        .restitution
        == 0.4
    )
    changed = scene.replace(material={"gummy": {"restitution": 0.4}})
    assert (
        changed.material.named_materials["gummy"].restitution == 0.4
        and changed.material.named_materials["gummy"].density == 1300.0
    )
    assert changed == parse_scene(SCENE.replace("restitution = 0.6", "restitution = 0.4"))
    assert parse_scene(changed.to_toml()) == changed == parse_scene(describe_scene(changed))
    made = load_scene("plate-drop", {"material.felt.density": 90.0, "piece.0.material": "felt"})
    assert assembly.assemble_system(made).system.pieces.mass[0] == pytest.approx(
        90 * 19440e-9, rel=1e-6
    )


MISTAKES = [  # changes of the scene -> what the line must hold
    ({"material.restitutoin": 0.3}, r"material\.restitutoin = 0\.3: unknown key; did you mean 'restitution'\? allowed: density, "),
    ({"material.gummy.restitutoin": 0.3}, r"material\.gummy\.restitutoin = 0\.3: unknown key; did you mean 'restitution'\?"),
    ({"material.gummy.restitution": 1.5}, r"material\.gummy\.restitution = 1\.5: allowed: a number > 0 and <= 1"),
    ({"material.gummy.numerical_softening": 1.0}, r"numerical_softening = 1\.0: unknown key; allowed: density, youngs_modulus"),
    ({"material.gumy.restitution": 0.5}, r"material\.gumy\.restitution: nothing is of a material 'gumy'; did you mean 'gummy'\?"),
    ({"material.poisson_ratio": 0.5}, r"material\.poisson_ratio = 0\.5: allowed: a number >= 0 and < 0\.5"),
    ({"material.pull_off": -1.0}, r"material\.pull_off = -1\.0: allowed: a number >= 0"),
    ({"material.restitution": {"density": 1.0}}, r"material\.restitution = .*: allowed: a number > 0 and <= 1"),
    ({"material.wall": {}}, r"material: a table by the name of 'wall'; allowed: a letter"),
    ({"material.a b": {}}, r"material: a table by the name of 'a b'; allowed: a letter"),
    ({"piece.1.material": "gumy"}, r'piece\.1\.material = "gumy": no such .*mean .gummy.\? allowed: gummy, nut, steel'),
    ({"wall.0.material": "default"}, r'wall\.0\.material = "default": no such material; allowed: gummy, nut, steel'),
    ({"pair.1.of": ["nut", "stel"]}, r'pair\.1\.of = \["nut", "stel"\]: no such .*mean .steel.\? allowed: default, wall, gummy'),
    ({"pair.1.of": ["gummy", "steel"]}, r"pair\.1\.of = .*: is listed already; allowed: each pair once"),
    ({"pair.1.of": ["gummy"]}, r'pair\.1\.of = \["gummy"\]: allowed: a list of 2, each a text'),
    ({"pair": [{"of": ["nut", "gummy"]}]}, r"pair\.0: missing: restitution, .*, pull_off; at least one must be given"),
    ({"pair": [{"friction": 0.1}]}, r"pair\.0\.of: missing; it must be given: a list of 2, each a text"),
    ({"pair": 3}, r"pair = 3: allowed: tables \[\[pair\]\]"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "expected"), MISTAKES)
def test_a_mistake_is_one_clear_line(scene, changes, expected):
    with pytest.raises(SceneError, match=expected) as error:
        scene.replace(changes)
    assert "\n" not in str(error.value)


def test_a_scene_without_named_materials_says_so():
    with pytest.raises(
        SceneError,
        match=r'piece\.0\.material = "nut": no such material; allowed: .* of which there is none',
    ):
        load_scene("plate-drop", {"piece.0.material": "nut"})


def test_a_wall_group_is_of_one_material(scene):
    rows = [wall.model_copy(update={"group": "all"}) for wall in scene.wall]
    with pytest.raises(
        SceneError,
        match=r"wall\.1\.material = steel: wall group 'all' has none; allowed: one material",
    ):
        assembly.assemble_system(scene.replace(wall=rows))


def test_a_property_of_pairs_has_a_key_a_rule_and_arrays():
    """What a new one takes: the files of its key, of its rule, and of its arrays."""
    rules = material_properties._RULES
    assert set(rules) == set(types.PAIR_PROPERTIES)
    for name, (key, _) in rules.items():
        assert key in Pair.model_fields
        records = material_properties.MaterialTable, types.Materials, types.MaterialPair
        assert all(name in record.__annotations__ for record in records)
