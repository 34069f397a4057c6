"""The choices of a person as plain data: a scene as TOML, its fields, and their commands."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from dem_jax.errors import SceneError
from dem_jax.scene import Scene, parse_scene
from dem_jax.scene.messages import describe_allowed, find_section
from dem_jax.scene.scene import Scene as SceneModel
from dem_jax.scene.toml_text import dump_toml

Tree = dict[str, Any]
BASE = "weigh-bucket"  # the stock scene that every design starts from
RUN_COUNTS = (1, 16, 64)
BASE_UNITS = {"mm": "m", "ms": "s", "g": "kg", "MPa": "Pa"}  # of scenes, of those that are shown
SIGNS = {">=": "at least", "<=": "up to", ">": "above", "<": "below"}  # of a range, in words


class FieldText(NamedTuple):
    """A number that a person may set: where it is in a scene, and what the page says of it.

    key: of the scene. label, unit, sentence: words. factor: SI value over the shown one. step: of
    its arrows.
    """

    key: str
    label: str
    unit: str
    factor: float
    sentence: str
    step: float

    @property
    def title(self) -> str:
        """Label and unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    @property
    def allowed(self) -> str:
        """The values that are allowed, in words and in the unit that is shown."""
        model: Any = SceneModel
        *sections, key = self.key.split(".")
        for section in sections:
            model = find_section(model, section)
        bounds = describe_allowed(model.model_fields[key]).removeprefix("a number").strip()
        for sign, word in SIGNS.items():
            bounds = bounds.replace(f"{sign} ", f"{word} ")
        bounds = bounds.replace("  ", " ").replace("at least 0 and up to", "0 to")
        return f"{bounds} {self.unit}".strip() if bounds else "any number"


RELEASE_FIELDS = (
    FieldText(
        "portion.target_weight",
        "Target weight",
        "g",
        1e-3,
        "Weight of one portion; it gives the number of pieces.",
        5,
    ),
    FieldText(
        "drop.height",
        "Drop height",
        "mm",
        1e-3,
        "From the lower edge of the feed flaps to that of the weigh flaps.",
        10,
    ),
    FieldText(
        "feed_bucket.opening_start",
        "Opening begins",
        "ms",
        1e-3,
        "When the feed flaps begin to open, after the release.",
        10,
    ),
    FieldText(
        "feed_bucket.opening_time",
        "Opening time",
        "ms",
        1e-3,
        "How long the feed flaps take to open.",
        10,
    ),
    FieldText(
        "feed_bucket.opening_angle_deg",
        "Opening angle",
        "°",
        1.0,
        "By how much each feed flap turns.",
        5,
    ),
    FieldText(
        "run.duration",
        "Duration",
        "s",
        1.0,
        "How long the drop is computed, from the release.",
        0.1,
    ),
)
CELL_FIELDS = (
    FieldText(
        "weigh_bucket.load_cell.mass",
        "Bucket on the cell",
        "kg",
        1.0,
        "Mass of bucket and flaps that the cell carries.",
        0.1,
    ),
    FieldText(
        "weigh_bucket.load_cell.rated_load",
        "Rated load",
        "kg",
        1.0,
        "Load that the cell is made for; it sets its stiffness.",
        1,
    ),
    FieldText(
        "weigh_bucket.load_cell.damping_ratio",
        "Damping ratio",
        "",
        1.0,
        "Share of the critical damping of the empty bucket.",
        0.01,
    ),
)
MATERIAL_FIELDS = (
    FieldText(
        "material.density",
        "Density",
        "kg/m³",
        1.0,
        "Mass of the product over its volume, without gaps.",
        10,
    ),
    FieldText(
        "material.youngs_modulus",
        "Young's modulus",
        "MPa",
        1e6,
        "Stiffness of a piece; the peak grows with its root.",
        1,
    ),
    FieldText(
        "material.restitution",
        "Restitution",
        "",
        1.0,
        "Rebound speed over impact speed of two pieces.",
        0.05,
    ),
    FieldText(
        "material.friction_piece",
        "Friction between pieces",
        "",
        1.0,
        "Coulomb coefficient of piece on piece.",
        0.05,
    ),
    FieldText(
        "material.friction_wall",
        "Friction on walls",
        "",
        1.0,
        "Coulomb coefficient of piece on bucket.",
        0.05,
    ),
    FieldText(
        "material.rolling_friction",
        "Rolling friction",
        "",
        1.0,
        "Tangent of the slope on which a round piece stays.",
        0.01,
    ),
    FieldText(
        "material.numerical_softening",
        "Softening NSF",
        "",
        1.0,
        "Factor on all moduli that makes the computation faster.",
        0.01,
    ),
)
FIELDS = {each.key: each for each in (*RELEASE_FIELDS, *CELL_FIELDS, *MATERIAL_FIELDS)}


@dataclass(frozen=True)
class Design:
    """What a person has chosen.

    products: (name, share by weight) of the library or files of one's own; one of them, or a
    mixture. bucket: name or file; "": the one of the base scene. changes: key of the scene -> value
    (SI). has_load_cell: whether the weigh bucket hangs on a load cell. runs: number of drops. seed:
    the first. uncertain: whether several drops have numbers of their own from the ranges of the
    product. move: (m) of an STL bucket of one's own; None: as its file has it.
    """

    products: tuple[tuple[str, float], ...] = (("marshmallow", 1.0),)
    bucket: str = "2.9-litre"
    changes: dict[str, float] = field(default_factory=dict)
    has_load_cell: bool = False
    runs: int = 1
    seed: int = 0
    uncertain: bool = False
    move: tuple[float, float, float] | None = None

    @property
    def product(self) -> str | None:
        """The only product; None of a mixture."""
        return self.products[0][0] if len(self.products) == 1 else None

    @property
    def stem(self) -> str:
        """How names of its files begin."""
        name = self.product or "mixture"
        return Path(name).stem.replace(":", "-")

    def with_change(self, key: str, value: float | None) -> "Design":
        """The design with a changed key; None: as product and bucket have it."""
        changes = {name: item for name, item in self.changes.items() if name != key}
        return replace(self, changes=changes if value is None else {**changes, key: value})

    def with_product(self, name: str) -> "Design":
        """The design with one product, without changes of the material of the one before."""
        kept = {key: item for key, item in self.changes.items() if not key.startswith("material.")}
        return replace(self, products=((name, 1.0),), changes=kept)

    def with_bucket(self, name: str) -> "Design":
        """The design with a bucket, without changes of the sizes of the one before."""
        kept = ("portion.", "material.", "run.", "weigh_bucket.load_cell")
        changes = {key: item for key, item in self.changes.items() if key.startswith(kept)}
        return replace(self, bucket=name, changes=changes, move=None)

    def to_tree(self) -> Tree:
        """The scene as it is written to a TOML file."""
        tree: Tree = {"base": BASE}
        if self.product is not None:
            tree["product"] = self.product
        if self.bucket:
            tree["bucket"] = self.bucket
        if self.product is None:
            rows = [{"product": name, "share": share} for name, share in self.products]
            tree["portion"] = {"product": rows}
        if self.has_load_cell:
            tree["weigh_bucket"] = {"load_cell": {}}
        if self.move is not None:
            tree.setdefault("weigh_bucket", {})["move"] = list(self.move)
        for key, value in sorted(self.changes.items()):
            if key.startswith("weigh_bucket.load_cell.") and not self.has_load_cell:
                continue
            *sections, last = key.split(".")
            below = tree
            for section in sections:
                below = below.setdefault(section, {})
            below[last] = value
        return tree

    def to_toml(self) -> str:
        """The text of the TOML file."""
        return dump_toml(self.to_tree())

    def read_scene(self, folder: Path) -> Scene:
        """The scene that the file makes in a folder. Raises SceneError."""
        return parse_scene(self.to_toml(), folder / "new.toml")


def read_design(tree: Tree) -> Design:
    """The design of a scene's tree that the app wrote. Raises SceneError for a scene that has more
    in it.
    """
    found = Design(bucket=str(tree.get("bucket", "")))
    if isinstance(tree.get("product"), str):
        found = replace(found, products=((tree["product"], 1.0),))
    elif rows := tree.get("portion", {}).get("product"):
        found = replace(
            found, products=tuple((row["product"], float(row["share"])) for row in rows)
        )
    weigh_bucket = tree.get("weigh_bucket", {})
    found = replace(found, has_load_cell="load_cell" in weigh_bucket)
    if len(move := weigh_bucket.get("move", ())) == 3:
        x, y, z = map(float, move)
        found = replace(found, move=(x, y, z))
    for key in FIELDS:
        below: Any = tree
        for part in key.split("."):
            below = below.get(part) if isinstance(below, dict) else None
        if below is not None:
            found = found.with_change(key, float(below))
    if found.to_tree() != tree:
        raise SceneError(
            "this scene has keys that these pages do not show; allowed: dem-jax run on the command line"
        )
    return found


def read_number(scene: Scene, key: str) -> float | None:
    """The value (SI) of a key of a scene; None: it has none."""
    item: Any = scene
    for part in key.split("."):
        item = getattr(item, part, None)
    return None if item is None else float(item)


def find_field_errors(design: Design, folder: Path) -> dict[str, str]:
    """Key -> what is wrong with its value; the key "" where no field is to blame."""
    return _check_fields(design, folder)[1]


def drop_wrong_changes(design: Design, folder: Path) -> Design:
    """The design without the changes that ``find_field_errors`` names."""
    return _check_fields(design, folder)[0]


def _check_fields(design: Design, folder: Path) -> tuple[Design, dict[str, str]]:
    """The design without wrong changes, and what is wrong with each."""
    errors: dict[str, str] = {}
    tried = design
    while True:
        try:
            tried.read_scene(folder)
            return tried, errors
        except SceneError as error:
            text = str(error)
            key = next((name for name in tried.changes if name in text), "")
            errors[key] = explain_error(text, key)
            if not key:
                return tried, errors
            tried = tried.with_change(key, None)


def explain_error(text: str, key: str) -> str:
    """A message of a scene for the field of a key: without what the field says itself, in its unit."""
    _, found, after = text.partition(f"{key} = ") if key else ("", "", "")
    if not found or key not in FIELDS or ": allowed: " not in after:
        return text.split("new.toml: ", 1)[-1]
    return f"allowed: {FIELDS[key].allowed}"


def name_program(design: Design) -> str:
    """A text that is equal for designs that certainly share a compiled program, but for the number
    of drops.
    """
    changed = ("portion.", "material.")
    kept = {key: item for key, item in sorted(design.changes.items()) if key.startswith(changed)}
    number = (design.runs, draws_numbers(design))
    parts = (design.products, design.bucket, design.move, design.has_load_cell, number, kept)
    return repr(parts)


def draws_numbers(design: Design) -> bool:
    """Whether each drop of a design has numbers of its own from the ranges of the product."""
    return design.uncertain and design.runs > 1


def name_run_command(design: Design, stem: str) -> list[str]:
    """The command that computes a design's scene in the file STEM.toml into STEM.h5."""
    files = ["--seed", str(design.seed), "--out", f"{stem}.h5", "--no-plot"]
    if design.runs == 1:
        return ["dem-jax", "run", f"{stem}.toml", *files]
    drawn = ["--uncertain"] if draws_numbers(design) else []
    return ["dem-jax", "ensemble", f"{stem}.toml", "--runs", str(design.runs), *drawn, *files]


def write_product(stl: str, unit: float, weight: float, is_convex: bool, like: Tree) -> str:
    """The TOML text of a product of one's own.

    Args:
        stl: name of the file beside it.
        unit: m per unit of the file.
        weight: (kg) of a piece, in the place of a density.
        is_convex: whether its hull stands for it, else it is cut into convex parts.
        like: tree of the product whose material and contact law it has.
    """
    shape = "hull" if is_convex else "decomposed"
    portion = {"shape": shape, "stl": stl, "unit": unit, "piece_weight": weight}
    material = {key: item for key, item in like.get("material", {}).items() if key != "density"}
    modulus = like.get("evidence", {}).get("youngs_modulus", {})
    if "range" in modulus:
        material["youngs_modulus_range"] = modulus["range"]
    contact = {"contact": like["contact"]} if "contact" in like else {}
    return dump_toml({"portion": portion, "material": material, **contact})


def write_bucket(
    stl: str, unit: float, turn: Sequence[float], move: Sequence[float], centre: bool
) -> str:
    """The TOML text of a weigh bucket of one's own, which stays closed, under the feed bucket of
    2.9 litres.

    Args:
        stl: name of the file beside it.
        unit: m per unit of the file.
        turn: (degrees) about x, y and z.
        move: (m) along x, y and z, after the turn.
        centre: whether the middle of its mouth is put under the feed bucket first.
    """
    own = {"stl": stl, "unit": unit, "rotate_deg": list(turn), "move": list(move), "centre": centre}
    return dump_toml({"weigh_bucket": {**own, "opening_angle_deg": 0.0}})


def write_study(scene: str, title: str, key: str, values: Sequence[float], seeds: int) -> str:
    """The TOML text of a study of one key: drops at each value, with the step for quick answers."""
    outputs = ["peak", "peak_10ms", "time_to_rest", "time_to_weigh"]
    head: Tree = {
        "title": title,
        "scene": scene,
        "seeds": seeds,
        "design": "grid",
        "draft": True,
        "outputs": outputs,
    }
    text = FIELDS[key]
    label = text._replace(unit=BASE_UNITS.get(text.unit, text.unit)).title
    return dump_toml({**head, "parameter": {key: {"values": list(values), "label": label}}})
