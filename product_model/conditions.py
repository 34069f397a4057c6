"""The conditions of a drop from a product of the library or a scene. The one module of
product_model that uses dem_jax.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from product_model.errors import BadInput
from product_model.transfer import DropConditions

if TYPE_CHECKING:
    from dem_jax.scene import Scene

BASE_SCENE = "weigh-bucket"
LAW = "walton-braun"  # contact law that the table of transfer was learnt with


def product_conditions(
    product: str,
    target: float | None = None,
    pieces: int | None = None,
    settings: Mapping[str, Any] | None = None,
) -> tuple[DropConditions, list[str]]:
    """The conditions of a portion of a product in the stock scene, and the effects they neglect, in
    words.

    Args:
        product: name of the library, or TOML file of a product.
        target: (kg) weight of the portion. Default: the scene's.
        pieces: number of pieces, instead of that.
        settings: changed keys of the scene.

    Raises:
        BadInput: one line.
    """
    from dem_jax.errors import SceneError
    from dem_jax.scene import load_scene

    changes: dict[str, Any] = {"product": product}
    if target is not None:
        if not (np.isfinite(target) and target > 0):
            raise BadInput(f"target = {target:g}: must be greater than 0 (kg)")
        changes["portion.target_weight"] = target
    if pieces is not None:
        if pieces < 1:
            raise BadInput(f"pieces = {pieces}: must be at least 1")
        changes["portion.count"] = pieces
    if product.endswith(".toml") and not Path(product).is_file():
        raise BadInput(f"product = {product}: no such file")
    try:
        return scene_conditions(load_scene(BASE_SCENE, changes | dict(settings or {})))
    except SceneError as error:
        raise BadInput(" ".join(str(error).split())) from None


def scene_conditions(scene: "Scene") -> tuple[DropConditions, list[str]]:
    """The conditions for a scene in which a portion falls from a feed bucket, and the neglected
    effects. Raises SceneError."""
    from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
    from dem_jax.scene.material_properties import build_material_table, find_piece_rows

    goods, table = build_piece_set(scene), build_material_table(scene)
    masses = compute_masses(goods, table)
    rows = find_piece_rows(table, goods.materials)
    wall = np.flatnonzero(table.is_wall)[0]
    volumes = np.array([shape.volume for shape in goods.shapes])
    around = np.array([2.0 * shape.bounding_radius for shape in goods.shapes])
    share = masses / masses.sum()
    mean = lambda values: float(share @ np.asarray(values, float))
    assert scene.feed_bucket is not None
    drop = DropConditions(
        m_piece=float(masses.mean()),
        pieces=len(masses),
        density=float(masses.sum() / volumes.sum()),
        modulus=mean(np.asarray(table.youngs_modulus)[rows]) * scene.material.numerical_softening,
        restitution=mean(np.asarray(table.restitution)[rows, wall]),
        friction_wall=mean(np.asarray(table.friction)[rows, wall]),
        friction_piece=mean(np.diag(np.asarray(table.friction))[rows]),
        elongation=mean(around / (6.0 * volumes / np.pi) ** (1.0 / 3.0)),
        drop_height=scene.drop.height,
        opening_time=scene.feed_bucket.opening_time,
        gravity=float(np.linalg.norm(scene.run.gravity)),
    )
    return drop, _left_out(scene, rows)


def _left_out(scene: "Scene", rows: np.ndarray) -> list[str]:
    """The effects in a scene that its conditions neglect, in words. rows: [pieces] numbers of their
    materials."""
    said = []
    if scene.contact.law != LAW:
        said.append(f"contact.law = {scene.contact.law}: learnt with {LAW}")
    if len(set(rows.tolist())) > 1:
        said.append("pieces of several materials: their means are used")
    if any(
        value > 0 for value in _numbers(scene.material.pull_off, scene.material.rolling_friction)
    ):
        said.append("stickiness and rolling friction are not among the conditions")
    return said


def _numbers(*values: Any) -> list[float]:
    return [float(value) for value in values if value is not None]
