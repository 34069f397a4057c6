"""How walls move: one file for each kind of motion, and compose, which lists the kinds and puts
them together.

A kind is a frozen pytree of all G groups, with the names of the scene's keys, so that a program
does not grow with their number; a group that does not move so moves by nothing. It has

- ``asked(section)``: whether a section of the scene asks for it;
- ``of(sections)``: itself, of a section for each group, in numpy;
- ``axis``, ``pivot``: [3, G], of what turns; None of what does not, and pivot also where it is the
  group's own;
- ``at(t)``: the angle about the axis (rad), [G], and the shift (m), 3 x [G], at a time (s); None
  for what it does not do;
- ``find_moving_groups()``: which groups it moves, [G] bool, in numpy;
- ``motion_interval()``: times (s) at which those begin to move and are at rest again, inf if never,
  [G] each, in numpy;
- ``describe_endless_motion(section, duration)``: the key of the section by which it does not come
  to rest in a run, and what is allowed, or None.
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
