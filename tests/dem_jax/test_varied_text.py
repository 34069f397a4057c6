"""Keys that vary between the runs of an ensemble, as a command line names them, and samples at a
scale's rate.
"""

import pytest

from dem_jax.__main__ import main
from dem_jax.cli.vary_option import parse_varied_keys
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene


@pytest.mark.parametrize(
    ("texts", "values"),
    [
        (["portion.count=5:7"], {"portion.count": [5, 6, 7, 5, 6]}),
        (["portion.count = 2:10:4"], {"portion.count": [2, 6, 10, 2, 6]}),
        (["drop.height=0.2:0.3:0.05"], {"drop.height": [0.2, 0.25, 0.3, 0.2, 0.25]}),
        (["a=1,0.5", "b=1:3"], {"a": [1, 1, 1, 0.5, 0.5], "b": [1, 2, 3, 1, 2]}),
        (["product=almond,peanut"], {"product": ["almond", "peanut"] * 2 + ["almond"]}),
        (
            ["portion.region_low=[0, 0, 1],[0, 0, 2]"],
            {"portion.region_low": [[0, 0, 1], [0, 0, 2]] * 2 + [[0, 0, 1]]},
        ),
        (['run.time_step="auto"'], {"run.time_step": ["auto"] * 5}),
        ([], {}),
    ],
)
def test_runs_take_values_in_turn(texts, values):
    assert parse_varied_keys(texts, 5) == values


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["portion.count"], "--vary portion.count: allowed: KEY=FROM:TO"),
        (["=1:2"], "--vary =1:2: allowed"),
        (["a="], "--vary a=: allowed"),
        (["a=one:two"], "--vary a=one:two: allowed"),
        (["a=0.5:3"], "not whole needs a step"),
        (["a=3:1"], "from a lower to a higher number"),
        (["a=1:3:0"], "by a step above 0"),
        (["a=1:3:-1"], "by a step above 0"),
        (["a=1:2:3:4"], "by a step above 0"),
        (["a=1:1e9"], "from a lower to a higher number"),
        (["a=nan:3:1"], "from a lower to a higher number"),
        (["a=0:inf:1"], "from a lower to a higher number"),
        (["a=1:2", "a=3"], "a is given twice"),
    ],
)
def test_bad_values_are_one_line(texts, words):
    with pytest.raises(SceneError, match=words):
        parse_varied_keys(texts, 5)


def test_the_command_passes_values_seeds_and_the_rate_on(monkeypatch, tmp_path, capsys):
    from dem_jax.cli import simulation_options
    from dem_jax.runner import interface

    asked = {}

    def ensemble(scene, runs, seed, out, overwrite, progress, parameters, uncertain):
        asked.update(scene=scene, runs=runs, seed=seed, parameters=parameters, uncertain=uncertain)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(interface, "ensemble", ensemble)
    monkeypatch.setattr(simulation_options, "finish_run", lambda *_: None)
    command = [
        "ensemble",
        "weigh-bucket",
        "--runs",
        "3",
        "--vary",
        "portion.count=5:6",
        "--record-rate",
        "500",
    ]
    assert main(command) == 0
    assert (
        asked["parameters"] == {"portion.count": [5, 6, 5]}
        and asked["runs"] == 3
        and asked["uncertain"] is False
    )
    assert asked["scene"] == load_scene(
        "weigh-bucket", {"run.sample_interval": 2e-3, "run.frame_interval": 0.0}
    )
    assert (
        main([*command, "--set", "run.frame_interval=0.01"]) == 0
        and asked["scene"].run.frame_interval == 0.01
    )
    for wrong, words in (
        (["--record-rate", "0"], "--record-rate 0"),
        (["--vary", "a=x:2"], "--vary a=x:2"),
    ):
        assert main([*command[:2], *wrong]) == 2
        assert words in capsys.readouterr().err
    assert main(["run", "--resume", "nothing.h5", "--record-rate", "500"]) == 2
