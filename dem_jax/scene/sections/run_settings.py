"""How a scene is run."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import NotNegative, Parameter, Positive, Section, Vector

Error = Annotated[float, Field(gt=0, le=0.2)]
ROUNDING = 1e-9  # relative: times that differ by less are the same


def read_draft(value: Any) -> Any:
    """The table that "draft" stands for; anything else as it is."""
    return {"draft": True} if value == "draft" else value


class Accuracy(Section):
    """The errors of a single impact that are accepted, relative: the time step follows from them
    (dem_jax.assembly.time_step).
    """

    restitution: Error | None = Field(None, description="of the speed of rebound")
    peak_force: Error | None = None
    draft: bool = Field(False, description='twice the default step; run.accuracy = "draft"')

    @model_validator(mode="after")
    def _says_something(self) -> "Accuracy":
        if self.draft and (self.restitution is not None or self.peak_force is not None):
            raise ValueError("draft = true: allowed without restitution and peak_force")
        if self.draft:
            return self
        if self.restitution is None and self.peak_force is None:
            raise ValueError(
                "missing: restitution, peak_force; at least one must be given: a number > 0 and <= 0.2"
            )
        return self


class RunSettings(Section):
    """How a scene is run and what is kept."""

    duration: Positive = Field(0.2, description="s, from the release of the portion")
    until_settled: bool = Field(
        False, description="end settling and run as soon as all pieces are at rest"
    )
    settled_speed: Positive = Field(
        0.01, description="m/s, all pieces are at rest if they have been slower for settled_time"
    )
    settled_time: Positive = Field(
        0.02, description="s, after the last motion of a wall; see settled_speed"
    )
    sample_interval: Positive = Field(30e-6, description="s between samples")
    time_step: Literal["auto"] | Positive = Field("auto", description='s, or "auto"')
    allow_unstable_step: bool = Field(
        False,
        description="let a step be longer than the stable one, so that impacts gain more than 1 % of their energy",
    )
    accuracy: Annotated[Accuracy | None, BeforeValidator(read_draft)] = Field(
        None,
        description='instead of time_step: { restitution = 0.01, peak_force = 0.001 }, relative errors, or "draft", twice the default step',
    )
    precision: Literal["f32", "f64"] = "f32"
    gravity: Parameter[Vector] = Field((0.0, 0.0, -9.81), description="m/s2")
    frame_interval: NotNegative = Field(1e-3, description="s between stored poses; 0: none")
    track_energy: bool = Field(
        True, description="keep the energy ledger: dissipated energy and work of walls"
    )
    domain_low: Vector | None = Field(
        None, description="m; a piece below this has left the scene; unset: from the walls"
    )
    domain_high: Vector | None = Field(None, description="m")
    on_escape: Literal["stop", "warn"] = Field(
        "stop",
        description='a piece that leaves the domain stops the run, or is noted in the file and flies on: "warn"',
    )
    max_rebuild_interval: int = Field(
        48, ge=1, le=65536, description="most steps for which candidate pairs are kept"
    )
    sizes: Literal["exact", "classes"] = Field(
        "exact",
        description="of arrays; classes: numbers of pieces and hull features are rounded up, so that drops share compiled programs",
    )
    broad_phase: Literal["auto", "all-pairs", "cells", "jax-md"] = Field(
        "auto", description="broad phase; auto: all pairs for few pieces, cells for many"
    )

    @model_validator(mode="after")
    def _has_one_step(self) -> "RunSettings":
        if self.accuracy is not None and self.time_step != "auto":
            raise ValueError(
                f'time_step = {self.time_step:g}: beside accuracy, from which the step follows; allowed: "auto"'
            )
        return self

    @model_validator(mode="after")
    def _samples_within_its_duration(self) -> "RunSettings":
        if self.sample_interval > self.duration * (1 + ROUNDING):
            raise ValueError(
                f"sample_interval = {self.sample_interval:g}: longer than run.duration = {self.duration:g}; allowed: at most the duration"
            )
        return self
