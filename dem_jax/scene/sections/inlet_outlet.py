"""Where pieces come into a scene, and where they leave it."""

from pydantic import Field, model_validator

from dem_jax.scene.sections.base import Positive, Section, Vector


class Inlet(Section):
    """New pieces, like the portion's, that fall from a box at a mass rate, each where it touches no
    other.

    They wait outside the scene until then; with an ``[outlet]`` removed pieces wait again. They
    need no recompilation.
    """

    mass_rate: Positive = Field(description="kg/s")
    reservoir: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="pieces outside initially; unset: as many as in the portion",
    )
    start: float = Field(0.0, ge=0, description="s after the release")
    end: Positive | None = Field(None, description="s; unset: until the end of the run")
    interval: Positive = Field(0.05, description="s between insertions")
    box_low: Vector | None = Field(
        None,
        description="m; box of the insertion; unset: above the rear of the feeder, or the feed bucket",
    )
    box_high: Vector | None = Field(None, description="m")
    velocity: Vector = Field((0.0, 0.0, 0.0), description="m/s, initial velocity")

    @model_validator(mode="after")
    def _is_a_span_and_a_box(self) -> "Inlet":
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end = {self.end:g}: allowed: after start = {self.start:g}")
        if (self.box_low is None) != (self.box_high is None):
            raise ValueError(
                f"{'box_low' if self.box_low is None else 'box_high'}: missing; allowed: both corners, or none"
            )
        if (
            self.box_low is not None
            and self.box_high is not None
            and any(a > b for a, b in zip(self.box_low, self.box_high, strict=True))
        ):
            raise ValueError(
                f"box_low = {list(self.box_low)}: allowed: not above box_high = {list(self.box_high)}"
            )
        return self


class Outlet(Section):
    """A height below which pieces are taken out of the scene, and counted."""

    z_max: float | None = Field(
        None,
        description="m, height of their centres; unset: a piece's size below all walls at rest",
    )
    interval: Positive = Field(0.05, description="s between removals")
