"""A whole scene: plain, frozen data of which each section says what it takes. SI units unless a
key's name says otherwise (``_deg``: degrees). See ``dem_jax/scenes/*.toml`` for the stock scenes.
"""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from dem_jax.errors import SceneError
from dem_jax.scene.former_keys import accept_keys, accept_tables
from dem_jax.scene.library import apply_library_keys
from dem_jax.scene.messages import format_error, suggest_choices
from dem_jax.scene.overrides import (
    check_varied_keys,
    drop_overridden_keys,
    find_inactive_keys,
    nest_keys,
)
from dem_jax.scene.sections.base import Section, as_tuple
from dem_jax.scene.sections.bucket import Bucket, Drop, Feeder, WeighBucket
from dem_jax.scene.sections.contact import Contact, find_stray_key
from dem_jax.scene.sections.cycle_settings import Cycle
from dem_jax.scene.sections.inlet_outlet import Inlet, Outlet
from dem_jax.scene.sections.material import DEFAULT_NAME, WALL_NAME, Material, Pair
from dem_jax.scene.sections.piece import Piece, Portion, Product
from dem_jax.scene.sections.run_settings import ROUNDING, RunSettings
from dem_jax.scene.sections.statistics_settings import Statistics
from dem_jax.scene.sections.uncertain_number import UncertainNumber
from dem_jax.scene.sections.wall import Motion, Region, Wall
from dem_jax.scene.toml_text import dump_toml, format_value
from dem_jax.scene.tree_merging import (
    drop_density,
    drop_replaced_ranges,
    find_new_materials,
    overlay_scene,
    set_key,
)


class Scene(Section):
    """A whole scene. ``load_scene`` reads one; ``replace`` makes a changed one."""

    name: str = Field(
        "scene",
        pattern=r"^[^/\\\x00-\x1f\x7f-\x9f]+$",
        description="of the files that a run writes",
    )
    material: Material = Material()
    run: RunSettings = RunSettings()
    portion: Portion | None = None
    piece: Annotated[tuple[Piece, ...], BeforeValidator(as_tuple)] = ()
    wall: Annotated[tuple[Wall, ...], BeforeValidator(as_tuple)] = ()
    motion: Annotated[tuple[Motion, ...], BeforeValidator(as_tuple)] = ()
    region: Annotated[tuple[Region, ...], BeforeValidator(as_tuple)] = ()
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
    uncertain: Annotated[tuple[UncertainNumber, ...], BeforeValidator(as_tuple)] = ()
    folder: str = Field(".", description="folder that files named in the scene are relative to")

    @model_validator(mode="after")
    def _has_pieces(self) -> "Scene":
        if not self.piece and self.portion is None:
            raise ValueError("a scene needs [portion] or at least one [[piece]]")
        return self

    @model_validator(mode="after")
    def _feeder_feeds_a_bucket(self) -> "Scene":
        if self.feeder and (self.feed_bucket is None or self.piece):
            raise ValueError(
                "[feeder] needs a [feed_bucket] below it and a [portion], and no [[piece]]"
            )
        return self

    @model_validator(mode="after")
    def _cycle_has_what_it_moves(self) -> "Scene":
        if self.cycle and not (
            self.weigh_bucket and self.feed_bucket and (self.feeder or self.cycle.lf is None)
        ):
            raise ValueError(
                "[cycle] needs a [weigh_bucket] and a [feed_bucket], and with lf a [feeder]"
            )
        return self

    @model_validator(mode="after")
    def _inlet_has_a_place(self) -> "Scene":
        if self.inlet and (self.piece or (self.inlet.box_low is None and self.feed_bucket is None)):
            raise ValueError(
                "[inlet] needs a [portion], and a [feed_bucket] or inlet.box_low and inlet.box_high"
            )
        return self

    @model_validator(mode="after")
    def _samples_within_its_other_times(self) -> "Scene":
        """A time that is counted in samples and is shorter than one would silently become a whole
        one.
        """
        sample, portion = self.run.sample_interval, self.portion
        rows = {"inlet": self.inlet, "outlet": self.outlet}
        times = {f"{name}.interval": row.interval for name, row in rows.items() if row is not None}
        if portion is not None and not self.piece and portion.arrangement == "settled":
            times["portion.settling_time"] = portion.settling_time
        for key, time in times.items():
            if sample > time * (1 + ROUNDING):
                raise ValueError(
                    f"run.sample_interval = {sample:g}: longer than {key} = {time:g}; allowed: at most that"
                )
        return self

    @model_validator(mode="after")
    def _sets_no_key_of_another_law(self) -> "Scene":
        if stray := find_stray_key(self.contact, self.material):
            raise ValueError(stray)
        return self

    @model_validator(mode="after")
    def _sets_no_key_that_cannot_act(self) -> "Scene":
        for wrong in find_inactive_keys(self):
            raise ValueError(wrong)
        return self

    @model_validator(mode="after")
    def _names_materials_that_exist(self) -> "Scene":
        known = list(self.material.named_materials)
        for key, name in list_named_materials(self):
            if name not in known:
                allowed = (
                    suggest_choices(name, known)
                    if known
                    else "allowed: a name of a [material.NAME], of which there is none"
                )
                raise ValueError(f"{key} = {format_value(name)}: no such material; {allowed}")
        return self

    @model_validator(mode="after")
    def _says_one_of_weight_and_density(self) -> "Scene":
        for key, row in list_piece_sections(self).items():
            said, name = self.material.density, "material.density"
            own = self.material.named_materials.get(row.material or "")
            if own is not None and own.density is not None:
                said, name = own.density, f"material.{row.material}.density"
            if row.piece_weight is not None and said != Material().density:
                raise ValueError(
                    f"{key}.piece_weight = {row.piece_weight:g}: beside {name} = {said:g}; allowed: one of the two"
                )
        return self

    @model_validator(mode="after")
    def _lists_each_pair_once(self) -> "Scene":
        known, seen = [DEFAULT_NAME, WALL_NAME, *self.material.named_materials], set()
        for n, pair in enumerate(self.pair):
            for name in pair.of:
                if name not in known:
                    raise ValueError(
                        f"pair.{n}.of = {format_value(pair.of)}: no such material; {suggest_choices(name, known)}"
                    )
            if frozenset(pair.of) in seen:
                raise ValueError(
                    f"pair.{n}.of = {format_value(pair.of)}: is listed already; allowed: each pair once"
                )
            seen.add(frozenset(pair.of))
        return self

    @model_validator(mode="after")
    def _doubts_numbers_that_it_has(self) -> "Scene":
        for n, row in enumerate(self.uncertain):
            if find_number(self, row.key) is None:
                raise ValueError(
                    f"uncertain.{n}.key = {format_value(row.key)}: allowed: the dotted key of a number that this scene sets"
                )
        return self

    def replace(self, changes: dict[str, Any] | None = None, **sections: Any) -> "Scene":
        """A scene with some values changed: ``scene.replace(material={"restitution": 0.3})`` or
        ``scene.replace({"material.restitution": 0.3})``. Lists are replaced whole. Raises
        SceneError.
        """
        return validate_scene(self.model_dump(exclude_unset=False), "scene", changes, sections)

    def to_toml(self) -> str:
        """The scene as TOML text, complete with defaults; ``parse`` reads it back."""
        return dump_toml(self.model_dump(exclude_none=True))


def find_number(scene: Scene, key: str) -> float | None:
    """The number at a dotted key of a scene; None where there is none."""
    found: Any = scene
    for part in key.split("."):
        if isinstance(found, tuple) and part.isdecimal():
            found = found[int(part)] if int(part) < len(found) else None
        elif isinstance(found, Section):
            found = (
                getattr(found, part)
                if part in {*type(found).model_fields, *(found.model_extra or {})}
                else None
            )
        else:
            return None
    return found if isinstance(found, float | int) and not isinstance(found, bool) else None


def list_piece_sections(scene: Scene) -> dict[str, Piece | Portion | Product]:
    """Key -> the section of pieces that are alike: a piece, a product, or the portion of one
    product.
    """
    if scene.piece or scene.portion is None:
        return {f"piece.{n}": row for n, row in enumerate(scene.piece)}
    products = scene.portion.product
    return (
        {f"portion.product.{n}": row for n, row in enumerate(products)}
        if products
        else {"portion": scene.portion}
    )


def list_named_materials(scene: Scene) -> list[tuple[str, str]]:
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
    return [
        (f"{key}.material", row.material)
        for key, row in places.items()
        if row and row.material is not None
    ]


def validate_scene(
    tree: dict[str, Any],
    source: str,
    changes: dict[str, Any] | None = None,
    sections: dict[str, Any] | None = None,
) -> Scene:
    """The scene of a tree of plain values with changes by dotted keys (``product``, ``bucket``
    first), then by sections. Raises SceneError, whose words begin with ``source``.
    """
    changes = accept_keys(changes or {})
    tree = apply_library_keys(tree, changes, source)
    new = find_new_materials(tree, changes)
    tree = (
        drop_density(tree) if any(key.endswith(".piece_weight") for key in changes) else dict(tree)
    )
    above = nest_keys(changes)
    tree = drop_replaced_ranges(drop_overridden_keys(tree, above), above)
    for key, item in changes.items():
        set_key(tree, key.split("."), item)
    tree = overlay_scene(tree, accept_tables(sections or {}))
    try:
        scene = Scene.model_validate(tree)
    except ValidationError as error:
        raise SceneError(f"{source}: {format_error(error, tree, Scene)}") from error
    _check_new_materials(scene, new, source)
    check_varied_keys(scene, changes, source)
    return scene


def _check_new_materials(scene: Scene, new: dict[str, str], source: str) -> None:
    """A key like material.NAME.restitution whose NAME nothing in the scene has is a slip of the
    pen. Raises SceneError.
    """
    used = {name for _, name in list_named_materials(scene)} | {
        name for pair in scene.pair for name in pair.of
    }
    for name, key in new.items():
        if name not in used:
            known = [other for other in scene.material.named_materials if other not in new]
            allowed = (
                suggest_choices(name, known)
                if known
                else "allowed: a name that a piece or wall has"
            )
            raise SceneError(f"{source}: {key}: nothing is of a material {name!r}; {allowed}")
