"""Portions of several products: exact counts, masses and sizes, mixed by the seed; the feeder;
mistakes.
"""

import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.assembly import portion_counts
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.errors import SceneError
from dem_jax.scene import describe_scene, load_scene, parse_scene

BALL = 4 / 3 * np.pi * 0.01**3  # m3
SCENE = """
base = "weigh-bucket"

[material]
density = 1000.0
[material.gummy]
density = 1300.0

[portion]
target_weight = 0.2
share_by = "weight"
[[portion.product]]
shape = "sphere"
radius = 0.01
share = 3
[[portion.product]]
shape = "cuboid"
size = [0.02, 0.02, 0.01]
material = "gummy"
share = 1
[[portion.product]]
shape = "sphere"
radius = 0.01
material = "gummy"
share = 2

[run]
precision = "f64"
"""


def mix(mass, share=None, spread=None, by="weight"):
    k = len(mass)
    of = lambda values, default: np.array([default] * k if values is None else values, float)
    return portion_counts.ProductMix(np.array(mass, float), of(share, 1.0), of(spread, 0.0), by)


def masses(scene):
    """(kg) of each piece, and the numbers of pieces by (kind of shape, material)."""
    goods = build_piece_set(scene)
    density = {None: 1000.0, "gummy": 1300.0}
    mass = np.array(
        [s.volume * density[m] for s, m in zip(goods.shapes, goods.materials, strict=True)]
    )
    kinds = [(shape.name, name) for shape, name in zip(goods.shapes, goods.materials, strict=True)]
    return mass, {kind: kinds.count(kind) for kind in kinds}


@pytest.mark.parametrize(
    ("mass", "share", "by", "target", "expected"),
    [
        ([1.0], None, "weight", 10.4, (10,)),
        ([1.0], None, "weight", 0.2, (1,)),  # at least one
        ([1.0, 2.0], (1, 1), "weight", 12.0, (6, 3)),
        ([1.0, 2.0], (1, 1), "count", 12.0, (4, 4)),
        ([1.0, 2.0], (3, 1), "count", 10.0, (6, 2)),
        ([1.0, 2.0], (3, 1), "weight", 16.0, (12, 2)),
        ([1.0, 3.0], (1, 1), "weight", 7.2, (4, 1)),  # 3.6 and 1.2: 3 + 3 = 6, 4 + 3 = 7, 3 + 6 =
        # 9, 4 + 6 = 10
        ([1.0, 3.0], (1, 1), "weight", 9.2, (4, 2)),  # 4.6 and 1.53: 4 + 3 = 7, 5 + 3 = 8, 4 + 6 =
        # 10, 5 + 6 = 11
    ],
)
def test_numbers_of_a_weight(mass, share, by, target, expected):
    assert portion_counts.apportion_weight(mix(mass, share, by=by), target) == expected


def test_the_total_is_the_nearest_of_all_ways_to_round():
    """Against every way, for random products; each number within one of the exact one."""
    random = np.random.default_rng(0)
    for _ in range(200):
        k = random.integers(1, 5)
        mass, share, by = (
            random.uniform(1, 3, k),
            random.uniform(0.5, 2, k),
            random.choice(["weight", "count"]),
        )
        target = random.uniform(10, 60)
        part = share / share.sum()
        exact = target * part / mass if by == "weight" else target * part / (part @ mass)
        found = np.array(portion_counts.apportion_weight(mix(mass, share, by=by), target))
        assert (np.abs(found - exact) < 1).all()
        ways = np.floor(exact) + np.array(np.meshgrid(*[[0, 1]] * k)).reshape(k, -1).T
        assert abs(found @ mass - target) == pytest.approx(
            np.abs(ways @ mass - target).min(), abs=1e-9
        )


def test_of_equally_near_ways_the_larger_remainder_is_rounded_up():
    assert portion_counts.apportion_weight(mix([1.0, 1.0], (2.2, 3.7)), 5.9) == (2, 4)
    assert portion_counts.apportion_weight(mix([1.0, 1.0], (3.7, 2.2)), 5.9) == (4, 2)


@pytest.mark.parametrize(
    ("share", "by", "count", "expected"),
    [
        ((1, 1), "count", 10, (5, 5)),
        ((1, 2), "count", 10, (3, 7)),
        ((1, 1), "weight", 9, (6, 3)),  # of twice the mass half as many
        ((0.2, 0.3, 0.5), "count", 7, (1, 2, 4)),  # 1.4, 2.1, 3.5
        ((1, 1, 1), "count", 2, (1, 1, 0)),
    ],
)
def test_numbers_of_a_count(share, by, count, expected):
    assert (
        portion_counts.apportion_count(mix([1.0, 2.0, 1.0][: len(share)], share, by=by), count)
        == expected
    )


@pytest.mark.parametrize("spread", [0.01, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("number", [2, 3, 9, 16, 17, 100, 5000])
def test_sizes_have_exactly_the_mean_and_the_spread(number, spread):
    found = portion_counts.distribute_sizes(number, spread)
    assert found.shape == (number,) and (np.diff(found) >= 0).all() and found[0] > 0
    assert found.mean() == pytest.approx(1, rel=1e-12) and found.std() == pytest.approx(
        spread, rel=1e-12
    )
    assert number == len(np.unique(found)) or number > 16 >= len(np.unique(found)) >= 12


def test_sizes_are_lognormal():
    """Cumulative shares of 5000 pieces in 16 classes against the distribution's, and its tails cut
    at 3 sigma.
    """
    from scipy.stats import lognorm

    sigma = np.sqrt(np.log1p(0.3**2))
    found = portion_counts.distribute_sizes(5000, 0.3)
    of = lognorm(sigma, scale=np.exp(-(sigma**2) / 2))
    middle = 0.5 * (np.unique(found)[1:] + np.unique(found)[:-1])
    # a class is 6/16 sigma wide and its border anywhere in it: 0.4 * 3/16 at most
    assert max(abs((found < x).mean() - of.cdf(x)) for x in middle) < 0.4 * 3 / 16 / 2
    assert of.mean() == pytest.approx(1) and of.std() == pytest.approx(0.3)
    assert np.log(found[-1]) == pytest.approx(3 * sigma - sigma**2 / 2, abs=6 / 16 * sigma)


def test_one_piece_or_no_spread_is_the_nominal_size():
    np.testing.assert_array_equal(portion_counts.distribute_sizes(1, 0.4), 1.0)
    np.testing.assert_array_equal(portion_counts.distribute_sizes(7, 0.0), 1.0)


def test_the_weight_counts_the_pieces_as_large_as_they_are():
    """Of products whose sizes spread the total of the pieces that are made is within half of one
    piece.
    """
    for spread in (0.1, 0.5):
        goods = mix([1.0], spread=[spread])
        for target in (5.0, 50.0, 700.0):
            (number,) = portion_counts.apportion_weight(goods, target)
            total = np.sum(portion_counts.distribute_sizes(number, spread) ** 3)
            others = [
                np.sum(portion_counts.distribute_sizes(n, spread) ** 3)
                for n in (number - 1, number + 1)
            ]
            assert abs(total - target) <= min(abs(other - target) for other in others) + 1e-9


def test_a_portion_of_three_products_has_its_weight_by_shares():
    scene = parse_scene(SCENE)
    mass, numbers = masses(scene)
    exact = {
        ("sphere", None): 0.1 / (1000 * BALL),
        ("cuboid", "gummy"): 0.2 / 6 / (1300 * 4e-6),
        ("sphere", "gummy"): 0.4 / 6 / (1300 * BALL),
    }
    assert numbers.keys() == exact.keys()
    assert all(abs(numbers[kind] - exact[kind]) < 1 for kind in exact)
    assert abs(mass.sum() - 0.2) < 0.5 * mass.min()
    built = assembly.assemble_system(scene)
    np.testing.assert_allclose(built.system.pieces.mass, mass, rtol=1e-12)
    assert built.system.alike == ("hulls",), "spheres are of two materials"
    assert parse_scene(scene.to_toml()) == scene == parse_scene(describe_scene(scene))


def test_one_product_is_the_portion_without_products():
    plain = load_scene("weigh-bucket")
    product = plain.replace(portion={"product": [{}]})
    assert len(build_piece_set(product).shapes) == len(build_piece_set(plain).shapes) == 9
    assert build_piece_set(product).numbers == build_piece_set(plain).numbers == (9,)


def test_products_are_mixed_by_the_seed_and_keep_their_sizes():
    """Ensembles build once: a seed moves pieces and changes none. Each product is found low and
    high in the grid.
    """
    scene = parse_scene(SCENE).replace(
        {"portion.target_weight": 1.0, "portion.product.0.size_spread": 0.2}
    )
    built, other = assembly.assemble_system(scene, 1), assembly.assemble_system(scene, 2)
    for name in ("mass", "inertia", "bounding_radius", "size", "material"):
        np.testing.assert_array_equal(
            getattr(built.system.pieces, name), getattr(other.system.pieces, name)
        )
    moved = assembly.build_seeded_state(scene, built, 2)
    np.testing.assert_array_equal(moved.position, other.state.position)
    assert np.abs(np.asarray(moved.position - built.state.position)).max() > 0.01
    goods = build_piece_set(scene)
    first = np.array([n is None for n in goods.materials])
    radii = np.array([s.radius for s in goods.shapes])[first]
    assert radii.mean() == pytest.approx(0.01, rel=1e-12) and radii.std() == pytest.approx(
        0.002, rel=1e-9
    )
    assert len(np.unique(radii)) == 16
    heights = np.array(
        [
            np.asarray(assembly.build_seeded_state(scene, built, seed).position[2])
            for seed in range(20)
        ]
    )
    low = heights < np.median(heights)
    # the lower half of all pieces has its part of each product: 5 standard errors of 20 draws
    # without replacement
    error = 5 * 0.5 / np.sqrt(20 * first.sum())
    assert abs(low[:, first].mean() - 0.5) < error
    large = np.flatnonzero(first)[first.sum() // 2 :]
    assert abs(low[:, large].mean() - 0.5) < 1.5 * error


def test_scattered_pieces_of_all_sizes_never_overlap():
    scene = parse_scene(SCENE).replace({"portion.product.0.size_spread": 0.3})
    built = assembly.assemble_system(scene, 3)
    place, radius = (
        np.asarray(built.state.position).T,
        np.asarray(built.system.pieces.bounding_radius),
    )
    gap = np.linalg.norm(place[:, None] - place[None], axis=-1) - radius[:, None] - radius
    assert gap[np.triu_indices(len(place), 1)].min() > 0


@pytest.mark.parametrize(("count", "expected"), [(None, (4, 8)), (3, (1, 2))])
def test_the_feeder_has_the_products_of_the_portion(count, expected):
    products = [
        {"share": 1.0, "scale_factor": 0.5},
        {"share": 2.0, "shape": "sphere", "radius": 0.008, "size_spread": 0.1},
    ]
    station = load_scene("weighing-station").replace(
        portion={"product": products, "count": 12, "share_by": "count"}, feeder={"count": count}
    )
    goods = build_piece_set(station)
    assert goods.numbers == (12, sum(expected))
    names = [shape.name for shape in goods.shapes]
    assert names[:12] == ["chamfered-cuboid"] * 4 + ["sphere"] * 8
    assert names[12:] == ["chamfered-cuboid"] * expected[0] + ["sphere"] * expected[1]
    built = assembly.assemble_system(station)
    x = np.asarray(built.state.position[0])
    assert x[12:].max() < x[:12].min(), "those of the feeder lie on it"


def test_a_hull_of_an_stl_among_the_products_goes_with_the_scene(tmp_path):
    import trimesh

    trimesh.creation.box((20, 10, 10)).export(tmp_path / "box.stl")
    (tmp_path / "mine.toml").write_text(
        'base = "weigh-bucket"\n[portion]\n[[portion.product]]\nshape = "hull"\nstl = "box.stl"\nunit = 1e-3\n[[portion.product]]\n'
    )
    scene = load_scene(tmp_path / "mine.toml")
    alone = parse_scene(assembly.inline_files(scene).to_toml())
    assert (
        alone.portion.product[0].stl is None
        and alone.portion.product[1] == scene.portion.product[1]
    )
    assert build_piece_set(alone).shapes[0].volume == pytest.approx(2e-6, rel=1e-6)
    assert build_piece_set(alone).numbers == build_piece_set(scene).numbers


def test_walls_of_an_stl_keep_their_material(tmp_path):
    import trimesh

    trimesh.creation.box((1, 1, 0.1)).export(tmp_path / "table.stl")
    scene = load_scene("plate-drop").replace(
        wall=[{"group": "table", "stl": str(tmp_path / "table.stl"), "material": "steel"}],
        material={"steel": {}},
    )
    assert {wall.material for wall in assembly.inline_files(scene).wall} == {"steel"}


@pytest.mark.long
def test_an_ensemble_of_a_mixed_portion_is_its_seeds_one_by_one():
    """To the last bit; and the momentum of every interval closes with the masses that the materials
    say.
    """
    balls = [
        {"shape": "sphere", "radius": 0.01, "size_spread": 0.2},
        {"shape": "sphere", "radius": 0.01, "material": "gummy"},
    ]
    changes = {
        "portion.product": balls,
        "portion.target_weight": 0.04,
        "portion.arrangement": "scattered",
    }
    scene = parse_scene(SCENE).replace(
        changes
        | {"run.duration": 0.1, "run.sample_interval": 1e-3, "feed_bucket.opening_start": 1.0}
    )
    runs = dem_jax.ensemble(scene, runs=2, seed=3)
    alone = dem_jax.simulate(scene, seed=4)
    np.testing.assert_array_equal(runs.member(1).force["fb_flaps"], alone.force["fb_flaps"])
    assert np.abs(runs.member(0).force["fb_flaps"] - alone.force["fb_flaps"]).max() > 0.01
    mass, _ = masses(scene)
    # what gravity gives in each interval is what the pieces have and what the bucket takes
    taken = sum(force[1:] for force in alone.mean_force.values()) * 1e-3
    given = np.tile(mass.sum() * np.array([0.0, 0.0, -9.81e-3]), (len(taken), 1))
    np.testing.assert_allclose(
        np.diff(alone.momentum, axis=0) + taken,
        given,
        rtol=0,
        atol=1e-9 * np.abs(alone.momentum).max(),
    )
    assert np.abs(taken).max() > np.abs(given).max(), "some land"


MISTAKES = [  # changes of the scene -> what the line must hold
    ({"portion.product.0.share": 0}, r"portion\.product\.0\.share = 0: allowed: a number > 0"),
    (
        {"portion.product.0.size_spread": 0.6},
        r"portion\.product\.0\.size_spread = 0\.6: allowed: a number >= 0 and <= 0\.5",
    ),
    (
        {"portion.product.0.radius": None},
        r"portion\.product\.0\.radius: missing; shape 'sphere' needs it",
    ),
    (
        {"portion.product.1.radius": 0.1},
        r"portion\.product\.1\.radius = 0\.1: not a key of shape 'cuboid'",
    ),
    (
        {"portion.product.1.material": "gum"},
        r"portion\.product\.1\.material = \"gum\": no such material; .*allowed: gummy",
    ),
    (
        {"portion.product.3.share": 1},
        r"product\.3\.share = 1: product is a list; allowed: product\.0\.KEY to product\.2\.KEY",
    ),
    (
        {"portion.product.0.position": 1},
        r"portion\.product\.0\.position = 1: unknown key; allowed: shape, scale_factor",
    ),
    ({"portion.product": 1}, r"portion\.product = 1: allowed: tables \[\[portion\.product\]\]"),
    ({"portion.share_by": "mass"}, r'portion\.share_by = "mass": allowed: "weight" or "count"'),
    (
        {"portion.scale_factor": 0.5},
        r"portion: scale_factor = 0\.5: beside products; allowed: in each \[\[portion\.product\]\]",
    ),
    ({"portion.material": "gummy"}, r'portion: material = "gummy": beside products'),
    ({"portion.size_spread": 0.1}, r"portion: size_spread = 0\.1: beside products"),
    ({"portion.product": [{}] * 17}, r"portion: 17 products; allowed: at most 16"),
]


@pytest.mark.parametrize(("changes", "expected"), MISTAKES)
def test_a_mistake_is_one_clear_line(changes, expected):
    with pytest.raises(SceneError, match=expected) as error:
        assembly.assemble_system(parse_scene(SCENE).replace(changes))
    assert "\n" not in str(error.value)
