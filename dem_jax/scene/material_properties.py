"""Materials of a scene as arrays: properties of each, and of each pair."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.scene import bucket_geometry
from dem_jax.scene.array_namespace import as_float_array, is_traced
from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.material import DEFAULT_NAME, WALL_NAME, Material
from dem_jax.scene.wall_surfaces import SURFACES


@dataclass(frozen=True)
class MaterialTable:
    """The M materials that pieces and walls of a scene are of, in float64: first those of pieces,
    then those of walls.

    A name stands twice if pieces and walls are of it, as what it does not set differs (see
    sections.material). Where any name no material, "default" comes first of all, and "wall" first
    of the walls'. What stands between two walls means nothing: they never touch.
    """

    names: tuple[str, ...]
    is_wall: np.ndarray  # [M] bool
    density: np.ndarray  # [M] (kg/m3)
    youngs_modulus: np.ndarray  # [M] (Pa): E_p of pieces, E_b of walls, not softened
    poisson_ratio: np.ndarray  # [M]
    restitution: np.ndarray  # [M, M], symmetric, as the next three: epsilon of eq. 6
    friction: np.ndarray  # [M, M]: mu
    pull_off: np.ndarray  # [M, M] (N): largest adhesive force of a contact
    rolling: np.ndarray  # [M, M]: mu_r
    uniform: frozenset[str]  # names of those of them that are one number for all pairs that can
    # touch


@dataclass(frozen=True)
class _MaterialRow:
    """A material with all that it does not set filled in."""

    name: str
    is_wall: bool
    density: float
    youngs_modulus: float
    poisson_ratio: float
    restitution: float
    friction_piece: float
    friction_wall: float
    rolling_friction: float
    pull_off: float
    wall_surface: str


def build_material_table(scene: Scene) -> MaterialTable:
    """The materials in use, and the pairs by the rules of sections.material.Pair. Raises
    SceneError.
    """
    of_pieces, of_walls = _list_piece_materials(scene), list(map_group_materials(scene).values())
    rows = [_fill_material(scene.material, name, False) for name in _sort_names(of_pieces)]
    rows += [_fill_material(scene.material, name, True) for name in _sort_names(of_walls)]
    each = lambda key: as_float_array([getattr(row, key) for row in rows])
    pairs = {name: _tabulate_pairs(scene, rows, key, rule) for name, (key, rule) in _RULES.items()}
    touching = [
        (i, j)
        for i, a in enumerate(rows)
        for j, b in enumerate(rows)
        if not (a.is_wall and b.is_wall)
    ]
    return MaterialTable(
        names=tuple(row.name for row in rows),
        is_wall=np.array([row.is_wall for row in rows]),
        density=each("density"),
        youngs_modulus=each("youngs_modulus"),
        poisson_ratio=each("poisson_ratio"),
        uniform=frozenset(
            name for name, values in pairs.items() if _are_one([values[i][j] for i, j in touching])
        ),
        **{name: as_float_array(values) for name, values in pairs.items()},
    )


def _tabulate_pairs(
    scene: Scene,
    rows: Sequence[_MaterialRow],
    key: str,
    rule: Callable[[_MaterialRow, _MaterialRow], float],
) -> list[list[float]]:
    """A property of each pair of materials: as listed, else by its rule."""
    listed = {frozenset(pair.of): getattr(pair, key) for pair in scene.pair}
    said = [[listed.get(frozenset((a.name, b.name))) for b in rows] for a in rows]
    return [
        [rule(a, b) if s is None else s for b, s in zip(rows, line, strict=True)]
        for a, line in zip(rows, said, strict=True)
    ]


def _are_one(values: Sequence[Any]) -> bool:
    """Whether values are the same number: of those that may stand for any, whether they are one
    object.
    """
    first = values[0]
    return all(
        value is first or not is_traced((value, first)) and value == first for value in values
    )


def find_piece_rows(table: MaterialTable, names: Sequence[str | None]) -> np.ndarray:
    """Rows [N] int of the table, of pieces with these materials' names (None: [material])."""
    row = {name: k for k, name in enumerate(table.names) if not table.is_wall[k]}
    return np.array([row[name or DEFAULT_NAME] for name in names], int)


def find_group_rows(table: MaterialTable, scene: Scene, groups: Sequence[str]) -> np.ndarray:
    """Rows [G] int of the table, of wall groups (types.Walls.groups); those of panels are these at
    Walls.group.
    """
    row = {name: k for k, name in enumerate(table.names) if table.is_wall[k]}
    of_group = map_group_materials(scene)
    return np.array([row[of_group[group] or WALL_NAME] for group in groups], int)


def map_group_materials(scene: Scene) -> dict[str, str | None]:
    """Wall group -> name of its material, None: [material]. Raises SceneError where a group has
    two.
    """
    owners = [(f"wall.{n}", wall.group, wall.material) for n, wall in enumerate(scene.wall)]
    for key, short in bucket_geometry.GROUP_PREFIXES.items():
        bucket = getattr(scene, key)
        if bucket:
            owners += [
                (key, group, bucket.material)
                for group in bucket_geometry.list_wall_groups(bucket, short)
            ]
    if scene.feeder:
        owners.append(("feeder", bucket_geometry.FEEDER_GROUP, scene.feeder.material))
    found: dict[str, str | None] = {}
    for key, group, name in owners:
        if found.setdefault(group, name) != name:
            raise SceneError(
                f"{key}.material = {name or 'unset'}: wall group {group!r} has {found[group] or 'none'}; "
                "allowed: one material for all of a group"
            )
    return found


def find_modulus_range(scene: Scene, name: str | None) -> tuple[float, float] | None:
    """Within which (Pa) the modulus of a material of pieces is known, as the scene says it; name:
    None of [material] itself.
    """
    own = scene.material.named_materials.get(name or "")
    if own is not None and (own.youngs_modulus_range is not None or own.youngs_modulus is not None):
        return own.youngs_modulus_range
    return scene.material.youngs_modulus_range


def keep_modulus_ranges(scene: Scene, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of keys of a scene, with the ranges of the moduli among them: those of the product, which
    replacing a modulus alone would drop.
    """
    kept = dict(values)
    for key in values:
        section, *name, last = key.split(".")
        known = (
            find_modulus_range(scene, name[0] if name else None)
            if (section, last) == ("material", "youngs_modulus")
            else None
        )
        kept |= {f"{key}_range": known} if known else {}
    return kept


def _list_piece_materials(scene: Scene) -> list[str | None]:
    if scene.piece:
        return [row.material for row in scene.piece]
    assert scene.portion is not None  # as a Scene makes sure
    return [row.material for row in scene.portion.product_rows]


def _sort_names(names: Sequence[str | None]) -> list[str | None]:
    """Each name once, None first."""
    return sorted(dict.fromkeys(names), key=lambda name: name is not None)


_OWN_KEYS = [f.name for f in fields(_MaterialRow) if f.name not in ("name", "is_wall")]
_WALL_KEYS = {"youngs_modulus": "wall_youngs_modulus", "poisson_ratio": "wall_poisson_ratio"}


def _fill_material(base: Material, name: str | None, is_wall: bool) -> _MaterialRow:
    """The material with the name, None: [material] itself, as pieces or as walls have it."""
    own = None if name is None else base.named_materials[name]

    def inherit_value(key: str, inherited: str | None = None) -> Any:
        value = None if own is None else getattr(own, key)
        return getattr(base, inherited or key) if value is None else value

    return _MaterialRow(
        name=name or (WALL_NAME if is_wall else DEFAULT_NAME),
        is_wall=is_wall,
        **{key: inherit_value(key, _WALL_KEYS.get(key) if is_wall else None) for key in _OWN_KEYS},
    )


def _make_pair_rule(
    between_pieces: str, on_wall: str, by_surface: str | None = None
) -> Callable[[_MaterialRow, _MaterialRow], float]:
    """Properties of two materials that are not listed as a pair; by_surface: the factor of a wall's
    surface on them.
    """

    def combine_materials(a: _MaterialRow, b: _MaterialRow) -> float:
        if a.is_wall != b.is_wall:
            piece, wall = (b, a) if a.is_wall else (a, b)
            own = getattr(piece, on_wall)
            factor = getattr(SURFACES[wall.wall_surface], by_surface) if by_surface else 1.0
            return own if factor == 1.0 else own * factor
        one, other = getattr(a, between_pieces), getattr(b, between_pieces)
        return one if one is other else 0.5 * (one + other)

    return combine_materials


_RULES = {  # property of pairs -> key of [[pair]], and the rule for pairs that are not listed
    "restitution": ("restitution", _make_pair_rule("restitution", "restitution")),
    "friction": ("friction", _make_pair_rule("friction_piece", "friction_wall", "friction")),
    "pull_off": ("pull_off", _make_pair_rule("pull_off", "pull_off", "pull_off")),
    "rolling": ("rolling_friction", _make_pair_rule("rolling_friction", "rolling_friction")),
}
