"""Walls, how they move, and the boxes in which settled mass is counted."""

from pydantic import Field, model_validator

from dem_jax.scene.sections.base import (
    PLACING_KEYS,
    MaterialName,
    NotNegative,
    Numbers,
    Parameter,
    Points,
    Positive,
    Section,
    StlMove,
    StlTurn,
    StlUnit,
    SwitchedParameter,
    Vector,
    check_needed,
)

HINGE_KEYS = (
    "opening_start",
    "opening_time",
    "hold_time",
    "closing_time",
    "period",
    "drive",
)  # keys of a motion that
# swings
# of one that vibrates
VIBRATION_KEYS = (
    "frequency",
    "vibration_start",
    "vibration_end",
    "vibration_ramp",
    "vibration_period",
)
NAME_PATTERN = r"^[.]*[A-Za-z0-9_-][A-Za-z0-9_.-]*$"  # not of dots alone: in a file, that is a
# group itself


class Wall(Section):
    """A convex panel, or the panels of an STL, in a named group."""

    group: str = Field(min_length=1, pattern=NAME_PATTERN)
    corners: Points | None = Field(
        None, description="m, of a convex planar polygon, counter-clockwise seen by the pieces"
    )
    stl: str | None = Field(
        None, description="file, relative to the scene's; facets face the pieces"
    )
    unit: StlUnit = 1.0
    rotate_deg: StlTurn = (0.0, 0.0, 0.0)
    move: StlMove = (0.0, 0.0, 0.0)
    thickness: Positive = Field(0.01, description="m, behind the surface")
    material: MaterialName = None
    note: str | None = Field(
        None, description="said with the results; what was read of an STL is written here"
    )

    @model_validator(mode="after")
    def _places_an_stl(self) -> "Wall":
        check_needed(
            self,
            PLACING_KEYS,
            self.corners is None or self.stl is not None,
            "beside corners, which are m of the scene",
        )
        return self


class Drive(Section):
    """What swings a flap with a limited torque: a servo, or a slipping clutch.

    Plausible values (named assumptions) for a small stepping motor, as of size NEMA 23, behind a
    sheet of 0.2 kg.
    """

    torque: Parameter[Positive] = Field(1.0, description="N m, at most, about the hinge")
    inertia: Parameter[Positive] = Field(
        1e-3, description="kg m2 about the hinge, of the flap and everything that rotates with it"
    )
    natural_frequency: Parameter[Positive] = Field(
        15.0, description="Hz, of the return to the prescribed motion"
    )
    damping_ratio: Parameter[NotNegative] = Field(
        1.0, description="fraction of the critical damping"
    )


class Motion(Section):
    """How a wall group moves: about a hinge, by a table, vibrating, or several of these. Times are
    from the release.

    A hinge goes along with what a table moves, and all of it vibrates.
    """

    group: str
    pivot: Vector = Field((0.0, 0.0, 0.0), description="m, a point of the hinge's axis")
    axis: Vector = Field((1.0, 0.0, 0.0), description="direction of the hinge")
    opening_angle_deg: SwitchedParameter[float] = Field(
        0.0, description="degrees, opening angle of the flap, right-handed about the axis"
    )
    opening_start: Parameter[float] = Field(0.0, description="s")
    opening_time: Parameter[Positive] = Field(0.08, description="s")
    hold_time: Parameter[NotNegative] = Field(0.1, description="s, hold time of the open flap")
    closing_time: Parameter[Positive] = Field(0.09, description="s")
    period: Parameter[NotNegative] = Field(0.0, description="s; 0: once")
    drive: Drive | None = Field(None, description="drive of the flap; unset: unlimited torque")
    stroke: SwitchedParameter[Vector] = Field(
        (0.0, 0.0, 0.0), description="m, amplitude of the vibration"
    )
    frequency: Parameter[NotNegative] = Field(50.0, description="Hz")
    vibration_start: Parameter[float] = Field(0.0, description="s")
    vibration_end: Parameter[float] = Field(1e3, description="s")
    vibration_ramp: Parameter[Positive] = Field(0.02, description="s, to full amplitude and back")
    vibration_period: NotNegative = Field(
        0.0, description="s from one beginning of the vibration to the next; 0: once"
    )
    table: str | None = Field(
        None,
        description="CSV file, relative to the scene's, with columns time (s) and angle_deg, x, y or z (m)",
    )
    times: Numbers | None = Field(
        None, description="s, instead of a table; at rest before the first and after the last"
    )
    angles_deg: Parameter[Numbers | None] = Field(
        None, description="degrees, angles at these times, right-handed about the axis"
    )
    displacements: Parameter[Points | None] = Field(
        None, description="m at these times, from where the walls are given"
    )

    @model_validator(mode="after")
    def _has_what_its_keys_act_on(self) -> "Motion":
        check_needed(
            self,
            HINGE_KEYS,
            "opening_angle_deg" in self.model_fields_set,
            "without opening_angle_deg",
        )
        check_needed(self, VIBRATION_KEYS, "stroke" in self.model_fields_set, "without a stroke")
        return self


class Region(Section):
    """A box in which settled mass is counted."""

    name: str = Field(pattern=NAME_PATTERN)
    low: Vector = Field(description="m")
    high: Vector = Field(description="m")
