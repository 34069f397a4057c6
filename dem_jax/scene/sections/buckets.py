"""Buckets and the linear feeder, from few named sizes."""

from typing import Annotated

from pydantic import BeforeValidator, Field

from dem_jax.scene.sections.base import MaterialName, NotNegative, Positive, Section, as_tuple


class Bucket(Section):
    """A bucket: four vertical walls and two flaps, hinged at two lower edges, that close to a V.

    The paper gives no geometry; these are plausible values for a 1.6 litre bucket (named assumptions).
    """

    mouth: Annotated[tuple[Positive, Positive], BeforeValidator(as_tuple)] = Field(
        (0.14, 0.12), description="m, inner width along the hinges (x) and across them (y)"
    )
    wall_height: Positive = Field(0.13, description="m, of the vertical walls above the hinges")
    flap_angle_deg: float = Field(55.0, gt=0, lt=90, description="degrees of the closed flaps below the horizontal")
    opening_angle_deg: float = Field(65.0, ge=0, le=150, description="degrees by which a flap opens")
    opening_start: float = Field(0.0, description="s after the release")
    opening_time: Positive = Field(0.08, description="s")
    open_dwell: NotNegative = Field(0.1, description="s")
    closing_time: Positive = Field(0.09, description="s")
    thickness: Positive = Field(0.005, description="m, of walls and flaps")
    material: MaterialName = None
    lap: NotNegative = Field(0.012, description="m by which flaps and walls run on behind each other where they meet")


class Drop(Section):
    """Where the feed bucket is above the weigh bucket."""

    height: Positive = Field(
        0.25, description="m, from the lower edge of the closed feed flaps to that of the weigh flaps"
    )


class Feeder(Section):
    """A linear feeder: a vibrating pan whose lower end hangs over the feed bucket. Its pieces are like the portion's.

    The paper gives neither geometry nor vibration; these are plausible values (named assumptions).
    """

    count: int | None = Field(
        None, ge=1, le=1_000_000, description="pieces that lie on the pan at first; unset: as many as the portion has"
    )
    length: Positive = Field(0.28, description="m, of the pan along x")
    width: Positive = Field(0.09, description="m, inner width of the pan")
    wall_height: Positive = Field(0.06, description="m, of its sides")
    tilt_deg: float = Field(3.0, ge=0, lt=45, description="degrees by which the pan descends towards the bucket")
    overhang: float = Field(0.0, description="m by which the edge of the pan stands over the inside of the feed bucket")
    clearance: Positive = Field(0.02, description="m from the feed bucket's upper edge to that of the pan")
    stroke: NotNegative = Field(4e-4, description="m, amplitude of the vibration")
    stroke_angle_deg: float = Field(25.0, gt=0, lt=90, description="degrees of the stroke above the horizontal, forwards and up")
    frequency: Positive = Field(50.0, description="Hz")
    start: float = Field(0.27, description="s after the release; by default when the flaps of the feed bucket are shut")
    duration: Positive = Field(0.7, description="s of vibration")
    ramp: Positive = Field(0.02, description="s, to full amplitude and back")
    thickness: Positive = Field(0.005, description="m")
    material: MaterialName = None
