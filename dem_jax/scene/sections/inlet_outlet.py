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
    waiting: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="pieces outside initially; unset: as many as in the portion",
    )
    start: float = Field(0.0, ge=0, description="s after the release")
    end: Positive | None = Field(None, description="s; unset: until the end of the run")
    every: Positive = Field(0.05, description="s between insertions")
    low: Vector | None = Field(
        None,
        description="m; box of the insertion; unset: above the rear of the feeder, or the feed bucket",
    )
    high: Vector | None = Field(None, description="m")
    velocity: Vector = Field((0.0, 0.0, 0.0), description="m/s, initial velocity")

    @model_validator(mode="after")
    def _is_a_span_and_a_box(self) -> "Inlet":
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end = {self.end:g}: allowed: after start = {self.start:g}")
        if (self.low is None) != (self.high is None):
            raise ValueError(
                f"{'low' if self.low is None else 'high'}: missing; allowed: both corners, or none"
            )
        if (
            self.low is not None
            and self.high is not None
            and any(a > b for a, b in zip(self.low, self.high, strict=True))
        ):
            raise ValueError(f"low = {list(self.low)}: allowed: not above high = {list(self.high)}")
        return self


class Outlet(Section):
    """A height below which pieces are taken out of the scene, and counted."""

    below: float | None = Field(
        None,
        description="m, height of their centres; unset: a piece's size below all walls at rest",
    )
    every: Positive = Field(0.05, description="s between removals")
