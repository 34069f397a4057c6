"""Statistics of the collisions with walls."""

from pydantic import Field, model_validator

from dem_jax.scene.sections.base import NotNegative, Positive, Section


class Statistics(Section):
    """Collisions of the pieces with each group of walls: number, impact speeds, impulse, energy,
    and a map over each panel.
    """

    slowest: NotNegative = Field(
        0.01,
        description="m/s; slower contacts, such as those of ringing pieces at rest, are not counted",
    )
    fastest: Positive = Field(
        4.0, description="m/s; the last bin contains all faster impacts as well"
    )
    speeds: int = Field(
        40, ge=1, le=1000, description="bins of impact speeds, of equal width from 0 to the fastest"
    )
    cells: int = Field(
        16, ge=1, le=256, description="cells of the map along each side of the box around a panel"
    )

    @model_validator(mode="after")
    def _has_speeds_between(self) -> "Statistics":
        if self.slowest >= self.fastest:
            raise ValueError(
                f"slowest = {self.slowest:g}: allowed: below fastest = {self.fastest:g}"
            )
        return self
