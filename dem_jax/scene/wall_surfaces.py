"""Wall surfaces by name: by what friction and pull-off of pieces on them differ from those on
smooth stainless steel.
"""

from typing import Literal, NamedTuple

SurfaceName = Literal["stainless", "galvanised", "dimpled", "ptfe"]


class WallSurface(NamedTuple):
    """Factors on ``friction_wall`` and ``pull_off``, which products have for smooth stainless
    steel.
    """

    friction: float
    friction_range: tuple[float, float]  # 5 and 95 %
    pull_off: float
    grade: Literal["A", "B", "C"]  # as of dem_jax.scene.evidence.GRADES
    source: str


SURFACES: dict[str, WallSurface] = {
    "stainless": WallSurface(
        1.0, (1.0, 1.0), 1.0, "A", "the surface that friction_wall of products is for"
    ),
    "galvanised": WallSurface(
        1.3,
        (1.0, 1.4),
        1.0,
        "B",
        "Yalcin, Ozarslan and Akbas 2007, J. Food Eng. 79, 731-735: dry pea on stainless steel 0.270 to 0.311, on galvanised iron "
        "0.360 to 0.409",
    ),
    "dimpled": WallSurface(
        0.85,
        (0.6, 1.1),
        0.4,
        "C",
        "judgement: less area of contact; sticky pieces come off more easily",
    ),
    "ptfe": WallSurface(
        0.7,
        (0.5, 0.8),
        1.0,
        "B",
        "Kostaropoulos, Mandala, Saravacos and Spiess 1997, J. Food Eng. 33, 385-393, doi:10.1016/S0260-8774(97)00037-X: raisins "
        "on PTFE more than 30 % below those on PVC; no comparison with stainless steel was found",
    ),
}
