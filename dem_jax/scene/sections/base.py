"""What every section of a scene shares: no unknown keys, no wrong types, only finite numbers."""

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def as_tuple(value: Any) -> Any:
    """A list as a tuple; anything else as it is."""
    return tuple(value) if isinstance(value, list) else value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[tuple[float, float, float], BeforeValidator(as_tuple)]
Quaternion = Annotated[tuple[float, float, float, float], BeforeValidator(as_tuple)]
Size = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(as_tuple)]
Points = Annotated[tuple[Vector, ...], BeforeValidator(as_tuple)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(as_tuple)]
MaterialName = Annotated[str | None, Field(description="name of a [material.NAME]; unset: [material] itself")]


class Section(BaseModel):
    """A table of a scene: unknown keys, wrong types and values that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
