"""Which contact law, and its parameters beside those of [material]."""

from typing import Literal

from pydantic import Field

from dem_jax.scene.sections.base import NotNegative, Parameter, Positive, Section
from dem_jax.scene.sections.material import Material

LawName = Literal[
    "walton-braun", "linear-dashpot", "hertz-mindlin", "densifying", "elastic-plastic"
]

# Keys that belong to some laws only, by section and key: the laws that have them.
LAW_KEYS = {
    ("material", "separation_slope_ratio"): ("walton-braun",),
    ("material", "unloading_damping"): ("walton-braun",),
    ("material", "rest_damping"): ("walton-braun",),
    ("material", "tangential_stiffness_ratio"): (
        "walton-braun",
        "linear-dashpot",
        "densifying",
        "elastic-plastic",
    ),
    ("contact", "max_impact_speed"): ("hertz-mindlin", "densifying", "elastic-plastic"),
    ("contact", "yield_pressure"): ("elastic-plastic",),
    ("contact", "densification"): ("densifying",),
}
HERTZIAN_LAWS = ("hertz-mindlin", "elastic-plastic")  # laws whose stiffness follows from the
# curvature of bodies


class Cohesion(Section):
    """How bodies hold on to each other, where a pull_off is more than 0
    (dem_jax.contact_laws.cohesion).
    """

    stiffness: Parameter[Positive] = Field(
        1.0, description="of the tension, relative to the two bodies in series (eqs 5, 7 and 8)"
    )
    interaction_range: NotNegative = Field(
        1e-4, description="m, gap over which the tension decreases from pull_off to 0"
    )


class Contact(Section):
    """The contact law. Cohesion comes to it with material.pull_off or pair.pull_off."""

    law: LawName = "walton-braun"
    max_impact_speed: Positive = Field(
        5.0,
        description='m/s, the fastest impact that the time step resolves; law "hertz-mindlin", "densifying", "elastic-plastic"',
    )
    densification: Parameter[Positive] = Field(
        0.2,
        description='overlap at which a foam is solid, as fraction of the size L of the smaller body; law "densifying"',
    )
    yield_pressure: Parameter[Positive] = Field(
        1e6,
        description='Pa, contact pressure at which pieces yield, with moduli times softening; law "elastic-plastic"',
    )
    cohesion: Cohesion = Cohesion()
    smooth_angle_deg: float = Field(
        20.0,
        ge=0,
        le=45,
        description="panels of a wall group that meet at no more are one smooth surface, touched once",
    )


def find_stray_key(contact: Contact, material: Material) -> str | None:
    """What is wrong, in words, if a key of another law is set; None if none is."""
    for (section, key), laws in LAW_KEYS.items():
        where = contact if section == "contact" else material
        if contact.law not in laws and getattr(where, key) != type(where).model_fields[key].default:
            of = " or ".join(f'"{law}"' for law in laws)
            return f'{section}.{key} = {getattr(where, key):g}: law "{contact.law}" has no such key; allowed: with law {of}'
    return None
