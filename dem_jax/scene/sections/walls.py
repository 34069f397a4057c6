"""Walls, how they move, and the boxes in which settled mass is counted."""

from pydantic import Field

from dem_jax.scene.sections.base import MaterialName, NotNegative, Points, Positive, Section, Vector


class Wall(Section):
    """A convex panel, or the panels of an STL, in a named group."""

    group: str = Field(min_length=1, pattern=r"^[A-Za-z0-9_.-]+$")
    corners: Points | None = Field(
        None, description="m, of a convex planar polygon, counter-clockwise seen by the pieces"
    )
    stl: str | None = Field(None, description="file, relative to the scene's; facets face the pieces")
    unit: Positive = Field(1.0, description="m per unit of the STL")
    thickness: Positive = Field(0.01, description="m, behind the surface")
    material: MaterialName = None


class Motion(Section):
    """How a wall group moves: about a hinge, and/or vibrating. Times are from the release of the portion."""

    group: str
    pivot: Vector = Field((0.0, 0.0, 0.0), description="m, a point of the hinge's axis")
    axis: Vector = Field((1.0, 0.0, 0.0), description="direction of the hinge")
    swing_deg: float = Field(0.0, description="degrees by which the flap opens, right-handed about the axis")
    start: float = Field(0.0, description="s")
    opening: Positive = Field(0.08, description="s")
    dwell: NotNegative = Field(0.1, description="s open")
    closing: Positive = Field(0.09, description="s")
    period: NotNegative = Field(0.0, description="s; 0: once")
    stroke: Vector = Field((0.0, 0.0, 0.0), description="m, amplitude of the vibration")
    frequency: NotNegative = Field(50.0, description="Hz")
    shake_start: float = Field(0.0, description="s")
    shake_end: float = Field(1e3, description="s")
    shake_ramp: Positive = Field(0.02, description="s, to full amplitude and back")


class Block(Section):
    """A box in which settled mass is counted."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    low: Vector = Field(description="m")
    high: Vector = Field(description="m")
