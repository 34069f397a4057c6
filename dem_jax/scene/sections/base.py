"""What every section of a scene shares: no unknown keys, no wrong types, only finite numbers of a
size that can be.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from dem_jax.deprecation import warn_of_name
from dem_jax.scene.former_keys import accept_section, find_attribute
from dem_jax.scene.toml_text import format_value


def as_tuple(value: Any) -> Any:
    """A list as a tuple; anything else as it is."""
    return tuple(value) if isinstance(value, list) else value


@dataclass(frozen=True)
class ParameterMark:
    """Marks a key whose value enters arrays only, so that it can be a parameter of a compiled
    program.

    is_switch: with 0 in the scene the program has nothing of it, and it is no parameter.
    is_inherited: unset, other keys stand for it, and it may be given nevertheless.
    """

    is_switch: bool = False
    is_inherited: bool = False


T = TypeVar("T")
Parameter = Annotated[T, ParameterMark()]
SwitchedParameter = Annotated[T, ParameterMark(is_switch=True)]
InheritedParameter = Annotated[T, ParameterMark(is_inherited=True)]

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[tuple[float, float, float], BeforeValidator(as_tuple)]
Quaternion = Annotated[tuple[float, float, float, float], BeforeValidator(as_tuple)]
Size = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(as_tuple)]
Points = Annotated[tuple[Vector, ...], BeforeValidator(as_tuple)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(as_tuple)]
PLACING_KEYS = ("unit", "rotate_deg", "move")  # keys of how an STL is placed
StlUnit = Annotated[Positive, Field(description="m per unit of an STL: 1e-3 of millimetres")]
StlTurn = Annotated[
    Vector, Field(description="degrees, rotation of an STL about x, then y, then z of the scene")
]
StlMove = Annotated[Vector, Field(description="m, displacement of an STL after its rotation")]
MaterialName = Annotated[
    str | None, Field(description="name of a [material.NAME]; unset: [material] itself")
]


LARGEST_NUMBER = 1e30  # of any number: what it is multiplied with must not take it beyond single
# precision, 3e38
ALLOWED_NUMBERS = (
    f"numbers whose size is {1 / LARGEST_NUMBER:g} to {LARGEST_NUMBER:g}, and 0 where that may be"
)

NUMBERS = float, int
NUMBERS_OR_TUPLE = *NUMBERS, tuple


class Section(BaseModel):
    """A table of a scene: unknown keys, wrong types and values that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    if not TYPE_CHECKING:  # a type checker knows the names of now

        def __getattr__(self, name: str) -> Any:
            renamed = find_attribute(type(self).__name__, name)
            if renamed is None:
                return super().__getattr__(name)
            warn_of_name(f"{type(self).__name__}.{name}", renamed)
            return getattr(self, renamed)

    @model_validator(mode="before")
    @classmethod
    def _accept_former_keys(cls, given: Any) -> Any:
        return accept_section(given, cls.__name__)

    @model_validator(mode="after")
    def _is_of_this_world(self) -> Self:
        for key, item in self.__dict__.items():  # its fields
            if not isinstance(item, NUMBERS_OR_TUPLE):
                continue
            if isinstance(item, float) and 0 < abs(item) < 1 / LARGEST_NUMBER:
                raise ValueError(f"{key} = {item:.3g}: allowed: {ALLOWED_NUMBERS}")
            for number in _iterate_numbers(item):
                if abs(number) > LARGEST_NUMBER:
                    shown = (
                        f"{number:.3g}"
                        if isinstance(number, float) or number < 10**15
                        else "a large whole number"
                    )
                    raise ValueError(f"{key} = {shown}: allowed: {ALLOWED_NUMBERS}")
        return self


def check_needed(section: BaseModel, keys: Iterable[str], is_needed: bool, why: str) -> None:
    """Raise ValueError for the first of some keys that is not at its default, unless they are
    needed; why: they are not.
    """
    for key in () if is_needed else keys:
        item = getattr(section, key)
        if item != type(section).model_fields[key].default:
            shown = "" if isinstance(item, BaseModel) else f" = {format_value(item)}"
            raise ValueError(f"{key}{shown}: cannot act {why}; allowed: to leave it out")


def _iterate_numbers(item: Any) -> Iterator[float]:
    """Those in a value, however deep in tuples."""
    if isinstance(item, NUMBERS):
        yield item
    elif isinstance(item, tuple):
        for each in item:
            yield from _iterate_numbers(each)
