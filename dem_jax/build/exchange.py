"""Where and when pieces come into a scene and leave it, and where they wait meanwhile."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.scene.buckets import Panel
from dem_jax.shapes import Shape
from dem_jax.types import Exchange, System, host

AWAY = 1.0  # m, from all walls to where pieces wait
FALL = 1.5  # times as far as a piece can fly between outlet and being taken out, the domain goes on

Box = tuple[ArrayLike, ArrayLike]  # lowest and highest corner [3] (m)
Corners = tuple[np.ndarray, np.ndarray]  # likewise


@dataclass(frozen=True)
class Plan:
    """The inlet and the outlet of a scene; of one that it lacks, None."""

    every: float  # s between two exchanges
    box: Corners | None  # in which new pieces begin, whole
    below: float | None  # m: centres below this are taken out
    lot: np.ndarray  # [N, 3] (m): where each piece waits, far from all others


def boxes_of(
    scene: Scene, panels: Sequence[Panel], regions: Sequence[Box], numbers: Sequence[int], made: Sequence[Shape]
) -> list[Box]:
    """The boxes in which the pieces of a portion begin, and last of those that wait outside if the scene has an inlet."""
    portion = scene.portion
    if scene.inlet is None or portion is None or not regions and (portion.region_low is None or portion.region_high is None):
        return list(regions)
    if not regions:
        regions = [(np.array(portion.region_low), np.array(portion.region_high))]
    size, wide = 2 * max(shape.bounding_radius for shape in made), ceil(numbers[-1] ** 0.5)
    low = _highest(panels, regions) + [AWAY, 0.0, 0.0]
    return [*regions, (low, low + [2 * size * wide, 2 * size * wide, 0.0])]


def plan_of(scene: Scene, panels: Sequence[Panel], regions: Sequence[Box], made: Sequence[Shape]) -> Plan | None:
    """regions: without that of the pieces that wait. Raises SceneError for an inlet that is too small for a piece."""
    inlet, outlet = scene.inlet, scene.outlet
    if inlet is None and outlet is None:
        return None
    radius = max(shape.bounding_radius for shape in made)
    lot = find_lot(panels, regions, radius, len(made))
    below = None
    if outlet is not None:
        below = outlet.below if outlet.below is not None else float(_corners(panels, regions)[:, 2].min()) - 2 * radius
    every = min(section.every for section in (inlet, outlet) if section is not None)
    return Plan(every, _box_of_inlet(scene, regions, radius), below, lot)


def find_lot(panels: Sequence[Panel], regions: Sequence[Box], radius: float, count: int) -> np.ndarray:
    """[count, 3] (m): places outside of the scene, far from all walls and from each other, for pieces of a bounding radius (m)."""
    away = _highest(panels, regions) + [AWAY, -AWAY, 0.0]
    return away + 4 * radius * np.arange(count)[:, None] * [1.0, 0.0, 0.0]


def _box_of_inlet(scene: Scene, regions: Sequence[Box], radius: float) -> Corners | None:
    inlet = scene.inlet
    if inlet is None:
        return None
    if inlet.low is not None and inlet.high is not None:
        low, high = np.array(inlet.low), np.array(inlet.high)
    else:
        low, high = (np.array(corner) for corner in regions[-1])  # of the feeder, or of the feed bucket
        if scene.feeder:
            high[0] = low[0] + 0.5 * (high[0] - low[0])
        low[2] = high[2]
        high = high + [0.0, 0.0, 4 * radius]
    for axis, name in enumerate("xyz"):
        if high[axis] - low[axis] < 2 * radius:
            raise SceneError(
                f"inlet.low, inlet.high: a box of {high[axis] - low[axis]:.4g} m along {name}; allowed: at least "
                f"{2 * radius:.4g} m, the bounding diameter of a piece"
            )
    return low, high


def domain_with(plan: Plan, low: np.ndarray, high: np.ndarray, gravity: Sequence[float]) -> Corners:
    """The domain, grown to hold the inlet, and as far beside and below the outlet as a piece flies before it is taken out."""
    if plan.box is not None:
        low, high = np.minimum(low, plan.box[0]), np.maximum(high, plan.box[1])
    if plan.below is not None:
        g = float(np.linalg.norm(gravity))
        speed = np.sqrt(2 * g * max(0.0, high[2] - plan.below))
        fall = FALL * (speed * plan.every + 0.5 * g * plan.every**2)
        low, high = np.minimum(low - [fall, fall, 0.0], [np.inf, np.inf, plan.below - fall]), high + [fall, fall, 0.0]
    return low, high


def at_first(system: System, waiting: int, step: int, dtype: DTypeLike) -> Exchange:
    """All but the last ones, which wait, are there."""
    count, runs = system.pieces.mass.shape[0], system.runs
    return Exchange(
        there=host(np.arange(count) < count - waiting),
        count=host(np.zeros((2, runs), np.int32)),
        mass=host(np.zeros((2, runs), dtype)),
        energy=host(np.zeros((runs,), dtype)),
        last=host(np.int32(step - 1)),
    )


def _highest(panels: Sequence[Panel], regions: Sequence[Box]) -> np.ndarray:
    return _corners(panels, regions).max(axis=0)


def _corners(panels: Sequence[Panel], regions: Sequence[Box]) -> np.ndarray:
    """[n, 3] (m): of all walls and boxes."""
    rows = [*[corners for _, corners, _ in panels], *[np.array(box, float) for box in regions]]
    return np.concatenate(rows or [np.zeros((1, 3))])
