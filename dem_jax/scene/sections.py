"""What a person writes: a scene as plain, frozen data; TOML in and out; every error one line naming key and value.

SI units unless a key's name says otherwise (``_deg``: degrees). See ``dem_jax/scenes/*.toml`` for the stock scenes.
"""

import difflib
import json
import tomllib
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from dem_jax.errors import SceneError

STOCK = Path(__file__).parent.parent / "scenes"


def _tuple(value):
    return tuple(value) if isinstance(value, list) else value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[tuple[float, float, float], BeforeValidator(_tuple)]
Quaternion = Annotated[tuple[float, float, float, float], BeforeValidator(_tuple)]
Size = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(_tuple)]
Points = Annotated[tuple[Vector, ...], BeforeValidator(_tuple)]


class Section(BaseModel):
    """A table of a scene: unknown keys, wrong types and values that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Material(Section):
    """What pieces and walls are made of, and the contact law's parameters. Values are the paper's (section 4.2)."""

    density: Positive = Field(300.0, description="kg/m3, pieces")
    youngs_modulus: Positive = Field(1.0e8, description="Pa, pieces (E_p)")
    wall_youngs_modulus: Positive = Field(1.0e11, description="Pa, walls (E_b)")
    restitution: float = Field(0.1, gt=0, le=1, description="epsilon of eq. 6")
    friction_piece: NotNegative = Field(0.7, description="mu between pieces")
    friction_wall: NotNegative = Field(0.3, description="mu between piece and wall")
    softening: Positive = Field(0.01, description="NSF, on both moduli")
    stiffness_size: str = Field("equivalent-diameter", description="L of eqs 7-8, a name of shapes.SIZE_LENGTHS")
    separation: float = Field(0.001, ge=0, lt=1, description="lambda of eq. 1")
    tangential_stiffness: Positive = Field(1.0, description="K_t / K_nl")
    unloading_damping: float = Field(
        0.0, ge=0, le=1, description="damping ratio of the unloading branch; 0: as in the paper"
    )


Error = Annotated[float, Field(gt=0, le=0.2)]


class Accuracy(Section):
    """The errors of a single impact that are accepted, relative: the time step follows from them (dem_jax/materials.py)."""

    restitution: Error | None = Field(None, description="of the speed of rebound")
    peak_force: Error | None = None

    @model_validator(mode="after")
    def _says_something(self):
        if self.restitution is None and self.peak_force is None:
            raise ValueError("missing: restitution, peak_force; at least one must be given: a number > 0 and <= 0.2")
        return self


class RunSettings(Section):
    """How a scene is run and what is kept."""

    duration: Positive = Field(0.2, description="s, from the release of the portion")
    until_settled: bool = Field(False, description="end once all is at rest: settling before the release, and the run")
    settled_speed: Positive = Field(0.01, description="m/s; at rest are pieces that have all been slower ...")
    settled_time: Positive = Field(0.02, description="s ... for so long, after the last motion of a wall")
    sample: Positive = Field(30e-6, description="s between samples")
    step: Literal["auto"] | Positive = Field("auto", description='s, or "auto"')
    accuracy: Accuracy | None = Field(
        None, description="instead of step: { restitution = 0.01, peak_force = 0.001 }, relative errors, both or one"
    )
    precision: Literal["f32", "f64"] = "f32"
    gravity: Vector = Field((0.0, 0.0, -9.81), description="m/s2")
    frames: NotNegative = Field(1e-3, description="s between stored poses; 0: none")
    energy: bool = Field(True, description="keep the ledger of dissipated energy and work of walls")
    domain_low: Vector | None = Field(
        None, description="m; a piece below this has left the scene; unset: from the walls"
    )
    domain_high: Vector | None = Field(None, description="m")
    escape: Literal["stop", "note"] = Field(
        "stop", description='a piece that leaves the domain stops the run, or is noted in the file and flies on: "note"'
    )
    rebuild_steps: int = Field(48, ge=1, description="how many steps candidate pairs are kept at most")
    neighbours: Literal["auto", "all-pairs", "cells", "jax-md"] = Field(
        "auto", description="how pairs of pieces are found; auto: all pairs of few, cells for many"
    )

    @model_validator(mode="after")
    def _has_one_step(self):
        if self.accuracy is not None and self.step != "auto":
            raise ValueError(f'step = {self.step:g}: beside accuracy, from which the step follows; allowed: "auto"')
        return self


class ConvexShape(Section):
    """A convex shape, with the sizes that it takes."""

    shape: Literal["chamfered-cuboid", "cuboid", "sphere", "prism", "cylinder", "hull"] = "chamfered-cuboid"
    scale_factor: Positive = Field(1.0, description="SF, on all lengths")
    size: Size | None = Field(
        None, description="m, edges x, y, z of a cuboid; unset: the marshmallow's 55 x 23 x 16 mm"
    )
    chamfer: Positive | None = Field(None, description="m, of a chamfered cuboid; unset: 5 mm")
    radius: Positive | None = Field(None, description="m, of a sphere, a cylinder or a prism (circumscribed)")
    height: Positive | None = Field(None, description="m, of a cylinder, a prism or a tube")
    sides: int | None = Field(None, ge=3, description="of a prism, a cylinder or a tube")
    points: Points | None = Field(None, description="m, point set of a hull")
    stl: str | None = Field(None, description="file of a hull or of what is decomposed, relative to the scene's")
    unit: Positive = Field(1.0, description="m per unit of the STL or the points")


class Part(ConvexShape):
    """A convex part of a compound, in the axes of the whole."""

    position: Vector | None = Field(
        None, description="m, of its centre of mass; unset: a hull stays where its points are, others at the origin"
    )
    orientation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="quaternion w x y z, axes of the part to those of the whole")


class BodyMass(Section):
    """Mass properties of a compound that are not those of its parts' union, for uniform density."""

    volume: Positive = Field(description="m3")
    centre: Vector = Field(description="m, of mass, in the axes in which the parts are listed")
    gyration: Annotated[tuple[float, float, float, float, float, float], BeforeValidator(_tuple)] = Field(
        description="m2, inertia over mass about the centre: xx, yy, zz, xy, xz, yz"
    )


class PieceShape(ConvexShape):
    """The shape of a piece, with the sizes that it takes."""

    shape: Literal[
        "chamfered-cuboid", "cuboid", "sphere", "prism", "cylinder", "hull", "tube", "compound", "decomposed"
    ] = "chamfered-cuboid"
    outer_radius: Positive | None = Field(None, description="m, of a tube")
    inner_radius: Positive | None = Field(None, description="m, of a tube")
    part: Annotated[tuple[Part, ...], BeforeValidator(_tuple)] | None = Field(
        None, description="of a compound: convex shapes with position and orientation, that touch or overlap"
    )
    mass_properties: BodyMass | None = Field(
        None, description="of a compound, before scaling; unset: the exact ones of the union of its parts"
    )
    joint_tolerance: float | None = Field(
        None, gt=0, le=0.01, description="of a compound, fraction of its size within which parts touch and are flush; unset: 1e-6"
    )
    concavity: float | None = Field(None, ge=0.01, le=1, description="at which decomposing cuts a part further; unset: 0.05")
    max_parts: int | None = Field(None, ge=1, description="of what is decomposed; unset: as many as it takes")
    loss: Positive | None = Field(
        None, description="what decomposing may lose, as fraction of the volume and of the size; unset: 0.05"
    )
    note: str | None = Field(None, description="said with the results; what decomposing lost is written here")


SHAPE_KEYS = {
    "sphere": {"radius"},
    "cuboid": {"size"},
    "chamfered-cuboid": {"size", "chamfer"},
    "prism": {"sides", "radius", "height"},
    "cylinder": {"radius", "height", "sides"},
    "hull": {"points", "stl", "unit"},
    "tube": {"outer_radius", "inner_radius", "height", "sides"},
    "compound": {"part", "mass_properties", "joint_tolerance"},
    "decomposed": {"stl", "unit", "concavity", "max_parts", "loss"},
}


class Piece(PieceShape):
    """A piece listed one by one."""

    position: Vector = Field(description="m, centre of mass")
    orientation: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="quaternion w x y z, body to world")
    velocity: Vector = Field((0.0, 0.0, 0.0), description="m/s")
    angular_velocity: Vector = Field((0.0, 0.0, 0.0), description="rad/s, world frame")


class Portion(PieceShape):
    """Pieces made by the scene, at random by the seed."""

    target_weight: Positive = Field(0.05, description="kg; eq. 16 gives the count, rounded, unless count is set")
    count: int | None = Field(None, ge=1, description="number of pieces")
    arrangement: Literal["settled", "scattered"] = Field(
        "settled", description="settled in the closed feed bucket before time zero, or let go as scattered"
    )
    settling_time: Positive = Field(0.5, description="s that the pieces are given to settle before time zero")
    region_low: Vector | None = Field(None, description="m; box in which pieces are scattered; unset: the feed bucket")
    region_high: Vector | None = Field(
        None, description="m; it is filled from below, and left upwards if it is too small"
    )
    spacing: float = Field(1.02, ge=1.0, description="of the grid of scattered pieces, in bounding diameters")


class Wall(Section):
    """A convex panel, or the panels of an STL, in a named group."""

    group: str = Field(min_length=1, pattern=r"^[A-Za-z0-9_.-]+$")
    corners: Points | None = Field(
        None, description="m, of a convex planar polygon, counter-clockwise seen by the pieces"
    )
    stl: str | None = Field(None, description="file, relative to the scene's; facets face the pieces")
    unit: Positive = Field(1.0, description="m per unit of the STL")
    thickness: Positive = Field(0.01, description="m, behind the surface")


class Motion(Section):
    """How a wall group moves: about a hinge, and/or vibrating. Times are from the release of the portion."""

    group: str
    pivot: Vector = Field((0.0, 0.0, 0.0), description="m, a point of the hinge's axis")
    axis: Vector = Field((1.0, 0.0, 0.0), description="direction of the hinge")
    swing_deg: float = Field(0.0, description="degrees by which the flap opens, right-handed about the axis")
    start: float = Field(0.0, description="s")
    opening: Positive = Field(0.08, description="s")
    dwell: NotNegative = Field(0.1, description="s open")
    closing: Positive = Field(0.09, description="s")
    period: NotNegative = Field(0.0, description="s; 0: once")
    stroke: Vector = Field((0.0, 0.0, 0.0), description="m, amplitude of the vibration")
    frequency: NotNegative = Field(50.0, description="Hz")
    shake_start: float = Field(0.0, description="s")
    shake_end: float = Field(1e3, description="s")
    shake_ramp: Positive = Field(0.02, description="s, to full amplitude and back")


class Block(Section):
    """A box in which settled mass is counted."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    low: Vector = Field(description="m")
    high: Vector = Field(description="m")


class Bucket(Section):
    """A bucket: four vertical walls and two flaps, hinged at two lower edges, that close to a V.

    The paper gives no geometry; these are plausible values for a 1.6 litre bucket (named assumptions).
    """

    mouth: Annotated[tuple[Positive, Positive], BeforeValidator(_tuple)] = Field(
        (0.14, 0.12), description="m, inner width along the hinges (x) and across them (y)"
    )
    wall_height: Positive = Field(0.13, description="m, of the vertical walls above the hinges")
    flap_angle_deg: float = Field(55.0, gt=0, lt=90, description="degrees of the closed flaps below the horizontal")
    opening_angle_deg: float = Field(65.0, ge=0, le=150, description="degrees by which a flap opens")
    opening_start: float = Field(0.0, description="s after the release")
    opening_time: Positive = Field(0.08, description="s")
    open_dwell: NotNegative = Field(0.1, description="s")
    closing_time: Positive = Field(0.09, description="s")
    thickness: Positive = Field(0.005, description="m, of walls and flaps")
    lap: NotNegative = Field(0.012, description="m by which flaps and walls run on behind each other where they meet")


class Drop(Section):
    """Where the feed bucket is above the weigh bucket."""

    height: Positive = Field(
        0.25, description="m, from the lower edge of the closed feed flaps to that of the weigh flaps"
    )


class Feeder(Section):
    """A linear feeder: a vibrating pan whose lower end hangs over the feed bucket. Its pieces are like the portion's.

    The paper gives neither geometry nor vibration; these are plausible values (named assumptions).
    """

    count: int | None = Field(None, ge=1, description="pieces that lie on the pan at first; unset: as many as the portion has")
    length: Positive = Field(0.28, description="m, of the pan along x")
    width: Positive = Field(0.09, description="m, inner width of the pan")
    wall_height: Positive = Field(0.06, description="m, of its sides")
    tilt_deg: float = Field(3.0, ge=0, lt=45, description="degrees by which the pan descends towards the bucket")
    overhang: float = Field(0.0, description="m by which the edge of the pan stands over the inside of the feed bucket")
    clearance: Positive = Field(0.02, description="m from the feed bucket's upper edge to that of the pan")
    stroke: NotNegative = Field(4e-4, description="m, amplitude of the vibration")
    stroke_angle_deg: float = Field(25.0, gt=0, lt=90, description="degrees of the stroke above the horizontal, forwards and up")
    frequency: Positive = Field(50.0, description="Hz")
    start: float = Field(0.27, description="s after the release; by default when the flaps of the feed bucket are shut")
    duration: Positive = Field(0.7, description="s of vibration")
    ramp: Positive = Field(0.02, description="s, to full amplitude and back")
    thickness: Positive = Field(0.005, description="m")


class Scene(Section):
    """A whole scene. ``load_scene`` reads one; ``replace`` makes a changed one."""

    name: str = Field("scene", pattern=r"^[^/\\]+$", description="of the files that a run writes")
    material: Material = Material()
    run: RunSettings = RunSettings()
    portion: Portion | None = None
    piece: Annotated[tuple[Piece, ...], BeforeValidator(_tuple)] = ()
    wall: Annotated[tuple[Wall, ...], BeforeValidator(_tuple)] = ()
    motion: Annotated[tuple[Motion, ...], BeforeValidator(_tuple)] = ()
    block: Annotated[tuple[Block, ...], BeforeValidator(_tuple)] = ()
    feed_bucket: Bucket | None = None
    weigh_bucket: Bucket | None = None
    feeder: Feeder | None = None
    drop: Drop = Drop()
    folder: str = Field(".", description="folder that files named in the scene are relative to")

    @model_validator(mode="after")
    def _has_pieces(self):
        if not self.piece and self.portion is None:
            raise ValueError("a scene needs [portion] or at least one [[piece]]")
        return self

    @model_validator(mode="after")
    def _feeder_feeds_a_bucket(self):
        if self.feeder and (self.feed_bucket is None or self.piece):
            raise ValueError("[feeder] needs a [feed_bucket] below it and a [portion], and no [[piece]]")
        return self

    def replace(self, changes: dict[str, Any] | None = None, **sections) -> "Scene":
        """A scene with some values changed: ``scene.replace(material={"restitution": 0.3})`` or
        ``scene.replace({"material.restitution": 0.3})``. Lists are replaced whole. Raises SceneError."""
        tree = self.model_dump(exclude_unset=False)
        for key, value in (changes or {}).items():
            _set(tree, key.split("."), value)
        return _validated(_merged(tree, sections), "scene")

    def to_toml(self) -> str:
        """The scene as TOML text, complete with defaults; ``parse`` reads it back."""
        return _toml(self.model_dump(exclude_none=True))


def load_scene(source, changes: dict[str, Any] | None = None) -> Scene:
    """Read a stock scene by name or a TOML file by path, with changes as of ``Scene.replace``. Raises SceneError."""
    tree, path = _read(source, ())
    for key, value in (changes or {}).items():
        _set(tree, key.split("."), value)
    return _validated(tree, path.stem if path.parent == STOCK else str(path))


def parse(text: str, source="scene") -> Scene:
    """A scene from TOML text that is complete in itself or has a stock scene as its base. Raises SceneError."""
    return _validated(_based(_loads(text, source), Path("."), source, ()), source)


def described(scene: Scene) -> str:
    """The scene as TOML text with every key that there is, its description and its default; ``parse`` reads it back."""
    lines = []
    for key, field in Scene.model_fields.items():
        value = getattr(scene, key)
        section = next(iter(_models(field.annotation)), None)
        if section is None:
            if key != "folder":
                lines.append(_described_line(key, field, value))
        elif isinstance(value, tuple):
            lines += _described_rows(f"[[{key}]]", section, value)
        else:
            lines += _described_rows(f"[{key}]", section, () if value is None else (value,))
    return "\n".join(lines) + "\n"


def _described_rows(head, section, rows):
    """A table, or the tables of a list; the first with all comments; commented out if the scene has none."""
    text = (section.__doc__ or "").splitlines()[0]
    lines = ["", f"# {text}"]
    if not rows:
        fields = section.model_fields.items()
        return [*lines, f"# {head}"] + [f"# {_described_line(k, f, None).removeprefix('# ')}" for k, f in fields]
    for n, row in enumerate(rows):
        lines += ([""] if n else []) + [head]
        for key, field in section.model_fields.items():
            value = getattr(row, key)
            if n == 0:
                lines.append(_described_line(key, field, value))
            elif value is not None:
                lines.append(f"{key} = {_value(_plain(value))}")
    return lines


def _described_line(key, field, value):
    """key = value  # description; allowed; default."""
    default = None if field.is_required() else field.default
    shown = default if value is None else value
    head = f"{key} = {_value(_plain(shown))}" if shown is not None else f"{key} ="
    notes = [field.description or "", allowed(field)]
    if field.is_required():
        notes.append("required")
    elif default is not None and value is not None and value != default:
        notes.append(f"default: {_value(_plain(default))}")
    line = f"{head:<40} # {'; '.join(note for note in notes if note)}"
    return line if value is not None else f"# {line}"


def _plain(value):
    if isinstance(value, BaseModel):
        return value.model_dump(exclude_none=True)
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def stock_scenes() -> dict[str, str]:
    """Names of the stock scenes and what each shows (the first comment line of its file)."""
    out = {}
    for path in sorted(STOCK.glob("*.toml")):
        first = path.read_text().splitlines()[0]
        out[path.stem] = first.lstrip("# ").strip()
    return out


def _read(source, seen):
    path = Path(source)
    stock = STOCK / f"{source}.toml"
    if stock.is_file() and path.suffix != ".toml":
        path = stock
    if not path.is_file():
        names = ", ".join(stock_scenes())
        raise SceneError(f"scene {str(source)!r}: no such file, nor one of the stock scenes ({names})")
    if path.resolve() in seen:
        raise SceneError(f"scene {path}: base: it is based on itself; allowed: a chain without a circle")
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"scene {path}: cannot be read ({type(error).__name__}); allowed: a TOML text file") from error
    own = _loads(text, path)
    name = own.get("name", path.stem)
    tree = _based(own, path.parent, path, (*seen, path.resolve()))
    tree["name"] = name
    if path != stock:
        tree["folder"] = str(path.parent)
    return tree, path


def _loads(text, source):
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"scene {source}: not valid TOML: {error}") from error


def _based(tree, folder, source, seen):
    """The tree on top of its base."""
    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise SceneError(f"scene {source}: base = {base!r}: allowed: a stock scene's name or a path")
    beside = folder / base
    below, _ = _read(beside if beside.is_file() else base, seen)
    if "piece" in tree and "portion" not in tree:
        below.pop("portion", None)  # pieces listed one by one: [portion] is not used
    return _merged(below, tree)


def _merged(below, above):
    """Tables are merged key by key, all else is replaced."""
    out = dict(below)
    for key, value in above.items():
        if isinstance(value, BaseModel):
            value = value.model_dump()
        nested = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _merged(out[key], value) if nested else value
    return out


def _set(tree, keys, value):
    for i, key in enumerate(keys[:-1]):
        below = tree.get(key) if isinstance(tree, dict) else None
        index = keys[i + 1]
        if isinstance(below, (list, tuple)) or (below is None and index.isdecimal()):
            below = below or ()
            if not index.isdecimal() or int(index) >= len(below) or i + 2 == len(keys):
                rows = f"{key}.0.KEY to {key}.{len(below) - 1}.KEY" if below else f"none, this scene has no {key}"
                raise SceneError(f"{'.'.join(keys)} = {_short(value)}: {key} is a list; allowed: {rows}")
            rows = [dict(row) for row in below]
            tree[key] = rows
            return _set(rows[int(index)], keys[i + 2 :], value)
        if below is None:
            below = {}
        if not isinstance(below, dict):
            raise SceneError(f"{'.'.join(keys)} = {_short(value)}: unknown key; {key} is a value, not a table")
        tree[key] = below = dict(below)
        tree = below
    tree[keys[-1]] = value


def parse_setting(text: str):
    """``section.key=value`` of a command line -> (key, value): the value as TOML, else as text. Raises SceneError."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise SceneError(f"--set {text!r}: allowed: section.key=value")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def _validated(tree, source) -> Scene:
    try:
        return Scene.model_validate(tree)
    except ValidationError as error:
        raise SceneError(f"{source}: {_one_line(error, tree)}") from error


def _one_line(error: ValidationError, tree) -> str:
    """The first mistake: key, value, and what is allowed."""
    first = error.errors()[0]
    if first["type"] == "value_error":
        return f"{'.'.join(map(str, first['loc']))}: {first['ctx']['error']}".removeprefix(": ")
    place, model, field = _field_at(first["loc"])
    key = ".".join(place)
    if first["type"] == "extra_forbidden":
        known = list(model.model_fields)
        near = difflib.get_close_matches(place[-1], known, 1, 0.75)
        hint = f"did you mean {near[0]!r}? " if near else ""
        return f"{key} = {_short(first['input'])}: unknown key; {hint}allowed: {', '.join(known)}"
    if field is None:
        return f"{key} = {_short(first['input'])}: allowed: {_tables([name for name in place if not name.isdecimal()])}"
    if first["type"] == "missing" and len(place) == len(first["loc"]):
        return f"{key}: missing; it must be given: {allowed(field)}"
    return f"{key} = {_short(_at(tree, place))}: allowed: {allowed(field)}"


def _field_at(loc):
    """Of a pydantic location: the keys down to a field, the section that the last key is in, and its field or None."""
    place, model, field = [], Scene, None
    for key in loc:
        place.append(str(key))
        if isinstance(key, int):
            continue
        section, field = model, model.model_fields.get(key)
        inside = next(iter(_models(field.annotation)), None) if field else None
        if inside is None:
            return place, section, field
        model = inside
    return place, model, None


def _tables(names: list[str]) -> str:
    """The head of a table, or of a list of tables, by the keys that lead to it."""
    model = Scene
    for name in names:
        annotation = model.model_fields[name].annotation
        model = next(_models(annotation))
    head = ".".join(names)
    return f"tables [[{head}]]" if _has_list(annotation) else f"a table [{head}]"


def _has_list(annotation) -> bool:
    return get_origin(annotation) is tuple or any(_has_list(part) for part in get_args(annotation))


def _at(tree, place):
    for key in place:
        tree = tree[int(key)] if isinstance(tree, (list, tuple)) else tree.get(key)
    return tree


def allowed(field) -> str:
    """What a field takes, in words."""
    return _words(Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation)


def _words(annotation) -> str:
    """What a type takes, in words."""
    limits = []
    while get_origin(annotation) is Annotated:
        annotation, *metadata = get_args(annotation)
        limits += [words for m in metadata for words in _limits(m)]
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(json.dumps(a) for a in args)
    if origin in (Union, UnionType):
        return " or ".join(_words(a) for a in args if a is not type(None)) + " and".join(limits)
    if origin is tuple:
        several = args[-1] is Ellipsis
        of_each = _words(args[0])
        return f"a list, each {of_each}" if several else f"a list of {len(args)}, each {of_each}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "a table"
    plain = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return plain[annotation] + " and".join(limits)


def _limits(metadata) -> list[str]:
    """The limits that an annotation sets, in words."""
    if isinstance(metadata, FieldInfo):
        return [words for m in metadata.metadata for words in _limits(m)]
    signs = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="), ("pattern", "that matches"))
    values = [(sign, getattr(metadata, name, None)) for name, sign in signs]
    return [f" {sign} {value}" for sign, value in values if value is not None]


def _models(annotation):
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _models(part)


def _short(value):
    text = repr(value) if isinstance(value, dict) else _value(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _toml(tree) -> str:
    """Plain TOML of nested tables, lists of tables and plain values."""
    lines = [f"{key} = {_value(v)}" for key, v in tree.items() if not isinstance(v, dict) and not _is_tables(v)]
    for key, v in tree.items():
        if isinstance(v, dict):
            lines += ["", f"[{key}]"] + [f"{k} = {_value(x)}" for k, x in v.items()]
        elif _is_tables(v):
            for row in v:
                lines += ["", f"[[{key}]]"] + [f"{k} = {_value(x)}" for k, x in row.items()]
    return "\n".join(lines) + "\n"


def _is_tables(value):
    return isinstance(value, (list, tuple)) and len(value) > 0 and isinstance(value[0], dict)


def _value(value):
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return repr(value)
