"""Statistics of the collisions with walls."""

from pydantic import Field, model_validator

from dem_jax.scene.sections.base import NotNegative, Positive, Section


class Statistics(Section):
    """Collisions of the pieces with each group of walls: number, impact speeds, impulse, energy,
    and a map over each panel.
    """

    min_speed: NotNegative = Field(
        0.01,
        description="m/s; slower contacts, such as those of ringing pieces at rest, are not counted",
    )
    max_speed: Positive = Field(
        4.0, description="m/s; the last bin contains all faster impacts as well"
    )
    speed_bins: int = Field(
        40, ge=1, le=1000, description="bins of impact speeds, of equal width from 0 to the fastest"
    )
    map_resolution: int = Field(
        16, ge=1, le=256, description="cells of the map along each side of the box around a panel"
    )

    @model_validator(mode="after")
    def _has_speeds_between(self) -> "Statistics":
        if self.min_speed >= self.max_speed:
            raise ValueError(
                f"min_speed = {self.min_speed:g}: allowed: below max_speed = {self.max_speed:g}"
            )
        return self
