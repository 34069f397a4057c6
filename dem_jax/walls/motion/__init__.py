"""Kinds of wall motion, one file for each, and their composition.

A kind is a frozen pytree for all G groups, with the names of the scene's keys, so that the size of
a program does not depend on the number of groups; groups without this motion have a zero one. It
has

- ``is_requested(section)``: whether a section of the scene requests it;
- ``from_sections(sections)``: the kind from one section per group, in numpy;
- ``axis``, ``pivot``: [3, G], of a rotation; None without one; pivot is also None if it is the
  group's own;
- ``pose_at(t)``: the angle about the axis (rad), [G], and the displacement (m), 3 x [G], at a time
  (s); None for a missing one;
- ``moving_groups()``: flags of the groups that it moves, [G] bool, in numpy;
- ``active_interval()``: times (s) at which groups begin to move and are at rest again, inf if
  never, [G] each, in numpy;
- ``find_endless_key(section, duration)``: the key of the section that keeps it moving beyond a run,
  with its allowed values, or None.
"""

from dem_jax.walls.motion.composition import (
    MOTION_KINDS,
    GroupPose,
    build_motions,
    compose_group_poses,
    describe_endless_motion,
    find_moving_groups,
    motion_interval,
)
from dem_jax.walls.motion.hinge import Hinge
from dem_jax.walls.motion.motion_table import Table, load_table_rows
from dem_jax.walls.motion.vibration import Vibration

__all__ = [
    "GroupPose",
    "Hinge",
    "MOTION_KINDS",
    "Table",
    "Vibration",
    "describe_endless_motion",
    "compose_group_poses",
    "motion_interval",
    "build_motions",
    "find_moving_groups",
    "load_table_rows",
]
