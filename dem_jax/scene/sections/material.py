"""What pieces and walls are made of."""

import re
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import (
    InheritedParameter,
    NotNegative,
    Parameter,
    Positive,
    Section,
    SwitchedParameter,
    as_tuple,
)
from dem_jax.scene.wall_surfaces import SurfaceName

DEFAULT_NAME, WALL_NAME = "default", "wall"  # names of [material] in [[pair]]: of pieces, and of
# walls, that name no other

RANGE_HELP = "Pa, low and high, that the real modulus of the pieces is likely within: the band of the peak follows, nothing else"


def _is_rising(pair: tuple[float, float]) -> tuple[float, float]:
    """The pair. Raises ValueError unless the first is not above the second."""
    if pair[0] > pair[1]:
        raise ValueError(
            f"youngs_modulus_range = {list(pair)}: allowed: low, high, the first not above the second"
        )
    return pair


Restitution = Annotated[float, Field(gt=0, le=1)]
PoissonRatio = Annotated[float, Field(ge=0, lt=0.5)]
ModulusRange = Annotated[
    tuple[Positive, Positive], BeforeValidator(as_tuple), AfterValidator(_is_rising)
]


class NamedMaterial(Section):
    """A material that pieces or walls name; what it does not set is as in [material]."""

    density: InheritedParameter[Positive | None] = Field(None, description="kg/m3, pieces")
    youngs_modulus: InheritedParameter[Positive | None] = Field(
        None,
        description="Pa: E_p of pieces, E_b of walls; unset: youngs_modulus or wall_youngs_modulus of [material]",
    )
    youngs_modulus_range: ModulusRange | None = Field(None, description=RANGE_HELP)
    poisson_ratio: InheritedParameter[PoissonRatio | None] = Field(
        None, description="unset: poisson_ratio or, of walls, wall_poisson_ratio of [material]"
    )
    restitution: InheritedParameter[Restitution | None] = Field(
        None, description="epsilon of eq. 6, of pieces"
    )
    friction_piece: InheritedParameter[NotNegative | None] = Field(
        None, description="mu between pieces"
    )
    friction_wall: InheritedParameter[NotNegative | None] = Field(
        None, description="mu between such a piece and a wall"
    )
    rolling_friction: InheritedParameter[NotNegative | None] = Field(
        None, description="mu_r of such a piece, on pieces and on walls"
    )
    pull_off: InheritedParameter[NotNegative | None] = Field(
        None, description="N, largest adhesive force of a contact, of pieces"
    )
    wall_surface: SurfaceName | None = Field(
        None, description="of walls: changes friction_wall and pull_off of pieces on them"
    )


class Material(Section, extra="allow"):
    """What pieces and walls are made of, and the contact law's parameters. Values are the paper's
    (section 4.2).

    Tables in it, ``[material.NAME]``, are materials by name: ``scene.material.named``.
    """

    __pydantic_extra__: dict[str, NamedMaterial]

    density: Parameter[Positive] = Field(300.0, description="kg/m3, pieces")
    youngs_modulus: Parameter[Positive] = Field(1.0e8, description="Pa, pieces (E_p)")
    youngs_modulus_range: ModulusRange | None = Field(None, description=RANGE_HELP)
    wall_youngs_modulus: Parameter[Positive] = Field(1.0e11, description="Pa, walls (E_b)")
    restitution: Parameter[Restitution] = Field(0.1, description="epsilon of eq. 6")
    friction_piece: Parameter[NotNegative] = Field(0.7, description="mu between pieces")
    friction_wall: Parameter[NotNegative] = Field(0.3, description="mu between piece and wall")
    rolling_friction: Parameter[NotNegative] = Field(
        0.0,
        description="mu_r of pieces, on pieces and on walls: tangent of the slope on which a sphere just stays",
    )
    numerical_softening: Parameter[Positive] = Field(0.01, description="NSF, on both moduli")
    stiffness_length: str = Field(
        "equivalent-diameter", description="L of eqs 7-8, a name of shapes.SIZE_LENGTHS"
    )
    separation_slope_ratio: Parameter[float] = Field(
        0.001, ge=0, lt=1, description="lambda of eq. 1"
    )
    tangential_stiffness_ratio: Parameter[Positive] = Field(1.0, description="K_t / K_nl")
    unloading_damping: SwitchedParameter[float] = Field(
        0.0, ge=0, le=1, description="damping ratio of the unloading branch; 0: as in the paper"
    )
    rest_damping: SwitchedParameter[float] = Field(
        0.0,
        ge=0,
        le=0.5,
        description="damping ratio of contacts at rest, not during impacts; 0.2 stops creep; 0: as in the paper",
    )
    poisson_ratio: Parameter[PoissonRatio] = Field(0.3, description="pieces")
    wall_poisson_ratio: Parameter[PoissonRatio] = Field(0.3, description="walls")
    pull_off: Parameter[NotNegative] = Field(
        0.0, description="N, largest adhesive force of a contact"
    )
    wall_surface: SurfaceName = Field(
        "stainless",
        description="of walls: changes friction_wall and pull_off of pieces on them by its factors",
    )

    @property
    def named_materials(self) -> dict[str, NamedMaterial]:
        """The materials by name, in the order in which they were written."""
        return dict(self.__pydantic_extra__ or {})

    @model_validator(mode="after")
    def _has_good_names(self) -> "Material":
        for name in self.named_materials:
            if name in (DEFAULT_NAME, WALL_NAME) or not re.fullmatch(
                r"[A-Za-z][A-Za-z0-9_-]*", name
            ):
                words = f'a letter, then letters, digits, "_" and "-", and neither "{DEFAULT_NAME}" nor "{WALL_NAME}"'
                raise ValueError(f"a table by the name of {name!r}; allowed: {words}")
        return self


class Pair(Section):
    """What holds between two materials; what a pair does not set, and pairs that are not listed,
    follow these rules.

    Two pieces of one material: its restitution, friction_piece, rolling_friction and pull_off. Two
    pieces of different materials: the arithmetic mean of both. A piece and a wall: the restitution,
    friction_wall, rolling_friction and pull_off of the piece's material, friction_wall and pull_off
    times the factors of the wall's wall_surface. Stiffness follows from both moduli, eq. 5.
    Materials by name hold for pieces and walls alike: ``of = ["gummy", "gummy"]`` is said of two
    pieces and of a piece on a wall.
    """

    of: Annotated[tuple[str, str], BeforeValidator(as_tuple)] = Field(
        description=f'names of two materials, in any order; [material] itself is "{DEFAULT_NAME}" of pieces, "{WALL_NAME}" of walls'
    )
    restitution: InheritedParameter[Restitution | None] = Field(
        None, description="epsilon of eq. 6"
    )
    friction: InheritedParameter[NotNegative | None] = Field(None, description="mu")
    rolling_friction: InheritedParameter[NotNegative | None] = Field(None, description="mu_r")
    pull_off: InheritedParameter[NotNegative | None] = Field(
        None, description="N, largest adhesive force of a contact"
    )

    @model_validator(mode="after")
    def _says_something(self) -> "Pair":
        keys = [key for key in type(self).model_fields if key != "of"]
        if all(getattr(self, key) is None for key in keys):
            raise ValueError(f"missing: {', '.join(keys)}; at least one must be given")
        return self
