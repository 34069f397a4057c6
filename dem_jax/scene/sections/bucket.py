"""Buckets and the linear feeder, from few named sizes."""

import math
from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import (
    PLACING_KEYS,
    MaterialName,
    NotNegative,
    Parameter,
    Points,
    Positive,
    Section,
    StlMove,
    StlTurn,
    StlUnit,
    SwitchedParameter,
    as_tuple,
    check_needed,
)
from dem_jax.scene.sections.noise_settings import Noise
from dem_jax.scene.sections.wall import Drive

RATED_DEFLECTION = 0.5e-3  # m, of a load cell at the rated load
STANDARD_GRAVITY = 9.81  # m/s2: of the rated load
Panels = Annotated[tuple[Points, ...], BeforeValidator(as_tuple)]


class Bucket(Section):
    """A bucket: four vertical walls and two flaps, hinged at two lower edges, that close to a V; or
    as STL files have it.

    The paper gives no geometry; these are plausible values for a 1.6 litre bucket (named
    assumptions).
    """

    opening_size: Annotated[tuple[Positive, Positive], BeforeValidator(as_tuple)] = Field(
        (0.14, 0.12), description="m, inner width along the hinges (x) and across them (y)"
    )
    wall_height: Positive = Field(0.13, description="m, of the vertical walls above the hinges")
    flap_angle_deg: float = Field(
        55.0, gt=0, lt=90, description="degrees of the closed flaps below the horizontal"
    )
    opening_angle_deg: SwitchedParameter[float] = Field(
        65.0, ge=0, le=150, description="degrees by which a flap opens"
    )
    opening_start: Parameter[float] = Field(0.0, description="s after the release")
    opening_time: Parameter[Positive] = Field(0.08, description="s")
    hold_time: Parameter[NotNegative] = Field(0.1, description="s")
    closing_time: Parameter[Positive] = Field(0.09, description="s")
    period: NotNegative = Field(0.0, description="s from one opening to the next; 0: it opens once")
    drive: Drive | None = Field(None, description="drive of each flap; unset: unlimited torque")
    thickness: Positive = Field(0.005, description="m, of walls and flaps")
    material: MaterialName = None
    panel_overlap: NotNegative = Field(
        0.012, description="m by which flaps and walls overlap behind each other where they meet"
    )
    stl: str | None = Field(
        None,
        description="file, relative to the scene's, of the walls, in the place of the sizes above; without flap_stl of all of the "
        "bucket. Facets face the pieces; the lowest point of the closed bucket is put where the lower edge of the flaps would be",
    )
    flap_stl: Annotated[tuple[str, str], BeforeValidator(as_tuple)] | None = Field(
        None,
        description="files of the closed flaps, placed as stl is, hinged along x at their highest edges: at -y, at y",
    )
    unit: StlUnit = 1.0
    rotate_deg: StlTurn = (0.0, 0.0, 0.0)
    move: StlMove = (0.0, 0.0, 0.0)
    centre: bool = Field(
        False,
        description="whether the middle of an STL bucket's mouth is put at x = y = 0, and moved on by the first two of move",
    )
    panels: Panels | None = Field(None, description="m, corners of each panel, in an STL's place")
    flap_panels: Annotated[tuple[Panels, Panels], BeforeValidator(as_tuple)] | None = Field(
        None, description="m, corners of the panels of both flaps, in flap_stl's place"
    )
    note: str | None = Field(
        None, description="printed with the results; data of STL files are written here"
    )

    @model_validator(mode="after")
    def _is_whole(self) -> "Bucket":
        if self.flap_stl and not self.stl or self.flap_panels and not self.panels:
            raise ValueError(
                "flap_stl, flap_panels: allowed beside the stl, or the panels, of the walls"
            )
        if self.stl and self.panels:
            raise ValueError("stl, panels: allowed: one of the two")
        check_needed(
            self,
            (*PLACING_KEYS, "centre"),
            bool(self.stl),
            "without stl: a bucket of sizes is where the drop puts it",
        )
        if self.drive and not self.opening_angle_deg:
            raise ValueError(
                "drive: opening_angle_deg = 0, the flaps stay shut; allowed: only for flaps that open"
            )
        if (
            self.stl and not self.flap_stl or self.panels and not self.flap_panels
        ) and self.opening_angle_deg:
            held = "flap_stl with a file for each flap, or opening_angle_deg = 0 of a bucket that stays shut"
            raise ValueError(
                f"opening_angle_deg = {self.opening_angle_deg:g}: the STL has no flaps of its own; allowed: {held}"
            )
        return self


class LoadCell(Section):
    """The load cell that carries a weigh bucket: a mass on a spring and a damper along the
    vertical.

    Plausible values (named assumptions) for an aluminium single-point cell such as HBK's SP4M or
    Tedea-Huntleigh's 1042, which bend by a few tenths of a millimetre at the rated load, and a
    bucket of 1 kg: 98 kN/m, 50 Hz.
    """

    mass: Parameter[Positive] = Field(
        1.0, description="kg without pieces: bucket, flaps and the moving part of the cell"
    )
    rated_load: Parameter[Positive] = Field(5.0, description="kg; a run prints a note beyond it")
    stiffness: Parameter[Positive | None] = Field(
        None,
        description="N/m; unset: from natural_frequency, or from 0.5 mm at the rated load if that is unset too",
    )
    natural_frequency: Parameter[Positive | None] = Field(
        None, description="Hz, of the mass without pieces, in place of the stiffness"
    )
    damping_ratio: Parameter[NotNegative] = Field(
        0.02, description="of the critical damping of the mass without pieces"
    )
    noise: Noise | None = Field(
        None, description="noise with which weigh shows the signal; unset: none"
    )

    def spring_stiffness(self) -> float:
        """Stiffness (N/m)."""
        if self.natural_frequency is not None:
            return self.mass * (2 * math.pi * self.natural_frequency) ** 2
        return (
            self.rated_load * STANDARD_GRAVITY / RATED_DEFLECTION
            if self.stiffness is None
            else self.stiffness
        )

    def damping_constant(self) -> float:
        """Damping (N s/m)."""
        from dem_jax.scene.array_namespace import sqrt  # here, as reading a scene needs no numpy

        return 2 * self.damping_ratio * sqrt(self.spring_stiffness() * self.mass)

    @model_validator(mode="after")
    def _has_one_spring(self) -> "LoadCell":
        if self.stiffness is not None and self.natural_frequency is not None:
            raise ValueError("stiffness, natural_frequency: allowed: one of the two")
        return self


class WeighBucket(Bucket):
    """A bucket that may hang on a load cell."""

    load_cell: LoadCell | None = Field(
        None, description="load cell that carries walls and flaps; unset: they are fixed"
    )


class Drop(Section):
    """Where the feed bucket is above the weigh bucket."""

    height: Parameter[Positive] = Field(
        0.25,
        description="m, from the lower edge of the closed feed flaps to that of the weigh flaps",
    )


class Feeder(Section):
    """A linear feeder: a vibrating pan, of sizes or of an STL file, whose lower end hangs over the
    feed bucket. Its pieces are like the portion's.

    The paper gives neither geometry nor vibration; these are plausible values (named assumptions).
    """

    count: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="pieces that lie on the pan at first; unset: as many as the portion has",
    )
    length: Positive = Field(0.28, description="m, of the pan along x")
    width: Positive = Field(0.09, description="m, inner width of the pan")
    wall_height: Positive = Field(0.06, description="m, of its sides")
    tilt_deg: float = Field(
        3.0, ge=0, lt=45, description="degrees by which the pan descends towards the bucket"
    )
    overhang: float = Field(
        0.0, description="m by which the edge of the pan stands over the inside of the feed bucket"
    )
    clearance: Positive = Field(
        0.02, description="m from the feed bucket's upper edge to that of the pan"
    )
    stroke: SwitchedParameter[NotNegative] = Field(
        4e-4, description="m, amplitude of the vibration"
    )
    stroke_angle_deg: float = Field(
        25.0, gt=0, lt=90, description="degrees of the stroke above the horizontal, forwards and up"
    )
    frequency: Parameter[Positive] = Field(50.0, description="Hz")
    start: Parameter[float] = Field(
        0.27,
        description="s after the release; by default when the flaps of the feed bucket are shut",
    )
    duration: Parameter[Positive] = Field(0.7, description="s of vibration")
    period: NotNegative = Field(
        0.0, description="s from one beginning of the vibration to the next; 0: once"
    )
    ramp: Parameter[Positive] = Field(0.02, description="s, to full amplitude and back")
    thickness: Positive = Field(0.005, description="m")
    material: MaterialName = None
    stl: str | None = Field(
        None,
        description="file, relative to the scene's, of the pan, in the place of its sizes. Facets face the pieces, which go along "
        "x; the end of its floor, the panels that look up, where x is greatest, is put where the edge of the pan would be",
    )
    unit: StlUnit = 1.0
    rotate_deg: StlTurn = (0.0, 0.0, 0.0)
    move: StlMove = (0.0, 0.0, 0.0)
    panels: Panels | None = Field(
        None, description="m, corners of each panel from the edge on, in an STL's place"
    )
    note: str | None = Field(
        None, description="printed with the results; data of an STL file are written here"
    )

    @model_validator(mode="after")
    def _is_one_pan(self) -> "Feeder":
        if self.stl and self.panels:
            raise ValueError("stl, panels: allowed: one of the two")
        check_needed(
            self,
            PLACING_KEYS,
            bool(self.stl),
            "without stl: a pan of sizes is where overhang and clearance put it",
        )
        return self
