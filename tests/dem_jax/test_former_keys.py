"""Keys of scenes of the release before: they still work, with one note, and can be rewritten."""

import re
import tomllib

import pytest

import dem_jax
from dem_jax.cli.main import main
from dem_jax.deprecation import FormerNameWarning
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene, parse_scene
from dem_jax.scene.former_keys import FORMER_KEYS, list_former_keys, rename_key, rename_tables
from dem_jax.scene.migration import migrate_text
from dem_jax.scene.scene import Scene
from dem_jax.study.config import load_study

# also where a test expects another one
pytestmark = pytest.mark.filterwarnings("ignore::dem_jax.deprecation.FormerNameWarning")
FORMER = """# my drop
base = "weigh-bucket"   # a stock scene
[run]
sample = 1e-4  # s
escape = "note"
[weigh_bucket]
mouth = [0.16, 0.14]
[drop]
height = 0.2
[weigh_bucket.load_cell]
mass = 1.2
[[block]]
name = "above"
low = [0, 0, 0.1]
high = [1, 1, 1]
[contact.cohesion]
range = 2e-4
[[uncertain]]
key = "material.softening"
range = [0.005, 0.02]
"""
NOW = {
    "sample_interval": "sample",
    '"warn"': '"note"',
    "on_escape": "escape",
    "opening_size": "mouth",
    "[[region]]": "[[block]]",
    "interaction_range": "range",
    "material.numerical_softening": "material.softening",
}
STUDY = """title = "softening"
scene = "plate-drop"
set = { "run.escape" = "note", "run.frames" = 0.0 }
seeds = 1
[parameter."material.softening"]  # NSF
values = [0.1, 0.2]
[quick.parameter]
"material.softening" = { values = [0.1] }
"""


def find_model(section):
    """The class of a dotted section."""
    from dem_jax.scene.messages import find_section

    model = Scene
    for part in filter(None, section.split(".")):
        model = find_section(model, part)
    return model


@pytest.mark.parametrize("section", [name for name in FORMER_KEYS if name != "evidence"])
def test_each_former_key_is_one_of_now(section):
    fields = find_model(section).model_fields
    for former, name in FORMER_KEYS[section].items():
        assert name in fields and former not in fields


def test_dotted_keys():
    renamed = dict(list_former_keys())
    assert rename_key("run.sample") == renamed["run.sample"] == "run.sample_interval"
    assert rename_key("motion.0.swing_deg") == "motion.0.opening_angle_deg"
    assert rename_key("block.1.low") == "region.1.low"
    assert rename_key("portion.product.2.max_corners") == "portion.product.2.max_vertices"
    assert rename_key("material.restitution") == "material.restitution"
    assert rename_key("feeder.start") == "feeder.start"


def test_a_scene_of_former_keys_is_that_of_now(tmp_path):
    former, now = tmp_path / "drop.toml", tmp_path / "now" / "drop.toml"
    now.parent.mkdir()
    former.write_text(FORMER)
    text, renamed = migrate_text(FORMER, "drop.toml")
    now.write_text(text)
    with pytest.warns(FormerNameWarning) as notes:
        read = load_scene(former)
    assert len(notes) == len(renamed) == 6
    assert all("dem-jax migrate" in str(note.message) for note in notes)
    assert read == load_scene(now).replace(folder=read.folder)
    assert (read.run.sample_interval, read.run.on_escape) == (1e-4, "warn")


def test_rewriting_changes_names_alone_and_once():
    text, _ = migrate_text(FORMER, "drop.toml")
    back = text
    for name, former in NOW.items():
        assert name in text
        back = back.replace(name, former)
    assert back == FORMER
    assert migrate_text(text, "drop.toml") == (text, [])


def test_a_study_of_former_keys(tmp_path):
    path = tmp_path / "soft.toml"
    path.write_text(STUDY)
    with pytest.warns(FormerNameWarning, match=r"material\.softening is now material\.numer"):
        former = load_study(path, quick=True)
    assert main(["migrate", str(path)]) == 0
    assert load_study(path, quick=True) == former
    assert former.set == {"run.on_escape": "warn", "run.frame_interval": 0.0}
    assert former.parameter["material.numerical_softening"].values == (0.1,)
    assert "# NSF" in path.read_text()


def test_former_keys_from_python():
    now = load_scene("plate-drop", {"run.sample_interval": 1e-4, "run.on_escape": "warn"})
    with pytest.warns(FormerNameWarning, match=r"run\.sample is now run\.sample_interval"):
        assert load_scene("plate-drop", {"run.sample": 1e-4, "run.escape": "note"}) == now
    with pytest.warns(FormerNameWarning):
        assert load_scene("plate-drop").replace(run={"sample": 1e-4, "escape": "note"}) == now
    with pytest.warns(FormerNameWarning):
        assert Scene(piece=[{"position": (0, 0, 1)}], run={"sample": 1e-4}).run.sample == 1e-4
    with pytest.warns(FormerNameWarning, match="Scene.block is now region"):
        assert now.block == now.region
    with pytest.raises(AttributeError, match="no attribute 'samples'"):
        now.run.samples  # noqa: B018


def test_parameters_of_an_ensemble_by_a_former_key():
    scene = load_scene("plate-drop", {"run.duration": 1e-3, "run.frame_interval": 0.0})
    with pytest.warns(FormerNameWarning, match="material.softening is now"):
        runs = dem_jax.ensemble(scene, seed=[0, 1], parameters={"material.softening": [0.1, 0.2]})
    assert list(runs.parameters["material.numerical_softening"]) == [0.1, 0.2]


def test_a_key_by_both_of_its_names_is_refused():
    with pytest.raises(SceneError, match="run.sample"):
        load_scene("plate-drop", {"run.sample": 1e-4, "run.sample_interval": 1e-4})
    with pytest.raises(SceneError, match="run.sample_interval: is given as sample as well"):
        rename_tables({"run": {"sample": 1.0, "sample_interval": 1.0}})
    with pytest.raises(SceneError, match="a.toml: run.sample_interval: is given as sample"):
        migrate_text("[run]\nsample = 1.0\nsample_interval = 1.0\n", "a.toml")


@pytest.mark.filterwarnings("ignore::dem_jax.deprecation.FormerNameWarning")
def test_a_stored_scene_needs_no_note(recwarn):
    text = load_scene("plate-drop").to_toml()
    former = re.sub(r"^sample_interval =", "sample =", text, flags=re.M)
    assert former != text and parse_scene(former) == parse_scene(text)
    assert not recwarn


def test_the_command_prints_one_note(tmp_path, capsys):
    (tmp_path / "drop.toml").write_text(FORMER)
    assert main(["check", str(tmp_path / "drop.toml")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert len([line for line in said if "run.sample is now run.sample_interval" in line]) == 1
    assert main(["migrate", "--dry-run", str(tmp_path / "drop.toml")]) == 0
    assert (tmp_path / "drop.toml").read_text() == FORMER
    (tmp_path / "bad.toml").write_text("a = [")
    assert main(["migrate", str(tmp_path / "drop.toml"), str(tmp_path / "bad.toml")]) == 2
    assert "bad.toml: not valid TOML" in capsys.readouterr().err
    assert (tmp_path / "drop.toml").read_text() == FORMER, "none is written unless all can be"
    assert main(["migrate", str(tmp_path / "drop.toml")]) == 0
    assert tomllib.loads((tmp_path / "drop.toml").read_text())["region"][0]["name"] == "above"
