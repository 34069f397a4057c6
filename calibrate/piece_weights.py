"""Weight of one piece from the scene that a trace file carries as TOML text."""

import math
import tomllib
from collections.abc import Callable, Sequence
from typing import Any

from scipy.spatial import ConvexHull, QhullError

from calibrate.errors import BadInput

MARSHMALLOW, CHAMFER = (0.055, 0.023, 0.016), 0.005  # m, the paper's chamfered cuboid at SF = 1


def _chamfered_cuboid(size: Sequence[float] = MARSHMALLOW, chamfer: float = CHAMFER) -> float:
    x, y, z = size
    return (x * y - 2.0 * chamfer**2) * z


def _prism(radius: float, height: float, sides: int) -> float:
    return 0.5 * sides * math.sin(2.0 * math.pi / sides) * radius**2 * height


def _hull(points: Sequence[Sequence[float]], unit: float = 1.0) -> float:
    return ConvexHull(points).volume * unit**3


VOLUMES: dict[str, Callable[..., float]] = {
    "sphere": lambda radius: 4.0 / 3.0 * math.pi * radius**3,
    "cuboid": lambda size: math.prod(size),
    "chamfered-cuboid": _chamfered_cuboid,
    "prism": _prism,
    "cylinder": lambda radius, height, sides=None: math.pi * radius**2 * height,
    "hull": _hull,
}
SIZES = ("size", "chamfer", "radius", "height", "sides", "points", "unit")


def _volume(piece: dict[str, Any]) -> float | None:
    """(m3) of the named shape with its own sizes; None if the text does not contain it (a hull in a
    separate file).
    """
    shape, scale = piece.get("shape", "chamfered-cuboid"), float(piece.get("scale_factor") or 1.0)
    sizes = {name: piece[name] for name in SIZES if piece.get(name) is not None}
    sizes = {name: value for name, value in sizes.items() if name != "unit" or shape == "hull"}
    try:
        return scale**3 * VOLUMES[shape](**sizes)
    except (KeyError, TypeError, ValueError, QhullError):
        return None


def piece_mass(scene: str) -> float | None:
    """(kg) of one piece of the scene's portion, None if the text does not contain it (pieces of
    different weights, a hull in a separate file).

    Raises `BadInput` where the text is not TOML.
    """
    try:
        tree = tomllib.loads(scene)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"scene of the file: not TOML ({error})") from None
    portion = tree.get("portion") or {}
    if "piece_mass" in portion:
        return float(portion["piece_mass"])
    listed = tree.get("piece") or portion.get("product") or ([portion] if portion else [])
    known = (_mass(piece, tree.get("material", {})) for piece in listed)
    masses = [mass for mass in known if mass is not None]
    if not masses or len(masses) < len(listed) or max(masses) > (1.0 + 1e-9) * min(masses):
        return None
    return masses[0]


def _mass(piece: dict[str, Any], material: dict[str, Any]) -> float | None:
    """(kg) of a piece by its own weight, or of the scene's material or of one by name; None if the
    text does not contain it.
    """
    if piece.get("size_spread") or piece.get("piece_weight_spread"):
        return None
    if piece.get("piece_weight") is not None:
        return float(piece["piece_weight"])
    volume = _volume(piece)
    if volume is None:
        return None
    own = material.get(piece.get("material") or "", {})
    return volume * float(own.get("density", material.get("density", 300.0)))
