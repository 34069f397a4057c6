"""Checks of the buckets of a scene before a run: the fill level, and the alignment of the weigh
bucket with the feed bucket.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.assembly.piece_arrays import PieceSet
from dem_jax.errors import SceneError
from dem_jax.scene import Bucket, Scene, bucket_geometry
from dem_jax.scene.bucket_geometry import BucketParts
from dem_jax.scene.fill_level import PACKING_FRACTION, BucketCapacity, find_capacity

NOTED_SHARE, REFUSED_SHARE = 0.02, 0.25  # of the feed bucket's mouth, in excess of the part that a
# centred weigh bucket leaves uncovered: noted; refused


class BucketFill(NamedTuple):
    """Fill level of a bucket. name: in words. capacity: (m3) to the brim. heap: (m3) bulk volume of
    the portion.
    """

    name: str
    capacity: float
    heap: float

    @property
    def fill_level(self) -> float:
        """The fill level, 1 for a bucket that is full to its brim."""
        return self.heap / self.capacity

    @property
    def is_overfull(self) -> bool:
        """Whether the portion reaches over the brim."""
        return self.fill_level > 1.0

    def __str__(self) -> str:
        pieces = f"a heap of {1e3 * self.heap:.3g} litres, at {100 * PACKING_FRACTION:g} % pieces"
        said = f"{self.name}: {100 * self.fill_level:.0f} % full ({pieces}; to the brim {1e3 * self.capacity:.3g} litres)"
        return f"{said}: overfull" if self.is_overfull else said


def scene_bucket_parts(scene: Scene, section: str) -> BucketParts | None:
    """The panels of a bucket of a scene whose STL files are already read; None if there is no such
    bucket.
    """
    bucket = getattr(scene, section)
    above = section == "feed_bucket" and scene.weigh_bucket is not None
    return (
        bucket_geometry.build_bucket_parts(
            bucket, bucket_geometry.GROUP_PREFIXES[section], scene.drop.height if above else 0.0
        )
        if bucket
        else None
    )


def bucket_capacity(scene: Scene, section: str) -> BucketCapacity | None:
    """Capacity of a bucket of a scene, from ``scene_bucket_parts``; None without a bucket or if it
    holds nothing.
    """
    parts, bucket = scene_bucket_parts(scene, section), getattr(scene, section)
    found = find_capacity([corners for _, corners, _ in parts.panels]) if parts else None
    return (
        found
        if found is None or bucket.panels
        else found._replace(volume=bucket_geometry.bucket_volume(bucket))
    )


def list_bucket_fills(scene: Scene, goods: PieceSet) -> list[BucketFill]:
    """Fill levels of the feed bucket, if the portion starts in it, and of the weigh bucket. scene:
    with its STL files read.
    """
    if scene.portion is None or not goods.numbers:
        return []
    heap = sum(shape.volume for shape in goods.shapes[: goods.numbers[0]]) / PACKING_FRACTION
    found = []
    for section in ("feed_bucket", "weigh_bucket"):
        bucket: Bucket | None = getattr(scene, section)
        if bucket is None or (section == "feed_bucket" and scene.portion.region_low is not None):
            continue
        volume = _bucket_volume(scene, section, bucket)
        found += [BucketFill(section.replace("_", " "), volume, heap)] if volume else []
    return found


def note_overfull_buckets(scene: Scene, goods: PieceSet) -> list[str]:
    """Notes on buckets that are too small for the portion."""
    return [
        f"{fill}; pieces fall beside it, or are pressed"
        for fill in list_bucket_fills(scene, goods)
        if fill.is_overfull
    ]


def check_buckets_meet(scene: Scene, read: Scene) -> list[str]:
    """Note a weigh bucket that is only partly below the feed bucket.

    Args:
        scene: as written, which says how STL buckets are moved.
        read: the same scene with its STL files read.

    Raises:
        SceneError: if more than a quarter of the feed bucket's mouth is uncovered that a centred
            weigh
            bucket would cover, and no [[wall]] could guide pieces there.
    """
    if not (
        scene.weigh_bucket
        and scene.feed_bucket
        and (_is_from_stl(scene.weigh_bucket) or _is_from_stl(scene.feed_bucket))
    ):
        return []
    feed, capacity = scene_bucket_parts(read, "feed_bucket"), bucket_capacity(read, "weigh_bucket")
    assert feed is not None
    if capacity is None:
        return ["weigh_bucket: it holds nothing, as seen from above; its fill level is not known"]
    way = 0.5 * (feed.interior_low + feed.interior_high)[:2] - capacity.middle
    missed = _covered_share(capacity, feed, way) - _covered_share(capacity, feed, np.zeros(2))
    if missed <= NOTED_SHARE:
        return []
    said = _describe_offset(scene, capacity, feed, way, missed)
    if missed > REFUSED_SHARE and not scene.wall:
        raise SceneError(f"{scene.name}: {said}")
    return [said]


def _bucket_volume(scene: Scene, section: str, bucket: Bucket) -> float | None:
    """Volume (m3) of a bucket; exact for a bucket that is given by its dimensions."""
    if not bucket.panels:
        return bucket_geometry.bucket_volume(bucket)
    found = bucket_capacity(scene, section)
    return None if found is None else found.volume


def _is_from_stl(bucket: Bucket) -> bool:
    return bool(bucket.stl or bucket.panels)


def _covered_share(capacity: BucketCapacity, feed: BucketParts, way: np.ndarray) -> float:
    """Share of the feed bucket's mouth that lies above the mouth of a weigh bucket displaced by [2]
    (m).
    """
    points = np.stack(
        np.meshgrid(*np.linspace(feed.interior_low[:2], feed.interior_high[:2], 41).T), axis=-1
    ).reshape(-1, 2)
    cells = np.floor((points - way - capacity.surface.origin) / capacity.surface.cell).astype(int)
    there = ((cells >= 0) & (cells < capacity.is_wet.shape)).all(axis=1)
    return float(capacity.is_wet[tuple(cells[there].T)].sum() / len(points))


def _describe_offset(
    scene: Scene, capacity: BucketCapacity, feed: BucketParts, way: np.ndarray, missed: float
) -> str:
    """Description of a misalignment of the buckets and of its remedy; way: [2] (m), displacement
    that centres the weigh bucket.
    """
    of_weigh, of_feed = (
        _format_extent(capacity.low, capacity.high),
        _format_extent(feed.interior_low, feed.interior_high),
    )
    said = f"{100 * missed:.0f} % of the feed bucket's mouth ({of_feed}) is not over that of the weigh bucket ({of_weigh})"
    # middle of the mouth of the other
    others = {"weigh_bucket": capacity.middle + way, "feed_bucket": capacity.middle}
    for section, sign in (("weigh_bucket", 1.0), ("feed_bucket", -1.0)):
        bucket: Bucket = getattr(scene, section)
        if bucket.stl:
            there = np.round(np.asarray(bucket.move) + sign * np.array([*way, 0.0]), 4) + 0.0
            without = " and no move in x and y" if any(bucket.move[:2]) else ""
            centred = (
                f", or {section}.centre = true{without}"
                if np.abs(others[section]).max() < 1e-3
                else ""
            )
            return f"{said}; allowed: {section}.move = {there.tolist()}, which centres it{centred}"
    return f"{said}; allowed: one under the other"


def _format_extent(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> str:
    return ", ".join(
        f"{axis} from {a:.3g} to {b:.3g} m" for axis, a, b in zip("xy", low, high, strict=False)
    )
