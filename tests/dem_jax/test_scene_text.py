"""TOML out and in: what comes back is the same scene, to the last bit."""

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dem_jax.errors import SceneError
from dem_jax.scene import Material, Scene, describe_scene, load_scene, parse_scene
from dem_jax.scene.toml_text import dump_toml, format_value
from dem_jax.scene.tree_merging import overlay_scene, set_key

EXACT = settings(database=None, deadline=None, max_examples=60)

number = st.floats(min_value=-1e30, max_value=1e30)
positive = st.floats(min_value=1e-30, max_value=1e30)
share = st.floats(min_value=1e-6, max_value=1.0)
vector = st.tuples(number, number, number)
name = st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,8}", fullmatch=True).filter(
    lambda text: text not in ("default", "wall")
)
text = st.text(
    st.characters(exclude_categories=["Cc", "Cs"], exclude_characters="/\\"),
    min_size=1,
    max_size=20,
)
some = lambda **keys: st.fixed_dictionaries({}, optional=keys)


@st.composite
def scenes(draw):
    """Scenes of a portion with products or of pieces, with materials and pairs; values need make no
    sense.
    """
    known = draw(
        st.lists(name.filter(lambda n: n not in Material.model_fields), max_size=3, unique=True)
    )
    one_of = {"material": st.sampled_from([None, *known])}
    base = some(
        density=positive,
        restitution=share,
        friction_wall=positive,
        pull_off=positive,
        stiffness_length=st.text(),
    )
    named = some(
        density=positive, youngs_modulus=positive, restitution=share, friction_piece=positive
    )
    tree = {"name": draw(text), "material": draw(base) | {n: draw(named) for n in known}}
    shape = {
        "shape": st.sampled_from(["sphere", "hull"]),
        "scale_factor": positive,
        "radius": positive,
        "stl": st.text(),
    }
    shape["points"] = st.lists(vector, min_size=1, max_size=3)
    if draw(st.booleans()):
        row = st.builds(
            lambda a, b: a | b,
            some(**shape, **one_of, velocity=vector),
            st.fixed_dictionaries({"position": vector}),
        )
        tree["piece"] = draw(st.lists(row, min_size=1, max_size=3))
    else:
        row = some(
            **shape, **one_of, share=positive, size_spread=st.just(0.0) | st.floats(1e-30, 0.5)
        )
        tree["portion"] = {
            "product": draw(st.lists(row, max_size=3)),
            "target_weight": draw(positive),
        }
    panel = st.builds(
        lambda m, c: {"group": "w", "corners": c} | m, some(**one_of), st.lists(vector)
    )
    tree["wall"] = draw(st.lists(panel, max_size=2))
    tree["pair"] = [
        {"of": [n, other], "friction": draw(positive)}
        for n, other in zip(known, ["wall", *known], strict=False)
    ]
    tree["run"] = draw(
        some(
            accuracy=st.fixed_dictionaries({"peak_force": st.floats(1e-9, 0.2)}),
            gravity=vector,
            frame_interval=positive,
        )
    )
    return Scene.model_validate(tree)


@EXACT
@given(scenes())
def test_a_scene_comes_back_exactly(scene):
    assert parse_scene(scene.to_toml()) == scene
    assert parse_scene(describe_scene(scene)) == scene
    assert scene.replace() == scene


@pytest.mark.parametrize(
    "stock", ["plate-drop", "weigh-bucket", "quick-release", "weighing-station"]
)
def test_stock_scenes_come_back_exactly(stock):
    scene = load_scene(stock)
    assert parse_scene(scene.to_toml()) == scene == parse_scene(describe_scene(scene))


plain = st.recursive(
    st.booleans() | st.integers(-(2**62), 2**62) | number | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@EXACT
@given(plain)
def test_a_value_stands_on_one_line_and_comes_back(item):
    line = format_value(item)
    assert "\n" not in line
    assert tomllib.loads(f"item = {line}") == {"item": item}


def test_lists_stand_on_one_line_and_other_objects_as_python_shows_them():
    assert (
        dump_toml({"run": {"gravity": (0.0, -0.0, 1e-5)}})
        == "[run]\ngravity = [0.0, -0.0, 1e-05]\n"
    )
    assert format_value(None) == "None" and format_value(float("nan")) == "nan"
    assert format_value({"a": [1, {"b": ",\n]"}]}) == '{ a = [1, { b = ",\\n]" }] }'


def test_a_key_deep_in_lists_is_set_without_changing_the_original():
    tree = {"portion": {"product": ({"share": 1.0}, {"share": 2.0})}}
    changed = dict(tree)
    set_key(changed, ["portion", "product", "1", "share"], 5.0)
    assert changed["portion"]["product"][1] == {"share": 5.0} and tree["portion"]["product"][1] == {
        "share": 2.0
    }
    with pytest.raises(
        SceneError,
        match=r"product\.2\.share = 5\.0: product is a list; allowed: product\.0\.KEY to product\.1",
    ):
        set_key(changed, ["portion", "product", "2", "share"], 5.0)


def test_products_take_the_place_of_the_shape_below():
    below = {
        "portion": {"shape": "sphere", "radius": 0.01, "material": "gummy", "settling_time": 0.3}
    }
    above = {"portion": {"product": [{"share": 1.0}]}}
    assert overlay_scene(below, above) == {
        "portion": {"settling_time": 0.3, "product": [{"share": 1.0}]}
    }
    assert overlay_scene(below, {"portion": {"radius": 0.02}})["portion"] == below["portion"] | {
        "radius": 0.02
    }
