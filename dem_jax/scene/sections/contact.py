"""Which contact law, and its parameters beside those of [material]."""

from typing import Literal

from dem_jax.scene.sections.base import Section
from dem_jax.scene.sections.material import Material

LawName = Literal["walton-braun", "linear-dashpot"]

# Keys that belong to some laws only, by section and key: the laws that have them.
OF_LAWS = {
    ("material", "separation"): ("walton-braun",),
    ("material", "unloading_damping"): ("walton-braun",),
    ("material", "tangential_stiffness"): ("walton-braun", "linear-dashpot"),
}


class Contact(Section):
    """The contact law."""

    law: LawName = "walton-braun"


def stray_key(contact: Contact, material: Material) -> str | None:
    """What is wrong, in words, if a key of another law is set; None if none is."""
    for (section, key), laws in OF_LAWS.items():
        where = contact if section == "contact" else material
        if contact.law not in laws and getattr(where, key) != type(where).model_fields[key].default:
            of = " or ".join(f'"{law}"' for law in laws)
            return f'{section}.{key} = {getattr(where, key):g}: law "{contact.law}" has no such key; allowed: with law {of}'
    return None
