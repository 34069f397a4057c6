"""A note on mixtures whose stiffest product makes the time step far shorter than the others need."""

import numpy as np

from dem_jax.scene import Scene
from dem_jax.scene.material_properties import build_material_table

USUAL = 5e6  # Pa: E NSF of the stiff products of the library
STIFF = 4.0  # times as stiff: takes twice the steps
DIFFERENT = 10.0  # least ratio of the moduli of two products that need different steps


def note_stiff_mixture(scene: Scene) -> str | None:
    """A note if one product of a mixture is far stiffer than another and than it must be, as all
    share one softening; else None.
    """
    table, nsf = build_material_table(scene), scene.material.numerical_softening
    pieces = np.flatnonzero(~table.is_wall)
    softened = nsf * np.asarray(table.youngs_modulus)[pieces]
    stiffest, softest = int(np.argmax(softened)), int(np.argmin(softened))
    high, low = float(softened[stiffest]), float(softened[softest])
    if high < STIFF * USUAL or high < DIFFERENT * low:
        return None
    names = [table.names[pieces[k]] for k in (stiffest, softest)]
    inside = f"{names[0]}." if names[0] in scene.material.named_materials else ""
    return (
        f"all products share material.numerical_softening = {nsf:g}: E NSF is {high:.3g} Pa of {names[0]} and "
        f"{low:.3g} Pa of {names[1]}, and the time step is that of the stiffest; material.{inside}youngs_modulus = "
        f"{USUAL / nsf:.2g} takes {np.sqrt(high / USUAL):.2g} times fewer steps, and its impacts are so many times weaker"
    )
