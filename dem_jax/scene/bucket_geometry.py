"""Panels, motions and evaluation block of a bucket with two flaps, and of a linear feeder, from
their few named sizes.
"""

from dataclasses import dataclass

import numpy as np

from dem_jax.math.loops import loop_area, loop_normal
from dem_jax.scene.array_namespace import is_zero
from dem_jax.scene.sections.bucket import Bucket, Feeder
from dem_jax.scene.sections.wall import Motion, Region

GROUP_PREFIXES = {"weigh_bucket": "wb", "feed_bucket": "fb"}  # a scene's section -> what the names
# of its wall groups begin with
RIM_FRACTION = 0.1  # of the width of the widest panel that looks up: narrower ones are no floor
FEEDER_GROUP = "lf"  # wall group of the feeder

Panel = tuple[str, np.ndarray, float]  # group, corners [k, 3] (m), thickness (m)


@dataclass(frozen=True)
class BucketParts:
    """What a bucket adds to a scene; the lower edge of its closed flaps is at height ``bottom`` on
    the z axis.
    """

    panels: list[Panel]
    motions: list[Motion]  # one for each flap that opens
    joint: dict[str, str]  # flap's group -> the group that its force is added to
    block: Region
    interior_low: np.ndarray  # [3] (m): box above the hinges
    interior_high: np.ndarray  # [3] (m)


def flap_depth(bucket: Bucket) -> float:
    """Height (m) of the closed flaps, from their lower edge to the hinges."""
    return 0.5 * bucket.opening_size[1] * np.tan(np.radians(bucket.flap_angle_deg))


def bucket_volume(bucket: Bucket) -> float:
    """What a bucket of named sizes holds to its brim (m3)."""
    x, y = bucket.opening_size
    return float(x * y * (bucket.wall_height + 0.5 * flap_depth(bucket)))


def list_wall_groups(bucket: Bucket, name: str) -> list[str]:
    """The wall groups of a bucket; all of one whose STL has no flaps of its own is ``name_flaps``."""
    if (bucket.stl or bucket.panels) and not (bucket.flap_stl or bucket.flap_panels):
        return [f"{name}_flaps"]
    return [f"{name}_walls", f"{name}_flap_left", f"{name}_flap_right"]


def build_bucket_parts(bucket: Bucket, name: str, bottom: float) -> BucketParts:
    """The bucket's parts, those of an STL read already; groups ``name_walls`` and ``name_flaps``,
    block ``name``.
    """
    if bucket.panels is not None:
        return _build_panel_parts(bucket, name, bottom)
    x, y = 0.5 * bucket.opening_size[0], 0.5 * bucket.opening_size[1]
    hinge = bottom + flap_depth(bucket)
    top, skirt = hinge + bucket.wall_height, hinge - bucket.panel_overlap
    # Without the lap a piece whose corner reaches a little past the free edge of a panel would be
    # pushed along it.
    slope = np.radians(bucket.flap_angle_deg)
    walls = f"{name}_walls"
    sides = [  # seen from inside, counter-clockwise; the end walls reach down beside the flaps
        [(x, -y, skirt), (-x, -y, skirt), (-x, -y, top), (x, -y, top)],
        [(-x, y, skirt), (x, y, skirt), (x, y, top), (-x, y, top)],
        [(-x, -y, bottom), (-x, y, bottom), (-x, y, top), (-x, -y, top)],
        [(x, y, bottom), (x, -y, bottom), (x, -y, top), (x, y, top)],
    ]
    panels = [(walls, np.array(corners), bucket.thickness) for corners in sides]
    motions, joint = [], {}
    for side, sign in (("left", -1), ("right", 1)):
        group = f"{name}_flap_{side}"
        joint[group] = f"{name}_flaps"
        edge = (sign * y, hinge)
        lip = (
            -sign * bucket.panel_overlap * np.cos(slope),
            bottom - bucket.panel_overlap * np.sin(slope),
        )
        corners = [(-x, *edge), (x, *edge), (x, *lip), (-x, *lip)]
        panels.append((group, _orient_upwards(np.array(corners)), bucket.thickness))
        if not is_zero(bucket.opening_angle_deg):
            motions.append(_make_hinge_motion(bucket, group, (0.0, *edge), sign))
    margin = 0.01
    block = Region(
        name=name,
        low=(-x - margin, -y - margin, bottom - margin),
        high=(x + margin, y + margin, top),
    )
    return BucketParts(
        panels, motions, joint, block, np.array([-x, -y, hinge]), np.array([x, y, top])
    )


def _build_panel_parts(bucket: Bucket, name: str, bottom: float) -> BucketParts:
    """The parts of a bucket whose panels are given, with its lowest point at ``bottom``."""
    assert bucket.panels is not None
    given = [bucket.panels, *(bucket.flap_panels or ())]
    corners = [
        [np.array(panel, float) + [0.0, 0.0, bottom] for panel in panels] for panels in given
    ]
    names = list_wall_groups(bucket, name)
    panels = [
        (group, panel, bucket.thickness)
        for group, rows in zip(names, corners, strict=True)
        for panel in rows
    ]
    pivots = [
        _find_hinge_edge(np.concatenate(rows), sign)
        for rows, sign in zip(corners[1:], (-1, 1), strict=False)
    ]
    motions = []
    if not is_zero(bucket.opening_angle_deg):
        motions = [
            _make_hinge_motion(bucket, group, *each)
            for group, each in zip(names[1:], zip(pivots, (-1, 1), strict=True), strict=True)
        ]
    joint = {group: f"{name}_flaps" for group in names[1:]}
    points = np.concatenate([panel for _, panel, _ in panels])
    low, high = points.min(axis=0) - 0.01, points.max(axis=0) + [0.01, 0.01, 0.0]
    block = Region(name=name, low=tuple(low.tolist()), high=tuple(high.tolist()))
    floor = max(
        [pivot[2] for pivot in pivots]
        or [panel[:, 2].max() for panel in select_floor_panels(corners[0])],
        default=bottom,
    )
    free_low, free_high = _find_free_width(corners[0], floor)
    return BucketParts(
        panels, motions, joint, block, np.array([*free_low, floor]), np.array([*free_high, high[2]])
    )


def _find_hinge_edge(points: np.ndarray, sign: int) -> tuple[float, float, float]:
    """A point [3] (m) of the edge along x at which a flap hangs: the highest, of those the
    outermost.
    """
    top = points[points[:, 2] > points[:, 2].max() - 1e-3 * np.ptp(points, axis=0).max()]
    return 0.0, float(sign * (sign * top[:, 1]).max()), float(top[:, 2].max())


def _find_free_width(panels: list[np.ndarray], floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x and y (m) between the panels that face inwards, above a height."""
    points = np.concatenate(panels)
    low, high = points.min(axis=0)[:2], points.max(axis=0)[:2]
    middle = 0.5 * (low + high)
    for panel in panels:
        normal = loop_normal(panel)
        if panel[:, 2].max() <= floor:
            continue
        for axis in (0, 1):
            if normal[axis] > 0.3 and panel[:, axis].min() < middle[axis]:
                low[axis] = max(low[axis], min(panel[:, axis].max(), middle[axis]))
            elif normal[axis] < -0.3 and panel[:, axis].max() > middle[axis]:
                high[axis] = min(high[axis], max(panel[:, axis].min(), middle[axis]))
    return low, high


def is_floor(panel: np.ndarray) -> bool:
    """Whether a panel of corners [k, 3] is a floor."""
    return bool(loop_normal(panel)[2] > 0.5)


def select_floor_panels(panels: list[np.ndarray]) -> list[np.ndarray]:
    """Those of some panels [k, 3] (m) that look up, without strips that are narrow beside the
    widest, as the rim of a sheet is.
    """
    floors = [panel for panel in panels if is_floor(panel)]
    widths = [_panel_width(panel) for panel in floors]
    return [
        panel
        for panel, width in zip(floors, widths, strict=True)
        if width > RIM_FRACTION * max(widths)
    ]


def _panel_width(panel: np.ndarray) -> float:
    """Of corners [k, 3], about (m): area over length."""
    return loop_area(panel) / float(np.linalg.norm(np.ptp(panel, axis=0)))


def _orient_upwards(corners: np.ndarray) -> np.ndarray:
    """The corners in the order in which the polygon's normal points up."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    return corners if normal[2] > 0 else corners[::-1]


def _make_hinge_motion(
    bucket: Bucket, group: str, pivot: tuple[float, float, float], sign: int
) -> Motion:
    """Flaps swing down and outwards: the flap hinged at +y turns about +x, the other about -x. Its
    numbers are checked already.
    """
    return Motion.model_construct(
        group=group,
        pivot=pivot,
        axis=(1.0, 0.0, 0.0),
        opening_angle_deg=sign * bucket.opening_angle_deg,
        opening_start=bucket.opening_start,
        opening_time=bucket.opening_time,
        hold_time=bucket.hold_time,
        closing_time=bucket.closing_time,
        period=bucket.period,
        drive=bucket.drive,
    )


@dataclass(frozen=True)
class FeederParts:
    """What a linear feeder adds to a scene."""

    panels: list[Panel]
    motion: Motion
    block: Region
    interior_low: np.ndarray  # [3] (m): box above the pan
    interior_high: np.ndarray  # [3] (m)


def build_feeder_parts(feeder: Feeder, bucket: BucketParts) -> FeederParts:
    """The feeder's parts, that of an STL read already, group ``lf``: a pan that comes from the
    negative x side, its lower end over the feed bucket.
    """
    edge = np.array(
        [bucket.interior_low[0] + feeder.overhang, 0.0, bucket.interior_high[2] + feeder.clearance]
    )
    pan = _build_pan if feeder.panels is None else _build_panel_pan
    corners, low, high = pan(feeder, edge)
    throw = np.radians(feeder.tilt_deg - feeder.stroke_angle_deg)
    stroke = feeder.stroke * np.array([np.cos(throw), 0.0, -np.sin(throw)])
    motion = Motion.model_construct(
        group=FEEDER_GROUP,
        stroke=tuple(stroke),
        frequency=feeder.frequency,
        vibration_start=feeder.start,
        vibration_end=feeder.start + feeder.duration,
        vibration_ramp=feeder.ramp,
        vibration_period=feeder.period,
    )
    panels = [(FEEDER_GROUP, np.array(c), feeder.thickness) for c in corners]
    end = min(high[0], bucket.interior_low[0]) - 0.01  # none begins above the bucket
    block = Region(name=FEEDER_GROUP, low=(low[0], low[1], edge[2]), high=tuple(high))
    return FeederParts(panels, motion, block, low, np.array([end, *high[1:]]))


def _build_pan(feeder: Feeder, edge: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Corners of the panels of a pan whose edge [3] (m) is given, and the box above it, low and
    high [3] (m).
    """
    tilt, y = np.radians(feeder.tilt_deg), 0.5 * feeder.width
    along, up = (
        np.array([np.cos(tilt), 0.0, -np.sin(tilt)]),
        np.array([np.sin(tilt), 0.0, np.cos(tilt)]),
    )
    back = edge - feeder.length * along
    tops = [point + feeder.wall_height * up for point in (back, edge)]
    at = lambda point, side: point + [0.0, side * y, 0.0]
    corners = [  # seen from inside, counter-clockwise
        [at(back, -1), at(edge, -1), at(edge, 1), at(back, 1)],
        [at(edge, -1), at(back, -1), at(tops[0], -1), at(tops[1], -1)],
        [at(back, 1), at(edge, 1), at(tops[1], 1), at(tops[0], 1)],
        [at(back, -1), at(back, 1), at(tops[0], 1), at(tops[0], -1)],
    ]
    return [np.array(row) for row in corners], at(back, -1), np.array([edge[0], y, tops[0][2]])


def _build_panel_pan(
    feeder: Feeder, edge: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """As ``_build_pan``, of one whose panels are given; above the panels that look up."""
    assert feeder.panels is not None
    corners = [np.array(panel, float) + edge for panel in feeder.panels]
    points = np.concatenate(corners)
    level = max(
        (row[:, 2].max() for row in select_floor_panels(corners)), default=points[:, 2].min()
    )
    (_, low), (_, high) = _find_free_width(corners, level)
    return (
        corners,
        np.array([points[:, 0].min(), low, level]),
        np.array([edge[0], high, points[:, 2].max()]),
    )
