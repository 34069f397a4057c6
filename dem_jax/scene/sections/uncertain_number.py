"""Numbers of a scene that are known within a range only."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import Section, as_tuple


def _is_rising(pair: tuple[float, float]) -> tuple[float, float]:
    """The pair. Raises ValueError unless the first is below the second."""
    if pair[0] >= pair[1]:
        raise ValueError(f"range = {list(pair)}: allowed: low, high, the first below the second")
    return pair


Range = Annotated[tuple[float, float], BeforeValidator(as_tuple), AfterValidator(_is_rising)]
Distribution = Literal["uniform", "log-uniform"]


class UncertainNumber(Section):
    """A number that is known within a range only: ``ensemble --uncertain`` draws it for each run."""

    key: str = Field(
        description="dotted key of a number of this scene, such as material.restitution"
    )
    range: Range = Field(description="low, high: between which it is drawn")
    distribution: Distribution = Field(
        "uniform", description="log-uniform for numbers known to a factor, such as moduli"
    )

    @model_validator(mode="after")
    def _has_a_logarithm(self) -> "UncertainNumber":
        if self.distribution == "log-uniform" and self.range[0] <= 0:
            raise ValueError(
                f'range = {list(self.range)}: allowed with distribution = "log-uniform": numbers above 0'
            )
        return self
