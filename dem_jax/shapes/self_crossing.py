"""Closed surfaces that cross themselves: their facets hold some of the space twice, or inside out."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError

if TYPE_CHECKING:
    from manifold3d import Manifold

RAYS_PER_EDGE = 32  # along each edge of the box around a body, in all three directions
MOST_SHARE = 1e-3  # of the volume: crossings that hold less are the noise of a scan


def check_single_cover(body: "Manifold", middle: np.ndarray, size: float, path: str | Path) -> None:
    """Raise SceneError for a surface that holds more than MOST_SHARE of its volume twice or inside
    out.

    Args:
        body: one closed surface, in units of ``size``, about ``middle``.
        middle: [3] (units of the file).
        size: (units of the file).
        path: the file, for messages.
    """
    volume = body.volume()
    if 0.0 <= body.hull().volume() - volume <= 1e-6 * volume:
        return
    length, wrong, place = _measure_cover(body, -1.0 if volume < 0.0 else 1.0)
    if wrong <= MOST_SHARE * length:
        return
    about = np.round(middle + size * place, 6).tolist()
    raise SceneError(
        f"stl = {str(path)!r} crosses itself: its surface holds {100 * wrong / length:.2g} % of the volume twice or inside out, "
        f"about {about} (units of the file); allowed: a surface that does not cross itself, or overlapping bodies that are "
        "closed surfaces of their own, which are united"
    )


def _measure_cover(body: "Manifold", sign: float) -> tuple[float, float, np.ndarray]:
    """Length of rays in a body, the length on which the winding number is not 0 or 1, and the
    centre [3] of that.

    sign: of the volume; the winding number of a body that is inside out is 0 or -1.
    """
    low, high = np.reshape(body.bounding_box(), (2, 3))
    inside, wrong, moment = 0.0, 0.0, np.zeros(3)
    for axis in range(3):
        for start in _ray_origins(low, high, axis):
            end = start.copy()
            end[axis] = high[axis] + 0.1
            hits = body.ray_cast(start.tolist(), end.tolist())
            at = np.array([hit.position[axis] for hit in hits])
            winding = np.cumsum([-sign * np.sign(hit.normal[axis]) for hit in hits])
            if len(at) < 2 or winding[-1] != 0:  # along a facet, or through an edge
                continue
            gap, within = np.diff(at), winding[:-1]
            is_wrong = (within > 1) | (within < 0)
            inside += gap[within != 0].sum()
            wrong += gap[is_wrong].sum()
            centre = np.tile(start, (len(gap), 1))
            centre[:, axis] = at[:-1] + 0.5 * gap
            moment += (gap * is_wrong) @ centre
    return inside, wrong, moment / wrong if wrong else moment


def _ray_origins(low: np.ndarray, high: np.ndarray, axis: int) -> np.ndarray:
    """[RAYS_PER_EDGE**2, 3] points below a box, evenly spaced; off its middle planes, where edges
    often lie."""
    share = (np.arange(RAYS_PER_EDGE) + 0.4871) / RAYS_PER_EDGE
    b, c = [k for k in range(3) if k != axis]
    grid = np.zeros((RAYS_PER_EDGE, RAYS_PER_EDGE, 3))
    grid[..., axis] = low[axis] - 0.1
    grid[..., b] = (low[b] + (high[b] - low[b]) * share)[:, None]
    grid[..., c] = (low[c] + (high[c] - low[c]) * share)[None, :]
    return grid.reshape(-1, 3)
