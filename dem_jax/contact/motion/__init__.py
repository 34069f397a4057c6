"""How walls move: one file for each kind of motion, and compose, which lists the kinds and puts them together.

A kind is a frozen pytree of all G groups, with the names of the scene's keys, so that a program does not grow with their
number; a group that does not move so moves by nothing. It has

- ``asked(section)``: whether a section of the scene asks for it;
- ``of(sections)``: itself, of a section for each group, in numpy;
- ``axis``, ``pivot``: [3, G], of what turns; None of what does not, and pivot also where it is the group's own;
- ``at(t)``: the angle about the axis (rad), [G], and the shift (m), 3 x [G], at a time (s); None for what it does not do;
- ``moves()``: which groups it moves, [G] bool, in numpy;
- ``interval()``: times (s) at which those begin to move and are at rest again, inf if never, [G] each, in numpy;
- ``endless(section, duration)``: the key of the section by which it does not come to rest in a run, and what is allowed, or None.
"""

from dem_jax.contact.motion.compose import KINDS, Frame, endless, frames, interval, motions_of, moves
from dem_jax.contact.motion.hinge import Hinge
from dem_jax.contact.motion.table import Table, written_out
from dem_jax.contact.motion.vibration import Vibration

__all__ = [
    "Frame",
    "Hinge",
    "KINDS",
    "Table",
    "Vibration",
    "endless",
    "frames",
    "interval",
    "motions_of",
    "moves",
    "written_out",
]
