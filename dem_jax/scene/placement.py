"""Where the pieces of a portion begin: scattered at random, so that none overlap."""

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import SceneError

MOST_PLACES = 10**8  # in a layer


def count_pieces(target_weight: float, piece_mass: float) -> int:
    """Number of pieces of a portion, eq. 16, rounded, at least 1."""
    return max(1, round(target_weight / piece_mass))


def scatter_pieces(
    number: int,
    bounding_radius: float,
    spacing: float,
    low: ArrayLike,
    high: ArrayLike,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [number, 3] (m) and orientations [number, 4] of pieces on a jittered grid, layer
    upon layer.

    The grid's cells hold the bounding sphere of a piece in any orientation, so that no two can
    overlap; which cells of a layer are filled, the place within a cell and the orientation are
    random. The box is filled from below and left upwards if it is too small. Raises SceneError if
    it is too narrow for one piece.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    cell = 2 * bounding_radius * spacing
    wide = (high - low)[:2]
    fit = np.floor(np.minimum(wide / cell, MOST_PLACES) + 1e-9).astype(int)
    if (fit < 1).any():
        raise SceneError(
            f"portion: region of {wide[0]:g} x {wide[1]:g} m is too narrow for pieces of bounding diameter "
            f"{2 * bounding_radius:g} m; allowed: at least {cell:g} m each way (region_low, region_high, mouth)"
        )
    pitch = wide / fit
    layer = int(fit.prod())
    if layer > MOST_PLACES:
        raise SceneError(
            f"portion: region of {wide[0]:g} x {wide[1]:g} m has room for {layer:.3g} pieces of bounding diameter "
            f"{2 * bounding_radius:g} m in a layer; allowed: at most {MOST_PLACES:.0e}"
        )
    cells = np.concatenate(
        [layer * k + random.permutation(layer) for k in range(-(-number // layer))]
    )[:number]
    index = np.stack([cells % fit[0], cells // fit[0] % fit[1], cells // layer], axis=1)
    room = np.append(pitch, cell) - 2 * bounding_radius
    jitter = random.uniform(-0.5, 0.5, (number, 3)) * room
    positions = low + (index + 0.5) * np.append(pitch, cell) + jitter
    return positions, draw_orientations(number, random)


def draw_orientations(number: int, random: np.random.Generator) -> np.ndarray:
    """Quaternions [number, 4], uniform over all rotations."""
    q = random.normal(size=(number, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)
