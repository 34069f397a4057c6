"""Weight of one piece from the scene that a trace file carries as TOML text."""

import math
import tomllib

from calibrate.errors import BadInput

MARSHMALLOW = 19440e-9  # m3, the paper's chamfered cuboid at SF = 1


def _volume(portion: dict) -> float | None:
    """(m3) of the named shape with its own sizes; None where only a mesh knows."""
    shape, scale = portion.get("shape"), float(portion.get("scale_factor") or 1.0)
    if shape == "sphere" and portion.get("radius"):
        return scale**3 * 4.0 / 3.0 * math.pi * portion["radius"] ** 3
    if shape == "cuboid" and portion.get("size"):
        return scale**3 * math.prod(portion["size"])
    if shape == "chamfered-cuboid" and not portion.get("size"):
        return scale**3 * MARSHMALLOW
    return None


def piece_mass(scene: str) -> float | None:
    """(kg) of one piece of the scene's portion, None where the text does not tell (pieces of different or meshed
    shapes).

    Raises `BadInput` where the text is not TOML.
    """
    try:
        tree = tomllib.loads(scene)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"scene of the file: not TOML ({error})") from None
    portion = tree.get("portion") or {}
    if "piece_mass" in portion:
        return float(portion["piece_mass"])
    listed = tree.get("piece") or [portion]
    density = float(tree.get("material", {}).get("density", 300.0))
    volumes = {_volume(piece) for piece in listed}
    volume = volumes.pop() if len(volumes) == 1 else None
    return None if volume is None else volume * density
