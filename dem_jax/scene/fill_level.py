"""How much a bucket holds: to where water would rise in it, its volume and its mouth, from panels
as seen from above.

The height of the surface is taken on a grid of points from above; walls between the points are as
high as their highest point. Water that is poured in anywhere rises to the lowest pass on the way
out: the least over all ways to the outside of the highest point of a way, which is that of the way
along a minimum spanning tree of the grid. What lies beneath an overhang is not seen.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from dem_jax.math.loops import area_vector

GRID_CELLS = 200  # of the grid along the longer side of a bucket
SLIT_WIDTH = 0.004  # m: slits no wider than this, as between two flaps, hold pieces
PACKING_FRACTION = 0.6  # volume of pieces over that of a heap of them: an assumption, loose heaps
# of most shapes have 0.55 to 0.65


class BucketCapacity(NamedTuple):
    """What a bucket holds to its brim, as it stands.

    volume: (m3). bottom, brim: heights (m) of its deepest point and of the water's surface. low,
    high: [2] (m) corners of the box around the mouth, the surface of the water, in x and y. middle:
    [2] (m) its centroid, or where this is as near as the grid tells the middle of the bucket.
    surface: HeightMap of its inside; is_wet: [nx, ny] bool, cells below the water.
    """

    volume: float
    bottom: float
    brim: float
    low: np.ndarray
    high: np.ndarray
    middle: np.ndarray
    surface: "HeightMap"
    is_wet: np.ndarray


class HeightMap(NamedTuple):
    """Heights (m) on a grid of cells seen from above, -inf where there is nothing.

    origin: [2] (m) low corner of the first cell. cell: (m) its side. floor: [nx, ny] at the middle
    of each cell. ridge: [nx, ny] the highest point within the cell.
    """

    origin: np.ndarray
    cell: float
    floor: np.ndarray
    ridge: np.ndarray


def find_capacity(panels: Sequence[np.ndarray]) -> BucketCapacity | None:
    """What the largest basin of some panels [k, 3] (m) holds; None: they hold nothing."""
    return _find_cached_capacity(
        tuple(np.ascontiguousarray(panel, np.float64).tobytes() for panel in panels)
    )


def find_mouth_middle(panels: Sequence[np.ndarray]) -> np.ndarray:
    """The middle [2] (m) of the mouth of a bucket of panels [k, 3] (m), in x and y; of one that
    holds nothing that of the box around it.
    """
    capacity = find_capacity(panels)
    return _box_middle(panels) if capacity is None else capacity.middle


def _box_middle(panels: Sequence[np.ndarray]) -> np.ndarray:
    """The middle [2] (m) of the box around panels, in x and y."""
    points = np.concatenate(panels)[:, :2]
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


@lru_cache(maxsize=32)
def _find_cached_capacity(panels: tuple[bytes, ...]) -> BucketCapacity | None:
    from scipy import ndimage

    corners = [np.frombuffer(panel).reshape(-1, 3) for panel in panels]
    surface, of_box = map_heights(corners), _box_middle(corners)
    closed = _close_slits(surface)
    level = _find_water_level(closed)
    ground = np.where(np.isfinite(surface.floor), surface.floor, surface.ridge)
    is_wet = (level > closed + 1e-9) & np.isfinite(ground)
    basins, count = ndimage.label(is_wet)
    if not count:
        return None
    depth = np.subtract(level, ground, out=np.zeros_like(level), where=is_wet)
    largest = 1 + int(np.argmax(ndimage.sum_labels(depth, basins, np.arange(1, count + 1))))
    is_wet = basins == largest
    brim = float(level[is_wet].max())
    # cells that walls cross
    is_wet |= ndimage.binary_dilation(is_wet) & (surface.floor < brim) & np.isfinite(surface.floor)
    columns = np.argwhere(is_wet)
    points = surface.origin + surface.cell * (columns + 0.5)
    middle = points.mean(axis=0)
    is_symmetric = (np.abs(middle - of_box) <= surface.cell).all()  # as far as the grid tells
    return BucketCapacity(
        volume=float((brim - ground[is_wet]).sum() * surface.cell**2),
        bottom=float(ground[is_wet].min()),
        brim=brim,
        low=points.min(axis=0) - 0.5 * surface.cell,
        high=points.max(axis=0) + 0.5 * surface.cell,
        middle=of_box if is_symmetric else middle,
        surface=surface,
        is_wet=is_wet,
    )


def map_heights(panels: Sequence[np.ndarray], like: HeightMap | None = None) -> HeightMap:
    """The heights of convex panels [k, 3] (m) seen from above; like: on the grid of this map."""
    if like is None:
        points = np.concatenate(panels)[:, :2]
        low, high = points.min(axis=0), points.max(axis=0)
        cell = float((high - low).max()) / GRID_CELLS
        margin = int(np.ceil(SLIT_WIDTH / cell)) + 2  # of cells with nothing around
        shape = tuple((np.ceil((high - low) / cell - 1e-9).astype(int) + 2 * margin).tolist())
        like = HeightMap(low - margin * cell, cell, np.full(shape, -np.inf), np.empty(0))
    floor = np.full(like.floor.shape, -np.inf)
    ridge = np.full(like.floor.shape, -np.inf)
    for panel in panels:
        _raise_floor(floor, like, panel)
        _raise_ridge(ridge, like, panel)
    return HeightMap(like.origin, like.cell, floor, np.maximum(floor, ridge))


def _raise_floor(floor: np.ndarray, grid: HeightMap, panel: np.ndarray) -> None:
    """Raise the heights at the middles of cells to those of a convex panel above them."""
    flat = (panel[:, :2] - grid.origin) / grid.cell - 0.5  # in which the middle of cell i is at i
    first = np.maximum(np.ceil(flat.min(axis=0)).astype(int), 0)
    last = np.minimum(np.floor(flat.max(axis=0)).astype(int), np.array(floor.shape) - 1)
    normal = area_vector(panel)
    if (last < first).any() or abs(normal[2]) <= 1e-9 * np.linalg.norm(normal):
        return
    x, y = np.meshgrid(
        *(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)), indexing="ij"
    )
    edges = np.roll(flat, -1, axis=0) - flat
    side = [ex * (y - py) - ey * (x - px) for (px, py), (ex, ey) in zip(flat, edges, strict=True)]
    inside = (np.sign(normal[2]) * np.array(side) >= -1e-9).all(axis=0)
    slope = -grid.cell * normal[:2] / normal[2]
    height = panel[0, 2] + (x - flat[0, 0]) * slope[0] + (y - flat[0, 1]) * slope[1]
    part = floor[first[0] : last[0] + 1, first[1] : last[1] + 1]
    np.maximum(part, np.where(inside, height, -np.inf), out=part)


def _raise_ridge(ridge: np.ndarray, grid: HeightMap, panel: np.ndarray) -> None:
    """Raise the highest points of cells to those of the edges of a panel; a wall is as high as its
    upper edge.
    """
    ends = np.roll(panel, -1, axis=0)
    for start, end in zip(panel, ends, strict=True):
        steps = 2 + int(2 * np.linalg.norm(end[:2] - start[:2]) / grid.cell)
        points = start + np.linspace(0.0, 1.0, steps)[:, None] * (end - start)
        cells = np.floor((points[:, :2] - grid.origin) / grid.cell - 1e-9).astype(int)
        there = ((cells >= 0) & (cells < ridge.shape)).all(axis=1)
        np.maximum.at(ridge, tuple(cells[there].T), points[there, 2])


def _close_slits(surface: HeightMap) -> np.ndarray:
    """The height [nx, ny] (m) of the highest point in each cell, slits filled; below all of it
    where there is nothing.
    """
    from scipy import ndimage

    slit = 2 * int(np.ceil(0.5 * SLIT_WIDTH / surface.cell)) + 1  # cells
    height = np.where(
        np.isfinite(surface.ridge),
        surface.ridge,
        np.min(surface.ridge[np.isfinite(surface.ridge)]) - 1.0,
    )
    return np.maximum(height, ndimage.grey_closing(height, size=(slit, slit)))


def _find_water_level(height: np.ndarray) -> np.ndarray:
    """The height [nx, ny] (m) to which water rises in each cell of ``_close_slits``, that of the
    ground where it runs off.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    low = height.min()
    number = np.arange(height.size).reshape(height.shape)
    pairs = [(number[1:], number[:-1], np.maximum(height[1:], height[:-1]))]
    pairs += [(number[:, 1:], number[:, :-1], np.maximum(height[:, 1:], height[:, :-1]))]
    drains = number[height <= low]  # nothing is there: the first of them is outside
    pairs += [(drains[1:], np.full(len(drains) - 1, drains[0]), np.full(len(drains) - 1, low))]
    a, b, over = (np.concatenate([row[k].ravel() for row in pairs]) for k in range(3))
    graph = coo_array((over - low + 1.0, (a, b)), shape=(height.size, height.size)).tocsr()
    order, before = breadth_first_order(minimum_spanning_tree(graph), drains[0], directed=False)
    level = height.ravel().copy()
    for cell in order[1:].tolist():
        level[cell] = max(level[cell], level[before[cell]])
    return level.reshape(height.shape)
