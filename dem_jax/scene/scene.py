"""A whole scene: plain, frozen data of which each section says what it takes. SI units unless a key's name says otherwise
(``_deg``: degrees). See ``dem_jax/scenes/*.toml`` for the stock scenes."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from dem_jax.errors import SceneError
from dem_jax.scene.changes import new_materials, on_top, set_key, without_density, without_ranges
from dem_jax.scene.library import with_named
from dem_jax.scene.overrides import check_varied, drop_overridden, find_overridden, nested
from dem_jax.scene.sections.base import Section, as_tuple
from dem_jax.scene.sections.buckets import Bucket, Drop, Feeder, WeighBucket
from dem_jax.scene.sections.contact import Contact, stray_key
from dem_jax.scene.sections.cycle import Cycle
from dem_jax.scene.sections.exchange import Inlet, Outlet
from dem_jax.scene.sections.material import DEFAULT, WALL, Material, Pair
from dem_jax.scene.sections.pieces import Piece, Portion, Product
from dem_jax.scene.sections.run import ROUNDING, RunSettings
from dem_jax.scene.sections.statistics import Statistics
from dem_jax.scene.sections.uncertain import Uncertain
from dem_jax.scene.sections.walls import Block, Motion, Wall
from dem_jax.scene.text import toml, value
from dem_jax.scene.words import choices, one_line


class Scene(Section):
    """A whole scene. ``load_scene`` reads one; ``replace`` makes a changed one."""

    name: str = Field("scene", pattern=r"^[^/\\\x00-\x1f\x7f-\x9f]+$", description="of the files that a run writes")
    material: Material = Material()
    run: RunSettings = RunSettings()
    portion: Portion | None = None
    piece: Annotated[tuple[Piece, ...], BeforeValidator(as_tuple)] = ()
    wall: Annotated[tuple[Wall, ...], BeforeValidator(as_tuple)] = ()
    motion: Annotated[tuple[Motion, ...], BeforeValidator(as_tuple)] = ()
    block: Annotated[tuple[Block, ...], BeforeValidator(as_tuple)] = ()
    feed_bucket: Bucket | None = None
    weigh_bucket: WeighBucket | None = None
    feeder: Feeder | None = None
    drop: Drop = Drop()
    cycle: Cycle | None = None
    pair: Annotated[tuple[Pair, ...], BeforeValidator(as_tuple)] = ()
    contact: Contact = Contact()
    statistics: Statistics | None = None
    inlet: Inlet | None = None
    outlet: Outlet | None = None
    uncertain: Annotated[tuple[Uncertain, ...], BeforeValidator(as_tuple)] = ()
    folder: str = Field(".", description="folder that files named in the scene are relative to")

    @model_validator(mode="after")
    def _has_pieces(self) -> "Scene":
        if not self.piece and self.portion is None:
            raise ValueError("a scene needs [portion] or at least one [[piece]]")
        return self

    @model_validator(mode="after")
    def _feeder_feeds_a_bucket(self) -> "Scene":
        if self.feeder and (self.feed_bucket is None or self.piece):
            raise ValueError("[feeder] needs a [feed_bucket] below it and a [portion], and no [[piece]]")
        return self

    @model_validator(mode="after")
    def _cycle_has_what_it_moves(self) -> "Scene":
        if self.cycle and not (self.weigh_bucket and self.feed_bucket and (self.feeder or self.cycle.lf is None)):
            raise ValueError("[cycle] needs a [weigh_bucket] and a [feed_bucket], and with lf a [feeder]")
        return self

    @model_validator(mode="after")
    def _inlet_has_a_place(self) -> "Scene":
        if self.inlet and (self.piece or (self.inlet.low is None and self.feed_bucket is None)):
            raise ValueError("[inlet] needs a [portion], and a [feed_bucket] or inlet.low and inlet.high")
        return self

    @model_validator(mode="after")
    def _samples_within_its_other_times(self) -> "Scene":
        """A time that is counted in samples and is shorter than one would silently become a whole one."""
        sample, portion = self.run.sample, self.portion
        rows = {"inlet": self.inlet, "outlet": self.outlet}
        times = {f"{name}.every": row.every for name, row in rows.items() if row is not None}
        if portion is not None and not self.piece and portion.arrangement == "settled":
            times["portion.settling_time"] = portion.settling_time
        for key, time in times.items():
            if sample > time * (1 + ROUNDING):
                raise ValueError(f"run.sample = {sample:g}: longer than {key} = {time:g}; allowed: at most that")
        return self

    @model_validator(mode="after")
    def _sets_no_key_of_another_law(self) -> "Scene":
        if stray := stray_key(self.contact, self.material):
            raise ValueError(stray)
        return self

    @model_validator(mode="after")
    def _sets_no_key_that_cannot_act(self) -> "Scene":
        for wrong in find_overridden(self):
            raise ValueError(wrong)
        return self

    @model_validator(mode="after")
    def _names_materials_that_exist(self) -> "Scene":
        known = list(self.material.named)
        for key, name in materials_named(self):
            if name not in known:
                allowed = choices(name, known) if known else "allowed: a name of a [material.NAME], of which there is none"
                raise ValueError(f"{key} = {value(name)}: no such material; {allowed}")
        return self

    @model_validator(mode="after")
    def _says_one_of_weight_and_density(self) -> "Scene":
        for key, row in rows_of_pieces(self).items():
            said, name = self.material.density, "material.density"
            own = self.material.named.get(row.material or "")
            if own is not None and own.density is not None:
                said, name = own.density, f"material.{row.material}.density"
            if row.piece_weight is not None and said != Material().density:
                raise ValueError(f"{key}.piece_weight = {row.piece_weight:g}: beside {name} = {said:g}; allowed: one of the two")
        return self

    @model_validator(mode="after")
    def _lists_each_pair_once(self) -> "Scene":
        known, seen = [DEFAULT, WALL, *self.material.named], set()
        for n, pair in enumerate(self.pair):
            for name in pair.of:
                if name not in known:
                    raise ValueError(f"pair.{n}.of = {value(pair.of)}: no such material; {choices(name, known)}")
            if frozenset(pair.of) in seen:
                raise ValueError(f"pair.{n}.of = {value(pair.of)}: is listed already; allowed: each pair once")
            seen.add(frozenset(pair.of))
        return self

    @model_validator(mode="after")
    def _doubts_numbers_that_it_has(self) -> "Scene":
        for n, row in enumerate(self.uncertain):
            if number_of(self, row.key) is None:
                raise ValueError(f"uncertain.{n}.key = {value(row.key)}: allowed: the dotted key of a number that this scene sets")
        return self

    def replace(self, changes: dict[str, Any] | None = None, **sections: Any) -> "Scene":
        """A scene with some values changed: ``scene.replace(material={"restitution": 0.3})`` or
        ``scene.replace({"material.restitution": 0.3})``. Lists are replaced whole. Raises SceneError."""
        return validated(self.model_dump(exclude_unset=False), "scene", changes, sections)

    def to_toml(self) -> str:
        """The scene as TOML text, complete with defaults; ``parse`` reads it back."""
        return toml(self.model_dump(exclude_none=True))


def number_of(scene: Scene, key: str) -> float | None:
    """The number at a dotted key of a scene; None where there is none."""
    found: Any = scene
    for part in key.split("."):
        if isinstance(found, tuple) and part.isdecimal():
            found = found[int(part)] if int(part) < len(found) else None
        elif isinstance(found, Section):
            found = getattr(found, part) if part in {*type(found).model_fields, *(found.model_extra or {})} else None
        else:
            return None
    return found if isinstance(found, float | int) and not isinstance(found, bool) else None


def rows_of_pieces(scene: Scene) -> dict[str, Piece | Portion | Product]:
    """Key -> the section of pieces that are alike: a piece, a product, or the portion of one product."""
    if scene.piece or scene.portion is None:
        return {f"piece.{n}": row for n, row in enumerate(scene.piece)}
    products = scene.portion.product
    return {f"portion.product.{n}": row for n, row in enumerate(products)} if products else {"portion": scene.portion}


def materials_named(scene: Scene) -> list[tuple[str, str]]:
    """(key, name) wherever the scene names a material for pieces or walls."""
    products = scene.portion.product if scene.portion else ()
    places = {
        "portion": scene.portion,
        **{f"portion.product.{n}": row for n, row in enumerate(products)},
        **{f"piece.{n}": row for n, row in enumerate(scene.piece)},
        **{f"wall.{n}": row for n, row in enumerate(scene.wall)},
        "weigh_bucket": scene.weigh_bucket,
        "feed_bucket": scene.feed_bucket,
        "feeder": scene.feeder,
    }
    return [(f"{key}.material", row.material) for key, row in places.items() if row and row.material is not None]


def validated(
    tree: dict[str, Any], source: str, changes: dict[str, Any] | None = None, sections: dict[str, Any] | None = None
) -> Scene:
    """The scene of a tree of plain values with changes by dotted keys (``product``, ``bucket`` first), then by sections. Raises
    SceneError, whose words begin with ``source``."""
    changes = dict(changes or {})
    tree = with_named(tree, changes, source)
    new = new_materials(tree, changes)
    tree = without_density(tree) if any(key.endswith(".piece_weight") for key in changes) else dict(tree)
    above = nested(changes)
    tree = without_ranges(drop_overridden(tree, above), above)
    for key, item in changes.items():
        set_key(tree, key.split("."), item)
    tree = on_top(tree, sections or {})
    try:
        scene = Scene.model_validate(tree)
    except ValidationError as error:
        raise SceneError(f"{source}: {one_line(error, tree, Scene)}") from error
    _check_new_materials(scene, new, source)
    check_varied(scene, changes, source)
    return scene


def _check_new_materials(scene: Scene, new: dict[str, str], source: str) -> None:
    """A key like material.NAME.restitution whose NAME nothing in the scene has is a slip of the pen. Raises SceneError."""
    used = {name for _, name in materials_named(scene)} | {name for pair in scene.pair for name in pair.of}
    for name, key in new.items():
        if name not in used:
            known = [other for other in scene.material.named if other not in new]
            allowed = choices(name, known) if known else "allowed: a name that a piece or wall has"
            raise SceneError(f"{source}: {key}: nothing is of a material {name!r}; {allowed}")
