"""The timeline of a scene's cycle, as times of its buckets and of its feeder."""

from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.base import Section
from dem_jax.scene.sections.cycle_settings import FlapTimes


def apply_cycle(scene: Scene) -> Scene:
    """The scene whose buckets and feeder move as its cycle says; one without a cycle as it is."""
    cycle = scene.cycle
    if cycle is None:
        return scene
    zero = cycle.fb.opens[0]  # of the cycle's own time at the release
    assert scene.weigh_bucket is not None and scene.feed_bucket is not None  # as a Scene makes sure
    changes: dict[str, Section] = {
        "weigh_bucket": scene.weigh_bucket.model_copy(
            update=_flap_times(cycle.wb, zero, cycle.period)
        ),
        "feed_bucket": scene.feed_bucket.model_copy(
            update=_flap_times(cycle.fb, zero, cycle.period)
        ),
    }
    if scene.feeder is not None and cycle.lf is not None:
        begin, end = cycle.lf
        times = {"start": begin - zero, "duration": end - begin, "period": cycle.period}
        changes["feeder"] = scene.feeder.model_copy(update=times)
    return scene.model_copy(update=changes)


def _flap_times(flaps: FlapTimes, zero: float, period: float) -> dict[str, float]:
    """Keys of a bucket."""
    (opens, is_open), (closes, is_shut) = flaps.opens, flaps.closes
    return {
        "opening_start": opens - zero,
        "opening_time": is_open - opens,
        "hold_time": closes - is_open,
        "closing_time": is_shut - closes,
        "period": period,
    }
