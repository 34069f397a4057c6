"""Check of the unit of an STL, which the file does not state: sizes that are plausible only in
millimetres are rejected.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.scene import Bucket, ConvexShape, Feeder, Wall

LARGEST_PIECE, LARGEST_WALL = 1.0, 10.0  # m; a bean or bucket in mm that is read as metres is
# larger


def check_stl_unit(
    row: ConvexShape | Wall | Bucket | Feeder, stl: str | None, points: Sequence[np.ndarray]
) -> None:
    """Raise SceneError for a piece, wall, bucket or feeder whose STL is too large to be in metres
    and whose unit is not given.

    points: [.., 3] (m) each, corners of the parts or panels of the STL.
    """
    limit = LARGEST_WALL if isinstance(row, Wall | Bucket | Feeder) else LARGEST_PIECE
    if stl is None or "unit" in row.model_fields_set or not len(points):
        return
    size = np.ptp(np.concatenate(points), axis=0)
    if size.max() > limit:
        words = " x ".join(f"{edge:.4g}" for edge in size)
        raise SceneError(
            f"stl = {stl!r} is {words} m large; allowed: unit = 1e-3 if it is in mm, unit = 1.0 if it is in m"
        )
