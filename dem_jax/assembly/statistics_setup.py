"""Setup of the collision statistics that a scene requests."""

from numpy.typing import DTypeLike

from dem_jax.assembly.dtype_cast import cast_array
from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.types import CollisionBins

MOST_PLACES = 4_000_000  # on all panels together


def build_collision_bins(scene: Scene, panels: int, dtype: DTypeLike) -> CollisionBins | None:
    """The speed bins and map cells of the panels; None if the scene requests no statistics. Raises
    SceneError.
    """
    asked = scene.statistics
    if asked is None:
        return None
    if not 0 < panels * asked.map_resolution**2 <= MOST_PLACES:
        most = int((MOST_PLACES / max(1, panels)) ** 0.5)
        allowed = f"at most {most}" if panels else "no [statistics] in a scene without walls"
        raise SceneError(
            f"statistics.map_resolution = {asked.map_resolution}: of {panels} panels; allowed: {allowed}"
        )
    return CollisionBins(
        cast_array(asked.min_speed, dtype),
        cast_array(asked.max_speed, dtype),
        asked.speed_bins,
        asked.map_resolution,
    )
