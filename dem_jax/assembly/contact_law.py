"""The contact law of a scene and the materials that it acts between, in numpy and double
precision.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from dem_jax.contact_laws import ContactLaw
from dem_jax.contact_laws.cohesion import Cohesive
from dem_jax.contact_laws.densifying import Densifying
from dem_jax.contact_laws.elastic_plastic import ElasticPlastic
from dem_jax.contact_laws.hertz_mindlin import HertzMindlin
from dem_jax.contact_laws.linear_dashpot import LinearDashpot
from dem_jax.contact_laws.rolling_friction import Rolling
from dem_jax.contact_laws.walton_braun import WaltonBraun
from dem_jax.scene import Scene
from dem_jax.scene.array_namespace import as_float_array, is_traced, is_zero
from dem_jax.scene.material_properties import MaterialTable, build_material_table
from dem_jax.types import PAIR_PROPERTIES, Array, Materials, as_array


def build_contact_law(scene: Scene, materials: Materials | None = None) -> ContactLaw:
    """The contact law of a scene, extended by cohesion if a pair of materials has a pull-off force
    and by rolling friction if a pair has rolling friction. materials: of the scene, if already
    known.
    """
    law, materials = LAWS[scene.contact.law](scene), materials or build_materials(scene)
    if materials.pull_off is not None:
        cohesion = scene.contact.cohesion
        law = Cohesive(
            law, _host_number(cohesion.stiffness), _host_number(cohesion.interaction_range)
        )
    return law if materials.rolling is None else Rolling(law)


def extend_to_class(
    scene: Scene, law: ContactLaw, materials: Materials, has_hulls: bool
) -> tuple[ContactLaw, Materials]:
    """The law and the materials of a scene in the form of its size class: a table of all pairs of
    materials, and for polytopes, whose geometry takes most of a step, the law of Walton and Braun
    with cohesion and rolling friction, which are without effect where they are 0.
    """
    count = len(materials.is_wall)
    full = {
        name: np.broadcast_to(values, (count, count))
        for name in PAIR_PROPERTIES
        if (values := getattr(materials, name)) is not None
    }
    extended = has_hulls and scene.contact.law == "walton-braun" and "friction" in full
    if extended:
        own = law.law if isinstance(law, Rolling) else law
        if not isinstance(own, Cohesive):
            cohesion = scene.contact.cohesion
            own = Cohesive(
                own, _host_number(cohesion.stiffness), _host_number(cohesion.interaction_range)
            )
        law = Rolling(own)
        none = np.zeros((count, count))
        full = {"pull_off": none, "rolling": none} | full
    return law, materials.replace(**full)


def _build_walton_braun(scene: Scene) -> ContactLaw:
    m = scene.material
    damping = None if is_zero(m.unloading_damping) else _host_number(m.unloading_damping)
    at_rest = None if is_zero(m.rest_damping) else _host_number(m.rest_damping)
    return WaltonBraun(
        _host_number(m.separation_slope_ratio),
        _host_number(m.tangential_stiffness_ratio),
        damping,
        at_rest,
    )


def _host_number(value: float) -> Array:
    return as_array(as_float_array(value))


LAWS: dict[str, Callable[[Scene], ContactLaw]] = {
    "walton-braun": _build_walton_braun,
    "linear-dashpot": lambda scene: LinearDashpot(
        _host_number(scene.material.tangential_stiffness_ratio)
    ),
    "hertz-mindlin": lambda scene: HertzMindlin(_host_number(scene.contact.max_impact_speed)),
    "densifying": lambda scene: Densifying(
        _host_number(scene.contact.densification),
        _host_number(scene.material.tangential_stiffness_ratio),
        _host_number(scene.contact.max_impact_speed),
    ),
    "elastic-plastic": lambda scene: ElasticPlastic(
        _host_number(scene.contact.yield_pressure),
        _host_number(scene.material.tangential_stiffness_ratio),
        _host_number(scene.contact.max_impact_speed),
    ),
}


def build_materials(
    scene: Scene, table: MaterialTable | None = None, form: Materials | None = None
) -> Materials:
    """The materials of a scene as arrays.

    Args:
        scene: its values may be traced.
        table: materials of the scene, if already known.
        form: selects the pair properties to include and whether each is stored as one number; by
            default those that are not 0, and one number where all pairs have the same value.

    Raises:
        SceneError: a material is not defined.
    """
    table = table or build_material_table(scene)
    pairs: dict[str, Any] = {name: _pairs(table, name, form) for name in PAIR_PROPERTIES}
    return Materials(
        youngs_modulus=as_array(scene.material.numerical_softening * table.youngs_modulus),
        poisson_ratio=as_array(table.poisson_ratio),
        is_wall=tuple(table.is_wall.tolist()),
        **pairs,
    )


def _pairs(table: MaterialTable, name: str, form: Materials | None) -> Array | None:
    """A property of pairs of materials; [1, 1] if all pairs have the same value. Entries of two
    walls are ignored, as walls never touch.
    """
    values = getattr(table, name)
    if form is None:
        touching = ~(table.is_wall[:, None] & table.is_wall)
        is_absent = not is_traced(values) and not values[touching].any()
        is_uniform = name in table.uniform
    else:
        is_absent = getattr(form, name) is None
        is_uniform = not is_absent and getattr(form, name).shape == (1, 1)
    return None if is_absent else as_array(values[:1, :1] if is_uniform else values)
