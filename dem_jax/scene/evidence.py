"""The evidence behind the numbers of a product: its range, its grade and its source, beside them in
the product's file.

A product's file has a table ``[evidence.NAME]`` for each number that was looked for: a key of its
``[material]`` or ``[portion]``, or ``piece_weight``, ``volume`` and ``extent`` of a piece.
``[state.NAME]`` has the sections that differ in another state of the product, such as thawing.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from dem_jax.errors import SceneError
from dem_jax.scene.messages import format_error, suggest_choices
from dem_jax.scene.sections.base import Section, Size, as_tuple
from dem_jax.scene.sections.material import Material
from dem_jax.scene.sections.piece import Portion
from dem_jax.scene.sections.uncertain_number import Range
from dem_jax.scene.toml_text import align_columns

Tree = dict[str, Any]

GRADES = {"A": "measured on the product", "B": "measured on a close relative", "C": "judgement"}
LEGEND = "; ".join(f"{grade}: {words}" for grade, words in GRADES.items())
PIECE_UNITS = {"piece_weight": "kg", "volume": "m3", "extent": "m"}  # numbers that the shape and
# the density make
LOG_UNIFORM_KEYS = ("youngs_modulus", "pull_off")  # numbers known to a factor only: drawn uniformly
# by their logarithm
RANGE_KEY = "youngs_modulus_range"  # key of [material] that follows from the evidence


class Evidence(Section):
    """What is known of one number of a product."""

    value: Annotated[float | Size | None, BeforeValidator(as_tuple)] = Field(
        None,
        description="of a piece's weight (kg), volume (m3) or extent (m); of other numbers it is in their own section",
    )
    range: Range | None = Field(None, description="5 and 95 %, in the unit of the number")
    grade: Literal["A", "B", "C"] = Field(description=LEGEND)
    source: str = Field(
        "judgement", description="author, year, journal; judgement where nothing was measured"
    )
    address: str = Field("", description="DOI or address of the source")
    says: str = Field(
        "", description="numbers that the source gives, with the conditions of the measurement"
    )
    note: str = Field("", description="how the value follows from them")

    @model_validator(mode="after")
    def _names_its_source(self) -> "Evidence":
        measured = self.grade != "C"
        for key in ("address", "says"):
            if measured and not getattr(self, key):
                raise ValueError(
                    f"{key}: missing; grade {self.grade} needs source, address and says"
                )
        if measured and self.source == "judgement":
            raise ValueError(
                f'source = "judgement": allowed with grade "C"; grade {self.grade} is {GRADES[self.grade]}'
            )
        return self


def read_evidence(tree: Tree, source: str) -> dict[str, Evidence]:
    """The evidence of a product's file.

    Args:
        tree: of the file.
        source: begins the messages of errors.

    Returns:
        Name of a number -> its evidence.

    Raises:
        SceneError: a row is not valid, names no number of the product, or its value is outside of
        its range.
    """
    found = {}
    known = {*PIECE_UNITS, *tree.get("material", {}), *tree.get("portion", {})}
    for name, row in _iterate_tables(tree, "evidence", source):
        if name not in known:
            raise SceneError(
                f"{source}: evidence.{name}: no number of the product; {suggest_choices(name, sorted(known))}"
            )
        try:
            found[name] = Evidence.model_validate(row)
        except ValidationError as error:
            raise SceneError(
                f"{source}: evidence.{name}.{format_error(error, row, Evidence)}"
            ) from error
        _check_value(tree, name, found[name], source)
    return found


def _check_value(tree: Tree, name: str, row: Evidence, source: str) -> None:
    """Raise SceneError where a number has two values, none, or one outside of its range."""
    value = find_evidence_value(tree, name, row)
    if (row.value is not None) != (name in PIECE_UNITS):
        wanted = (
            "to give it"
            if name in PIECE_UNITS
            else "to leave it out, as the number stands in its own section"
        )
        raise SceneError(f"{source}: evidence.{name}.value = {row.value}: allowed: {wanted}")
    if (
        row.range is not None
        and isinstance(value, float | int)
        and not row.range[0] <= value <= row.range[1]
    ):
        raise SceneError(
            f"{source}: {name} = {value:g}: outside of evidence.{name}.range = {list(row.range)}"
        )


def find_evidence_value(tree: Tree, name: str, row: Evidence) -> Any:
    """The number of a product that a row of evidence is about."""
    own = {**tree.get("portion", {}), **tree.get("material", {})}
    return row.value if row.value is not None else own.get(name)


def read_states(tree: Tree, source: str) -> dict[str, Tree]:
    """The further states of a product: name -> the sections that differ in it. Raises SceneError."""
    return dict(_iterate_tables(tree, "state", source))


def select_state(tree: Tree, state: str | None, source: str) -> Tree:
    """The tree of a product in one of its states (None: the one that its file begins with). Raises
    SceneError.
    """
    plain = {key: item for key, item in tree.items() if key != "state"}
    if state is None:
        return plain
    known = read_states(tree, source)
    if state not in known:
        allowed = suggest_choices(state, sorted(known)) if known else "it has one state only"
        raise SceneError(f"{source}: no state {state!r}; {allowed}")
    for section, rows in known[state].items():
        below = plain.get(section, {})
        plain[section] = (
            below | rows if isinstance(below, dict) and isinstance(rows, dict) else rows
        )
    return plain


def extract_scene_sections(tree: Tree, source: str) -> Tree:
    """The sections of a product that a scene takes: without the evidence, but with the ranges that
    follow from it.

    Raises SceneError.
    """
    rows = read_evidence(tree, source)
    out = {key: item for key, item in tree.items() if key != "evidence"}
    uncertain = list(_iterate_uncertain(rows))
    modulus = rows.get("youngs_modulus")
    if modulus is not None and modulus.range is not None:
        out["material"] = {RANGE_KEY: list(modulus.range), **out.get("material", {})}
    return out | ({"uncertain": uncertain} if uncertain else {})


def _iterate_uncertain(rows: dict[str, Evidence]) -> Iterator[Tree]:
    """Rows of [[uncertain]]: of each number of [material] that has a range."""
    for name, row in rows.items():
        if row.range is not None and name in Material.model_fields:
            how = "log-uniform" if name in LOG_UNIFORM_KEYS else "uniform"
            yield {"key": f"material.{name}", "range": list(row.range), "distribution": how}


def _iterate_tables(tree: Tree, key: str, source: str) -> Iterator[tuple[str, Tree]]:
    """Name and content of each table in a table. Raises SceneError for other values."""
    rows = tree.get(key, {})
    if not isinstance(rows, dict) or not all(isinstance(row, dict) for row in rows.values()):
        raise SceneError(f"{source}: {key}: allowed: tables [{key}.NAME]")
    yield from rows.items()


def describe_evidence(tree: Tree, source: str) -> list[str]:
    """The numbers of a product in lines of text: name, value, 5 to 95 %, grade and source. Raises
    SceneError.
    """
    rows = read_evidence(tree, source)
    table = [("number", "value", "5 to 95 %", "grade, source")]
    for name, row in rows.items():
        unit = find_number_unit(name)
        value, span = (
            _format_numbers(find_evidence_value(tree, name, row)),
            "" if row.range is None else " to ".join(map(_format_numbers, row.range)),
        )
        table.append((f"{name} ({unit})" if unit else name, value, span, _describe_origin(row)))
    return align_columns(table)


def find_number_unit(name: str) -> str:
    """The unit of a number of a product, "" for none."""
    if name in PIECE_UNITS:
        return PIECE_UNITS[name]
    model = Material if name in Material.model_fields else Portion
    text = model.model_fields[name].description or ""
    return next((unit for unit in ("kg/m3", "Pa", "N", "m") if text.startswith(f"{unit},")), "")


def _describe_origin(row: Evidence) -> str:
    """Grade and source of a number in words."""
    if row.grade == "C":
        return f"C, judgement{f': {row.note}' if row.note else ''}"
    return (
        f"{row.grade}, {row.source}, {row.address}: {row.says}{f'; {row.note}' if row.note else ''}"
    )


def _format_numbers(value: Any) -> str:
    """A number, or several, as text."""
    return (
        " x ".join(f"{each:.4g}" for each in value)
        if isinstance(value, list | tuple)
        else f"{value:.4g}"
    )
