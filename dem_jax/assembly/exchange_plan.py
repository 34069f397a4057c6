"""Times and places at which pieces enter and leave a scene, and their waiting places."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.scene.bucket_geometry import Panel
from dem_jax.shapes import Shape
from dem_jax.types import PieceExchange, System, as_array

WAITING_DISTANCE = 1.0  # m, from all walls to the waiting places
FALL_MARGIN = 1.5  # the domain extends beyond the outlet by this multiple of the distance that a
# piece can fly before it is removed

Box = tuple[ArrayLike, ArrayLike]  # lowest and highest corner [3] (m)
Corners = tuple[np.ndarray, np.ndarray]  # the same, as numpy arrays


@dataclass(frozen=True)
class ExchangePlan:
    """The inlet and the outlet of a scene; fields of a missing one are None."""

    interval: float  # s between two exchanges
    inlet_box: Corners | None  # contains new pieces entirely
    outlet_height: float | None  # m: pieces with centres below this are removed
    waiting_places: np.ndarray  # [N, 3] (m): where each piece waits, far from all others


def list_start_boxes(
    scene: Scene,
    panels: Sequence[Panel],
    regions: Sequence[Box],
    numbers: Sequence[int],
    made: Sequence[Shape],
) -> list[Box]:
    """The boxes in which the pieces of a portion start; with an inlet, the last box holds the
    waiting pieces.
    """
    portion = scene.portion
    if (
        scene.inlet is None
        or portion is None
        or not regions
        and (portion.region_low is None or portion.region_high is None)
    ):
        return list(regions)
    if not regions:
        regions = [(np.array(portion.region_low), np.array(portion.region_high))]
    size, wide = 2 * max(shape.bounding_radius for shape in made), ceil(numbers[-1] ** 0.5)
    low = _highest_corner(panels, regions) + [WAITING_DISTANCE, 0.0, 0.0]
    return [*regions, (low, low + [2 * size * wide, 2 * size * wide, 0.0])]


def plan_exchange(
    scene: Scene, panels: Sequence[Panel], regions: Sequence[Box], made: Sequence[Shape]
) -> ExchangePlan | None:
    """The exchange plan of a scene; None without inlet and outlet. regions: without that of waiting
    pieces. Raises SceneError for an inlet that is too small for a piece.
    """
    inlet, outlet = scene.inlet, scene.outlet
    if inlet is None and outlet is None:
        return None
    radius = max(shape.bounding_radius for shape in made)
    lot = find_waiting_places(panels, regions, radius, len(made))
    below = None
    if outlet is not None:
        below = (
            outlet.z_max
            if outlet.z_max is not None
            else float(_collect_corners(panels, regions)[:, 2].min()) - 2 * radius
        )
    every = min(section.interval for section in (inlet, outlet) if section is not None)
    return ExchangePlan(every, _find_inlet_box(scene, regions, radius), below, lot)


def find_waiting_places(
    panels: Sequence[Panel], regions: Sequence[Box], radius: float, count: int
) -> np.ndarray:
    """Places [count, 3] (m) outside the scene, far from all walls and from each other, for pieces
    of a bounding radius (m).
    """
    away = _highest_corner(panels, regions) + [WAITING_DISTANCE, -WAITING_DISTANCE, 0.0]
    return away + 4 * radius * np.arange(count)[:, None] * [1.0, 0.0, 0.0]


def _find_inlet_box(scene: Scene, regions: Sequence[Box], radius: float) -> Corners | None:
    inlet = scene.inlet
    if inlet is None:
        return None
    if inlet.box_low is not None and inlet.box_high is not None:
        low, high = np.array(inlet.box_low), np.array(inlet.box_high)
    else:
        low, high = (np.array(corner) for corner in regions[-1])  # of the feeder, or of the feed
        # bucket
        if scene.feeder:
            high[0] = low[0] + 0.5 * (high[0] - low[0])
        low[2] = high[2]
        high = high + [0.0, 0.0, 4 * radius]
    for axis, name in enumerate("xyz"):
        if high[axis] - low[axis] < 2 * radius:
            raise SceneError(
                f"inlet.box_low, inlet.box_high: a box of {high[axis] - low[axis]:.4g} m along {name}; allowed: at least "
                f"{2 * radius:.4g} m, the bounding diameter of a piece"
            )
    return low, high


def extend_domain(
    plan: ExchangePlan, low: np.ndarray, high: np.ndarray, gravity: Sequence[float]
) -> Corners:
    """The domain, extended by the inlet and, beside and below the outlet, by the distance that a
    piece flies before it is removed.
    """
    if plan.inlet_box is not None:
        low, high = np.minimum(low, plan.inlet_box[0]), np.maximum(high, plan.inlet_box[1])
    if plan.outlet_height is not None:
        g = float(np.linalg.norm(gravity))
        speed = np.sqrt(2 * g * max(0.0, high[2] - plan.outlet_height))
        fall = FALL_MARGIN * (speed * plan.interval + 0.5 * g * plan.interval**2)
        low, high = (
            np.minimum(low - [fall, fall, 0.0], [np.inf, np.inf, plan.outlet_height - fall]),
            high + [fall, fall, 0.0],
        )
    return low, high


def init_exchange(system: System, waiting: int, step: int, dtype: DTypeLike) -> PieceExchange:
    """Initial exchange state: all pieces are in the scene except the last ``waiting`` ones."""
    count, runs = system.pieces.mass.shape[0], system.runs
    return PieceExchange(
        there=as_array(np.arange(count) < count - waiting),
        count=as_array(np.zeros((2, runs), np.int32)),
        mass=as_array(np.zeros((2, runs), dtype)),
        energy=as_array(np.zeros((runs,), dtype)),
        last=as_array(np.int32(step - 1)),
    )


def _highest_corner(panels: Sequence[Panel], regions: Sequence[Box]) -> np.ndarray:
    return _collect_corners(panels, regions).max(axis=0)


def _collect_corners(panels: Sequence[Panel], regions: Sequence[Box]) -> np.ndarray:
    """Corners [n, 3] (m) of all walls and boxes."""
    rows = [*[corners for _, corners, _ in panels], *[np.array(box, float) for box in regions]]
    return np.concatenate(rows or [np.zeros((1, 3))])
