"""What is known of the buckets of a scene before anything is computed: how full its portion makes them, and whether the weigh
bucket is under the feed bucket."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.build.pieces import Goods
from dem_jax.errors import SceneError
from dem_jax.scene import Bucket, Scene, buckets
from dem_jax.scene.buckets import BucketParts
from dem_jax.scene.fill_level import PACKING, Capacity, capacity_of

MISSED, ASIDE = 0.02, 0.25  # of the feed bucket's mouth, beyond what a centred weigh bucket leaves aside: said; refused


class Fill(NamedTuple):
    """How full a portion makes a bucket. name: in words. capacity: (m3) to the brim. heap: (m3) of the portion, as it lies."""

    name: str
    capacity: float
    heap: float

    @property
    def level(self) -> float:
        """The fill level, 1 for a bucket that is full to its brim."""
        return self.heap / self.capacity

    @property
    def is_overfull(self) -> bool:
        """Whether the portion reaches over the brim."""
        return self.level > 1.0

    def __str__(self) -> str:
        pieces = f"a heap of {1e3 * self.heap:.3g} litres, at {100 * PACKING:g} % pieces"
        said = f"{self.name}: {100 * self.level:.0f} % full ({pieces}; to the brim {1e3 * self.capacity:.3g} litres)"
        return f"{said}: overfull" if self.is_overfull else said


def bucket_parts(scene: Scene, section: str) -> BucketParts | None:
    """The panels of a bucket of a scene, those of STL files read already; None: there is no such bucket."""
    bucket = getattr(scene, section)
    above = section == "feed_bucket" and scene.weigh_bucket is not None
    return buckets.parts(bucket, buckets.NAMES[section], scene.drop.height if above else 0.0) if bucket else None


def bucket_capacity(scene: Scene, section: str) -> Capacity | None:
    """What a bucket of a scene holds, as ``bucket_parts`` has it; None: there is none, or it holds nothing."""
    parts, bucket = bucket_parts(scene, section), getattr(scene, section)
    found = capacity_of([corners for _, corners, _ in parts.panels]) if parts else None
    return found if found is None or bucket.panels else found._replace(volume=buckets.volume(bucket))


def fills_of(scene: Scene, goods: Goods) -> list[Fill]:
    """How full the portion makes the feed bucket, if it is in it at first, and the weigh bucket; scene: its STL files read."""
    if scene.portion is None or not goods.numbers:
        return []
    heap = sum(shape.volume for shape in goods.shapes[: goods.numbers[0]]) / PACKING
    found = []
    for section in ("feed_bucket", "weigh_bucket"):
        bucket: Bucket | None = getattr(scene, section)
        if bucket is None or (section == "feed_bucket" and scene.portion.region_low is not None):
            continue
        volume = _volume(scene, section, bucket)
        found += [Fill(section.replace("_", " "), volume, heap)] if volume else []
    return found


def overfull_notes(scene: Scene, goods: Goods) -> list[str]:
    """What to say of buckets that the portion is too much for."""
    return [f"{fill}; pieces fall beside it, or are pressed" for fill in fills_of(scene, goods) if fill.is_overfull]


def check_buckets_meet(scene: Scene, read: Scene) -> list[str]:
    """What to say of a weigh bucket that is only in part under the feed bucket.

    Args:
        scene: as written, which says how STL buckets are moved.
        read: the same with its STL files read.

    Raises:
        SceneError: if it is not under it at all, or by less than three quarters, and no [[wall]] could lead pieces there.
    """
    if not (scene.weigh_bucket and scene.feed_bucket and (_is_read(scene.weigh_bucket) or _is_read(scene.feed_bucket))):
        return []
    feed, capacity = bucket_parts(read, "feed_bucket"), bucket_capacity(read, "weigh_bucket")
    assert feed is not None
    if capacity is None:
        return ["weigh_bucket: it holds nothing, as seen from above; its fill level is not known"]
    way = 0.5 * (feed.interior_low + feed.interior_high)[:2] - capacity.middle
    missed = _share_above(capacity, feed, way) - _share_above(capacity, feed, np.zeros(2))
    if missed <= MISSED:
        return []
    said = _aside(scene, capacity, feed, way, missed)
    if missed > ASIDE and not scene.wall:
        raise SceneError(f"{scene.name}: {said}")
    return [said]


def _volume(scene: Scene, section: str, bucket: Bucket) -> float | None:
    """(m3) that a bucket holds; of sizes exact."""
    if not bucket.panels:
        return buckets.volume(bucket)
    found = bucket_capacity(scene, section)
    return None if found is None else found.volume


def _is_read(bucket: Bucket) -> bool:
    return bool(bucket.stl or bucket.panels)


def _share_above(capacity: Capacity, feed: BucketParts, way: np.ndarray) -> float:
    """The share of the feed bucket's mouth that is over that of a weigh bucket moved by a way [2] (m)."""
    points = np.stack(np.meshgrid(*np.linspace(feed.interior_low[:2], feed.interior_high[:2], 41).T), axis=-1).reshape(-1, 2)
    cells = np.floor((points - way - capacity.surface.origin) / capacity.surface.cell).astype(int)
    there = ((cells >= 0) & (cells < capacity.is_wet.shape)).all(axis=1)
    return float(capacity.is_wet[tuple(cells[there].T)].sum() / len(points))


def _aside(scene: Scene, capacity: Capacity, feed: BucketParts, way: np.ndarray, missed: float) -> str:
    """What is wrong with where the buckets are, and what puts them right; way: [2] (m) of the weigh bucket."""
    of_weigh, of_feed = _span(capacity.low, capacity.high), _span(feed.interior_low, feed.interior_high)
    said = f"{100 * missed:.0f} % of the feed bucket's mouth ({of_feed}) is not over that of the weigh bucket ({of_weigh})"
    others = {"weigh_bucket": capacity.middle + way, "feed_bucket": capacity.middle}  # middle of the mouth of the other
    for section, sign in (("weigh_bucket", 1.0), ("feed_bucket", -1.0)):
        bucket: Bucket = getattr(scene, section)
        if bucket.stl:
            there = np.round(np.asarray(bucket.move) + sign * np.array([*way, 0.0]), 4) + 0.0
            without = " and no move in x and y" if any(bucket.move[:2]) else ""
            centred = f", or {section}.centre = true{without}" if np.abs(others[section]).max() < 1e-3 else ""
            return f"{said}; allowed: {section}.move = {there.tolist()}, which centres it{centred}"
    return f"{said}; allowed: one under the other"


def _span(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> str:
    return ", ".join(f"{axis} from {a:.3g} to {b:.3g} m" for axis, a, b in zip("xy", low, high, strict=False))
