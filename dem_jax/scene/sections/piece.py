"""Pieces, listed one by one or made by the scene."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import (
    MaterialName,
    Parameter,
    Points,
    Positive,
    Quaternion,
    Section,
    Size,
    Vector,
    as_tuple,
    check_needed,
)
from dem_jax.scene.toml_text import format_value

AnyShape = Literal[
    "chamfered-cuboid",
    "cuboid",
    "sphere",
    "prism",
    "cylinder",
    "hull",
    "tube",
    "compound",
    "decomposed",
]


class ConvexShape(Section):
    """A convex shape, with the sizes that it takes."""

    shape: Literal["chamfered-cuboid", "cuboid", "sphere", "prism", "cylinder", "hull"] = (
        "chamfered-cuboid"
    )
    scale_factor: Positive = Field(1.0, description="scale factor SF of all lengths")
    size: Size | None = Field(
        None, description="m, edges x, y, z of a cuboid; unset: the marshmallow's 55 x 23 x 16 mm"
    )
    chamfer: Positive | None = Field(
        None, description="m, chamfer of a chamfered cuboid; unset: 5 mm"
    )
    radius: Positive | None = Field(
        None, description="m, radius of a sphere, a cylinder or a prism (circumscribed)"
    )
    height: Positive | None = Field(None, description="m, height of a cylinder, a prism or a tube")
    sides: int | None = Field(
        None, ge=3, le=1000, description="number of sides of a prism, a cylinder or a tube"
    )
    points: Points | None = Field(None, description="m, point set of a hull")
    stl: str | None = Field(
        None,
        description="STL file of a hull or of a decomposed shape, relative to the scene's folder",
    )
    unit: Positive = Field(1.0, description="m, length of one unit of the STL file or the points")
    max_vertices: int | None = Field(
        None,
        ge=16,
        le=1_000_000,
        description="of a hull (unset: 128) or each decomposed part (16 to 32); more are simplified",
    )
    hull_tolerance: float | None = Field(
        None,
        gt=0,
        le=1,
        description="of a hull of an STL: fraction by which its volume may exceed the STL's; unset: 0.02",
    )

    @model_validator(mode="after")
    def _has_what_its_unit_is_of(self) -> "ConvexShape":
        check_needed(
            self,
            ("unit",),
            self.shape in ("hull", "decomposed"),
            "without an stl or points: sizes are in m",
        )
        return self


class Part(ConvexShape):
    """A convex part of a compound, in the axes of the whole."""

    position: Vector | None = Field(
        None,
        description="m, centre of mass; unset: a hull keeps the position of its points, other shapes are at the origin",
    )
    orientation: Quaternion = Field(
        (1.0, 0.0, 0.0, 0.0),
        description="quaternion w x y z, axes of the part to those of the whole",
    )


class BodyMass(Section):
    """Mass properties of a compound or a hull that are not those of its geometry, for uniform
    density.
    """

    volume: Positive = Field(description="m3")
    centre: Vector = Field(
        description="m, of mass, in the axes in which the parts or points are listed"
    )
    gyration: Annotated[
        tuple[float, float, float, float, float, float], BeforeValidator(as_tuple)
    ] = Field(description="m2, inertia over mass about the centre: xx, yy, zz, xy, xz, yz")


class PieceShape(ConvexShape):
    """The shape of a piece, with the sizes that it takes."""

    shape: AnyShape = "chamfered-cuboid"  # type: ignore[assignment]  # wider than of a part: nothing sets it, a row is frozen
    outer_radius: Positive | None = Field(None, description="m, of a tube")
    inner_radius: Positive | None = Field(None, description="m, of a tube")
    part: Annotated[tuple[Part, ...], BeforeValidator(as_tuple)] = Field(
        (),
        description="convex parts of a compound, with position and orientation, that touch or overlap",
    )
    mass_properties: BodyMass | None = Field(
        None,
        description="of a compound or a hull, before scaling; unset: the exact ones of the union of its parts",
    )
    coplanarity_tolerance: float | None = Field(
        None,
        gt=0,
        le=0.01,
        description="fraction of the size of a compound within which parts touch and are flush; unset: 1e-6",
    )
    concavity: float | None = Field(
        None, ge=0.01, le=1, description="at which decomposing cuts a part further; unset: 0.05"
    )
    max_parts: int | None = Field(
        None,
        ge=1,
        description="of what is decomposed; compiling takes in proportion to them; unset: 16",
    )
    max_volume_loss: Positive | None = Field(
        None,
        description="what decomposing may lose, as fraction of the volume and of the size; unset: 0.5, and it is reported",
    )
    piece_weight: Positive | None = Field(
        None, description="kg, weight of a piece of this size, instead of its material's density"
    )
    note: str | None = Field(
        None,
        description="printed with the results; contains changes by decomposition or simplification",
    )


SHAPE_KEYS = {
    "sphere": {"radius"},
    "cuboid": {"size"},
    "chamfered-cuboid": {"size", "chamfer"},
    "prism": {"sides", "radius", "height"},
    "cylinder": {"radius", "height", "sides"},
    "hull": {"points", "stl", "unit", "max_vertices", "hull_tolerance", "mass_properties"},
    "tube": {"outer_radius", "inner_radius", "height", "sides"},
    "compound": {"part", "mass_properties", "coplanarity_tolerance"},
    "decomposed": {"stl", "unit", "concavity", "max_parts", "max_volume_loss", "max_vertices"},
}


Spread = Annotated[
    float,
    Field(
        ge=0,
        le=0.5,
        description="relative standard deviation of the linear size, lognormal; 0: all are alike",
    ),
]
WeightSpread = Annotated[
    float,
    Field(
        ge=0,
        le=0.5,
        description="relative standard deviation of the weight, lognormal, in place of size_spread; 0: all are alike",
    ),
]


class Piece(PieceShape):
    """A piece listed one by one."""

    material: MaterialName = None

    position: Parameter[Vector] = Field(description="m, centre of mass")
    orientation: Parameter[Quaternion] = Field(
        (1.0, 0.0, 0.0, 0.0), description="quaternion w x y z, body to world"
    )
    velocity: Parameter[Vector] = Field((0.0, 0.0, 0.0), description="m/s")
    angular_velocity: Parameter[Vector] = Field((0.0, 0.0, 0.0), description="rad/s, world frame")


class Product(PieceShape):
    """One of several products that a portion is mixed of, with shape, material and share."""

    material: MaterialName = None
    share: Positive = Field(
        1.0, description="of the portion's weight or count (share_by), relative to the other shares"
    )
    size_spread: Spread = 0.0
    piece_weight_spread: WeightSpread = 0.0

    @model_validator(mode="after")
    def _has_one_spread(self) -> "Product":
        _check_one_spread(self)
        return self


MOST_PRODUCTS = 16
SPREAD_KEYS = ("size_spread", "piece_weight_spread")
PRODUCT_KEYS = {*PieceShape.model_fields, "material", *SPREAD_KEYS}  # keys of a portion that go to
# its products


class Portion(PieceShape):
    """Pieces made by the scene, at random by the seed: all of one product, or of several, one
    [[portion.product]] each.

    Beside products the keys of shape, material and size spread belong to each product. How many
    pieces there are of each, and of which sizes: dem_jax/assembly/portion_counts.py.
    """

    material: MaterialName = None
    size_spread: Spread = 0.0
    piece_weight_spread: WeightSpread = 0.0
    product: Annotated[tuple[Product, ...], BeforeValidator(as_tuple)] = ()
    share_by: Literal["weight", "count"] = Field(
        "weight", description="quantity that the shares of the products divide"
    )

    target_weight: Positive = Field(
        0.05, description="kg; eq. 16 gives the count, rounded, unless count is set"
    )
    count: int | None = Field(None, ge=1, le=1_000_000, description="number of pieces")
    arrangement: Literal["settled", "scattered"] = Field(
        "settled",
        description="settled in the closed feed bucket before time zero, or released as scattered",
    )
    settling_time: Positive = Field(
        0.5, description="s, time for the pieces to settle before time zero"
    )
    region_low: Vector | None = Field(
        None, description="m; box in which pieces are scattered; unset: the feed bucket"
    )
    region_high: Vector | None = Field(
        None, description="m; the box is filled from below, and exceeded upwards if it is too small"
    )
    spacing: float = Field(
        1.02,
        ge=1.0,
        description="spacing of the grid of scattered pieces, in bounding diameters; pieces that settle are "
        "stacked by their own boxes where the grid would be higher than 0.6 m",
    )

    @property
    def product_rows(self) -> "tuple[Product | Portion, ...]":
        """What shapes, materials and sizes are read from: the products, or the portion itself where
        it has none.
        """
        return self.product or (self,)

    @model_validator(mode="after")
    def _has_one_spread(self) -> "Portion":
        _check_one_spread(self)
        return self

    @model_validator(mode="after")
    def _leaves_shapes_to_its_products(self) -> "Portion":
        if len(self.product) > MOST_PRODUCTS:
            raise ValueError(f"{len(self.product)} products; allowed: at most {MOST_PRODUCTS}")
        for key, field in type(self).model_fields.items():
            if self.product and key in PRODUCT_KEYS and getattr(self, key) != field.default:
                raise ValueError(
                    f"{key} = {format_value(getattr(self, key))}: beside products; allowed: in each [[portion.product]]"
                )
        return self


def _check_one_spread(row: Product | Portion) -> None:
    """Raise ValueError for a row that gives the spread of its sizes and of its weights."""
    if row.size_spread and row.piece_weight_spread:
        raise ValueError(
            f"size_spread = {row.size_spread:g} beside piece_weight_spread = {row.piece_weight_spread:g}: each decides the other; "
            "allowed: one of the two, the other 0"
        )
