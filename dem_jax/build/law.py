"""The contact law of a scene, and the materials that it acts between. In numpy, double precision."""

from collections.abc import Callable

import numpy as np

from dem_jax.contact.law import ContactLaw
from dem_jax.contact.law.cohesion import Cohesive
from dem_jax.contact.law.densifying import Densifying
from dem_jax.contact.law.elastic_plastic import ElasticPlastic
from dem_jax.contact.law.hertz_mindlin import HertzMindlin
from dem_jax.contact.law.linear_dashpot import LinearDashpot
from dem_jax.contact.law.rolling import Rolling
from dem_jax.contact.law.walton_braun import WaltonBraun
from dem_jax.scene import Scene
from dem_jax.scene.materials import MaterialTable, material_table
from dem_jax.scene.numbers import array, is_traced, is_zero
from dem_jax.types import Array, Materials, host


def law_of(scene: Scene, materials: Materials | None = None) -> ContactLaw:
    """The law that a scene asks for, cohesive where any pair of its materials has a pull-off force, and with rolling friction
    where any has that. materials: of the scene, if they are known already."""
    law, materials = LAWS[scene.contact.law](scene), materials or materials_of(scene)
    if materials.pull_off is not None:
        cohesion = scene.contact.cohesion
        law = Cohesive(law, _number(cohesion.stiffness), _number(cohesion.range))
    return law if materials.rolling is None else Rolling(law)


def _walton_braun(scene: Scene) -> ContactLaw:
    m = scene.material
    damping = None if is_zero(m.unloading_damping) else _number(m.unloading_damping)
    at_rest = None if is_zero(m.rest_damping) else _number(m.rest_damping)
    return WaltonBraun(_number(m.separation), _number(m.tangential_stiffness), damping, at_rest)


def _number(value: float) -> Array:
    return host(array(value))


LAWS: dict[str, Callable[[Scene], ContactLaw]] = {
    "walton-braun": _walton_braun,
    "linear-dashpot": lambda scene: LinearDashpot(_number(scene.material.tangential_stiffness)),
    "hertz-mindlin": lambda scene: HertzMindlin(_number(scene.contact.impact_speed)),
    "densifying": lambda scene: Densifying(
        _number(scene.contact.densification), _number(scene.material.tangential_stiffness), _number(scene.contact.impact_speed)
    ),
    "elastic-plastic": lambda scene: ElasticPlastic(
        _number(scene.contact.yield_pressure), _number(scene.material.tangential_stiffness), _number(scene.contact.impact_speed)
    ),
}


def materials_of(scene: Scene, table: MaterialTable | None = None) -> Materials:
    """The materials as arrays. table: of the scene, if it is known already. Raises SceneError."""
    table = table or material_table(scene)
    return Materials(
        youngs_modulus=host(scene.material.softening * table.youngs_modulus),
        poisson_ratio=host(table.poisson_ratio),
        restitution=_in_short(table, table.restitution),
        friction=_if_any(table, table.friction),
        pull_off=_if_any(table, table.pull_off),
        rolling=_if_any(table, table.rolling),
        is_wall=tuple(table.is_wall.tolist()),
    )


def _in_short(table: MaterialTable, pairs: np.ndarray) -> Array:
    """A table of pairs; [1, 1] if all have the same. Two walls never touch: what stands between them is left alone."""
    met = ~(table.is_wall[:, None] & table.is_wall)
    return host(pairs[:1, :1] if not is_traced(pairs) and (pairs[met] == pairs[0, 0]).all() else pairs)


def _if_any(table: MaterialTable, pairs: np.ndarray) -> Array | None:
    met = ~(table.is_wall[:, None] & table.is_wall)
    return _in_short(table, pairs) if is_traced(pairs) or pairs[met].any() else None
