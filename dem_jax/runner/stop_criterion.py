"""Stop criterion of ``run.until_settled``: a run may end early when all is at rest, decided on the
host between chunks.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.scene.cycle_timing import apply_cycle
from dem_jax.types import Sample, System
from dem_jax.walls import motion


@dataclass(frozen=True)
class StopCriterion:
    """Criterion for the early end of a run; times in samples from the release.

    It is evaluated after each ``window``, counted from the start of settling and from the release.
    It thus depends only on the scene, not on the chunks of a run.
    """

    speed: float  # m/s: all pieces have been slower throughout the last window
    window: int  # a multiple of the samples between rebuilds, which are due at its end anyway
    start: int  # first sample of settling that may end early (negative), or 0
    walls_at_rest: int  # from here on no wall moves

    def next_check(self, at: int) -> int:
        """End of the window that contains a sample."""
        origin = self.start if at < 0 else 0
        return at + self.window - (at - origin) % self.window

    def is_window_start(self, at: int) -> bool:
        """Whether a window begins at a sample."""
        return self.next_check(at) == at + self.window

    def is_slow(self, samples: Sample, count: int) -> bool:
        """Whether all pieces of all runs are slow in the first ``count`` samples; samples: numpy
        [.., T].
        """
        return bool(np.all(samples.fastest[..., :count] < self.speed))


def merge_criteria(rules: list[StopCriterion | None]) -> StopCriterion | None:
    """The common criterion of runs that end together, from the criterion of each."""
    all_of = [rule for rule in rules if rule is not None]
    if not all_of:
        return None
    begin, still = max(rule.start for rule in all_of), max(rule.walls_at_rest for rule in all_of)
    return replace(max(all_of, key=lambda rule: rule.window), start=begin, walls_at_rest=still)


def build_criterion(
    scene: Scene, system: System, settling: int, samples_per_block: int
) -> StopCriterion | None:
    """The criterion of a scene, None if its runs last to the end. settling: samples before the
    release. Raises SceneError.
    """
    if not scene.run.until_settled:
        return None
    for name in ("weigh_bucket", "feed_bucket", "feeder"):
        section = getattr(apply_cycle(scene), name)
        if section is not None and section.period:
            goes_on = (
                "[cycle] goes on"
                if scene.cycle
                else f"{name}.period = {section.period:g}; allowed: 0 (once)"
            )
            raise SceneError(f"run.until_settled = true: the walls never rest: {goes_on}")
    if scene.inlet:
        raise SceneError(
            "run.until_settled = true: pieces come in by [inlet] all along; allowed: a scene without, or false"
        )
    for n, section in enumerate(scene.motion):
        why = motion.describe_endless_motion(section, scene.run.duration)
        if why:
            raise SceneError(
                f"run.until_settled = true: group {section.group!r} never rests: motion.{n}.{why}"
            )
    speed, gravity = scene.run.settled_speed, math.hypot(*scene.run.gravity)
    if 0 < scene.run.settled_time * gravity <= 2 * speed:
        raise SceneError(
            f"run.settled_time = {scene.run.settled_time:g}: at the top of a bounce pieces are slow for longer; allowed: "
            f"above {2 * speed / gravity:.4g} s, in which gravity turns run.settled_speed = {speed:g} round"
        )
    begins, ends = motion.motion_interval(system.walls)
    wanted = max(1, math.ceil(scene.run.settled_time / scene.run.sample_interval - 1e-9))
    return StopCriterion(
        speed=speed,
        window=-(-wanted // samples_per_block) * samples_per_block,
        start=0 if begins < 0 else -settling,
        walls_at_rest=math.ceil(ends / scene.run.sample_interval - 1e-3),
    )
