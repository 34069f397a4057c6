"""Numbers of a product from one's own measurements: exact for exact data, intervals that contain
the truth, lines for a file.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax.cli.main import main
from dem_jax.contact_laws import ContactKinematics, MaterialPair
from dem_jax.contact_laws.densifying import Densifying
from dem_jax.contact_laws.hertz_mindlin import HertzMindlin
from dem_jax.contact_laws.linear_dashpot import LinearDashpot
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene
from dem_jax.scene.evidence import read_evidence
from dem_jax.scene.library import load_product
from dem_jax.scene.measurement import estimate_friction, estimate_modulus, estimate_restitution

SIZE, MODULUS = 0.0128, 2e7  # m, Pa


def test_restitution_and_friction_are_those_of_exact_measurements():
    """sqrt(rebound / drop) in any unit, tan(angle); where all agree the interval is 0.1 % to both
    sides.
    """
    same = estimate_restitution([250, 250, 100], [62.5, 62.5, 25])
    assert (same.value, same.low, same.high) == pytest.approx((0.5, 0.4995, 0.5005), rel=1e-9)
    slid = estimate_friction([45.0, 45.0, 45.0])
    assert (slid.key, slid.value) == ("friction_wall", pytest.approx(1.0))


def test_the_interval_is_that_of_student():
    """Of 0.4, 0.5 and 0.6: mean 0.5, standard error 0.1 / sqrt(3), t of 2 degrees of freedom at 95
    % = 2.919986.
    """
    found = estimate_restitution([1, 1, 1], [0.16, 0.25, 0.36])
    half = 2.919986 * 0.1 / np.sqrt(3)
    assert (found.low, found.high, found.spread) == pytest.approx(
        (0.5 - half, 0.5 + half, 0.2), rel=1e-6
    )


def test_nine_of_ten_intervals_contain_the_truth():
    random = np.random.default_rng(1)
    hits = 0
    for _ in range(1000):
        angles = np.degrees(np.arctan(random.normal(0.3, 0.03, 8)))
        found = estimate_friction(angles)
        hits += found.low <= 0.3 <= found.high
    assert hits / 1000 == pytest.approx(0.9, abs=0.03)  # three standard deviations of the count


LAWS = {
    "walton-braun": LinearDashpot(jnp.asarray(1.0)),  # the same spring while loading
    "linear-dashpot": LinearDashpot(jnp.asarray(1.0)),
    "densifying": Densifying(jnp.asarray(0.2), jnp.asarray(1.0), jnp.asarray(5.0)),
    "hertz-mindlin": HertzMindlin(jnp.asarray(5.0)),
}


def force_of_contact(law, overlap):
    """Force (N) of a contact law on an elastic sphere that a rigid plate presses in by an overlap
    (m).
    """
    one = jnp.ones_like(overlap)
    moduli, sizes, curvatures = (
        (1e17 * one, MODULUS * one),
        (SIZE * one, SIZE * one),
        (0 * one, 2 / SIZE * one),
    )
    pair = law.pair_parameters(
        MaterialPair(moduli, (0.3 * one, 0.3 * one), sizes, curvatures, one, one, None, None)
    )
    still, history = (
        (0 * one, 0 * one, 0 * one),
        law.init_history(pair, one)._replace(overlap=overlap),
    )
    return np.asarray(
        law.force(
            pair, history, ContactKinematics(overlap, 0 * one, still, still, 1e-6)
        ).normal_force
    )


@pytest.mark.parametrize("law", LAWS)
def test_the_modulus_is_that_of_the_law_in_use(law):
    """Two contacts in series, each with half of the way; the scale of the way begins 0.3 mm before
    the piece is touched.
    """
    way = np.linspace(0.0002, 0.001, 9)
    with jax.enable_x64(True):
        force = force_of_contact(LAWS[law], jnp.asarray(0.5 * way))
    found = estimate_modulus([(force, way + 0.0003)], SIZE, law)
    assert found.value == pytest.approx(MODULUS, rel=1e-4) and found.low < found.value < found.high


def test_the_modulus_of_several_pieces_is_their_geometric_mean():
    way = np.linspace(0.0002, 0.001, 5)
    pieces = [(factor * MODULUS * SIZE * 0.5 * way, way) for factor in (0.5, 1.0, 2.0)]
    found = estimate_modulus(pieces, SIZE, "walton-braun")
    half = 2.919986 * np.log(2) / np.sqrt(3)
    assert (found.value, found.low, found.high) == pytest.approx(
        (MODULUS, MODULUS * np.exp(-half), MODULUS * np.exp(half)), rel=1e-5
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: estimate_restitution([1, 1, 1], [0.2, 0.3, 1.2]),
            "row 3: rebound = 1.2 of drop = 1: allowed: above 0, at most the drop",
        ),
        (lambda: estimate_restitution([1, 1], [0.2, 0.3]), "2 rebounds: allowed: at least 3"),
        (
            lambda: estimate_friction([20, 21, 95]),
            "angle = 95: allowed: degrees, above 0 and below 80",
        ),
        (
            lambda: estimate_modulus([([3, 2, 1], [1, 2, 3])], 0.01, "walton-braun"),
            "piece 1: the force does not rise with the way",
        ),
        (
            lambda: estimate_modulus([([1, 2], [1, 2])], 0.01, "walton-braun"),
            "piece 1: 2 forces at 2 ways: allowed: at least 3",
        ),
        (lambda: estimate_modulus([], 0.01, "hooke"), "law = 'hooke': allowed: walton-braun"),
        (lambda: estimate_modulus([], -1.0, "walton-braun"), "size = -1: allowed: a length"),
    ],
)
def test_measurements_that_cannot_be_are_one_line(call, message):
    with pytest.raises(SceneError, match=message):
        call()


def test_the_commands_write_into_a_product_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["products", "hazelnut"]) == 0
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    (tmp_path / "heights.csv").write_text("drop;rebound\n250;40\n250;36\n250;44\n")
    assert main(["measure", "restitution", "heights.csv", "--into", "mine.toml"]) == 0
    assert main(["measure", "friction", "18", "17", "19.5", "--into", "mine.toml"]) == 0
    way = np.linspace(0.2, 1.0, 5)  # mm
    lines = [
        f"{1e3 * k * force / 9.80665:.6f},{w:.6f},{k}"
        for k in (1, 2)
        for w, force in zip(way, 128 * way, strict=True)
    ]
    (tmp_path / "press.csv").write_text("\n".join(["force_g,way_mm,piece", *lines]))
    assert (
        main(["measure", "modulus", "press.csv", "--product", "hazelnut", "--into", "mine.toml"])
        == 0
    )
    printed = capsys.readouterr().out
    assert 'source = "own measurement"' in printed and "[evidence.youngs_modulus]" in printed
    softened = "numerical_softening = 0.1 of mine.toml multiplies the modulus: pieces have E NSF = 2.83e+06 Pa"
    assert softened in printed
    scene = load_scene("weigh-bucket", {"product": "mine.toml"})
    assert scene.material.restitution == 0.4 and scene.material.friction_wall == pytest.approx(
        0.328, abs=1e-3
    )
    assert scene.material.youngs_modulus == pytest.approx(2e7 * np.sqrt(2), rel=1e-3), (
        "128 N/mm of way is E L / 2 of 12.8 mm"
    )
    rows = read_evidence(load_product("mine.toml", "test"), "mine.toml")
    assert rows["restitution"].grade == "A" and rows["restitution"].address == "heights.csv"
    assert rows["density"].source.startswith("Milani"), "the rest is as it was"
    ranges = {row.key: row.range for row in scene.uncertain}
    assert (
        ranges["material.restitution"] == rows["restitution"].range
        and ranges["material.restitution"][0] < 0.4
    )
    assert scene.material.youngs_modulus_range == rows["youngs_modulus"].range


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (
            "drop,rise\n1,0.2\n",
            ["restitution"],
            "heights.csv: column 'rise': allowed: drop, rebound",
        ),
        ("drop,rebound\n1,a\n1,0.2\n", ["restitution"], "row 1: rebound = 'a': allowed: a number"),
        ("drop,rebound\n1\n", ["restitution"], "heights.csv: row 1: 1 cells; allowed: 2"),
        (
            "force_N\n1\n",
            ["modulus", "--size", "0.01"],
            "no column of way_m, way_mm, way_um: allowed: exactly one",
        ),
        (
            "force_N,way_m\n1,1\n",
            ["modulus"],
            "--size, --product: exactly one of the two must be given",
        ),
    ],
)
def test_bad_files_are_one_line(tmp_path, monkeypatch, capsys, text, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "heights.csv").write_text(text)
    kind, *others = arguments
    assert main(["measure", kind, "heights.csv", *others]) == 2
    assert message in capsys.readouterr().err
