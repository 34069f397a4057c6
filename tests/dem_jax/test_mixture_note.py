"""A note on mixtures of stiff and soft products, which share one softening."""

import re

import numpy as np
import pytest

from dem_jax.assembly.stiffness_check import note_stiff_mixture
from dem_jax.assembly.system import assemble_system
from dem_jax.scene import load_scene


@pytest.fixture
def mixture(tmp_path):
    """A function that loads a scene of 20 g of products of the library."""

    def load(*names):
        rows = [f'[[portion.product]]\nproduct = "{name}"' for name in names]
        path = tmp_path / "mixture.toml"
        path.write_text(
            "\n".join(['base = "weigh-bucket"', "[portion]", "target_weight = 0.02", *rows])
        )
        return load_scene(path)

    return load


def test_a_stiff_product_beside_a_soft_one_is_noted_with_the_modulus_that_avoids_it(mixture):
    """With that modulus the step is longer by the factor that the note says.

    Tolerance: two digits, and 10 % for other contacts that limit the step then.
    """
    scene = mixture("gummy-bear", "chocolate-lentil")
    said = note_stiff_mixture(scene)
    key, value, factor = re.search(r"stiffest; (\S+) = (\S+) takes (\S+) times", said).groups()
    assert key == "material.chocolate-lentil.youngs_modulus"
    softer = scene.replace({key: float(value)})
    before, after = (assemble_system(of, 0).step.stable for of in (scene, softer))
    assert after / before == pytest.approx(float(factor), rel=0.1)
    assert float(factor) == pytest.approx(np.sqrt(3e8 / 5e6), rel=0.05)
    assert note_stiff_mixture(softer) is None


@pytest.mark.parametrize("names", [("hazelnut", "almond"), ("chocolate-lentil",)])
def test_products_of_like_stiffness_have_no_note(mixture, names):
    assert note_stiff_mixture(mixture(*names)) is None
