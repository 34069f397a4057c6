"""Where the pieces of a portion begin: scattered at random, so that none overlap.

On a grid whose cells hold a piece in any orientation. Long pieces, and many, would make a column of
metres of it, whose last piece is still falling when the portion is released: they are stacked by
the boxes that they fill as they are turned.
"""

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import SceneError

MOST_PLACES = 10**8  # in a layer
TALLEST_GRID = 0.6  # m: a fall of 0.35 s
MOST_STACKED = 20_000  # pieces: a stack of them takes seconds
STACK_COLUMNS = 48  # of the height map of a stack, along each side of the region
STACK_TRIES = 16  # orientations and places looked at for each piece of a stack


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
    fit = count_places(bounding_radius, spacing, low, high)
    pitch = wide / fit
    layer = int(fit.prod())
    cells = np.concatenate(
        [layer * k + random.permutation(layer) for k in range(-(-number // layer))]
    )[:number]
    index = np.stack([cells % fit[0], cells // fit[0] % fit[1], cells // layer], axis=1)
    room = np.append(pitch, cell) - 2 * bounding_radius
    jitter = random.uniform(-0.5, 0.5, (number, 3)) * room
    positions = low + (index + 0.5) * np.append(pitch, cell) + jitter
    return positions, draw_orientations(number, random)


def count_places(
    bounding_radius: float, spacing: float, low: ArrayLike, high: ArrayLike
) -> np.ndarray:
    """Number of cells of the grid of ``scatter_pieces`` along x and y, [2] int. Raises SceneError
    for a box that is too narrow for one, or wide enough for too many.
    """
    cell = 2 * bounding_radius * spacing
    wide = (np.asarray(high, float) - np.asarray(low, float))[:2]
    fit = np.floor(np.minimum(wide / cell, MOST_PLACES) + 1e-9).astype(int)
    if (fit < 1).any():
        raise SceneError(
            f"portion: region of {wide[0]:g} x {wide[1]:g} m is too narrow for pieces of bounding diameter "
            f"{2 * bounding_radius:g} m; allowed: at least {cell:g} m each way (region_low, region_high, mouth)"
        )
    layer = int(fit.prod())
    if layer > MOST_PLACES:
        raise SceneError(
            f"portion: region of {wide[0]:g} x {wide[1]:g} m has room for {layer:.3g} pieces of bounding diameter "
            f"{2 * bounding_radius:g} m in a layer; allowed: at most {MOST_PLACES:.0e}"
        )
    return fit


def find_grid_height(
    number: int, bounding_radius: float, spacing: float, low: ArrayLike, high: ArrayLike
) -> float:
    """Height (m) of the grid of ``scatter_pieces``."""
    layer = int(count_places(bounding_radius, spacing, low, high).prod())
    return -(-number // layer) * 2 * bounding_radius * spacing


def stack_pieces(
    corners: np.ndarray, gap: float, low: ArrayLike, high: ArrayLike, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [number, 3] (m) of pieces that are stacked in random order by their boxes, so that
    no two can overlap; and the orientation chosen for each, [number] int.

    A piece is tried in each of its orientations, at a random place on the pieces before it; the
    lowest is taken. The box is filled from below and left upwards if it is too small.

    Args:
        corners: [number, tries, 2, 3] (m), lowest and highest corner of the box of each piece in
        each orientation, about its centre of mass.
        gap: (m), between two boxes.
        low, high: [3] (m), corners of the region; wide enough for every box.
        random: generator.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    wide = (high - low)[:2]
    sizes = corners[:, :, 1] - corners[:, :, 0] + gap
    places = random.uniform(0, 1, (*sizes.shape[:2], 2)) * np.maximum(wide - sizes[..., :2], 0)
    first = (places / wide * STACK_COLUMNS).astype(int)
    last = np.ceil((places + sizes[..., :2]) / wide * STACK_COLUMNS).astype(int)
    height = np.zeros((STACK_COLUMNS, STACK_COLUMNS))
    begins, chosen = np.empty((len(corners), 3)), np.empty(len(corners), int)
    for k in random.permutation(len(corners)):
        below = np.array(
            [height[i:m, j:n].max() for (i, j), (m, n) in zip(first[k], last[k], strict=True)]
        )
        best = int(np.argmin(below + sizes[k, :, 2]))
        (i, j), (m, n) = first[k, best], last[k, best]
        height[i:m, j:n] = below[best] + sizes[k, best, 2]
        begins[k], chosen[k] = (*places[k, best], below[best]), best
    taken = corners[np.arange(len(corners)), chosen]
    return low + begins + 0.5 * gap - taken[:, 0], chosen


def draw_orientations(number: int, random: np.random.Generator) -> np.ndarray:
    """Quaternions [number, 4], uniform over all rotations."""
    q = random.normal(size=(number, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)
