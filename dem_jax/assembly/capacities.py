"""Initial capacities for pairs and contacts; ``broad_phase.overflow_recovery`` grows them on
overflow.
"""

import math
from collections.abc import Sequence

import numpy as np

from dem_jax.broad_phase import candidate_search, neighbour_list, overflow_recovery
from dem_jax.shapes import Shape
from dem_jax.types import Partition, Parts

SLENDER = 2.5  # bounding radius over that of the sphere of equal volume, from which on a piece is
# slender: it is near many others, as fries (3.2) and pretzel sticks (4.5) are


def estimate_capacities(
    polytopes: int,
    spheres: int,
    panels: int,
    is_general: bool = False,
    of_parts: bool = False,
    is_slender: bool = False,
) -> tuple[tuple[str, int, int], ...]:
    """Kinds of contact that the scene can have, with initial numbers of candidates and slots.

    The numbers are those observed in settled heaps. Few pieces: all slots are computed in each
    step; many pieces: only the filled ones.

    Args:
        polytopes, spheres: numbers of polytopes and spheres among the parts of the pieces.
        panels: number of wall panels.
        is_general: whether polytopes have any form; these have more neighbours than boxes.
        of_parts: whether pieces have several parts, which lie close together and may be thin; they
            need most slots when they land.
        is_slender: whether any piece is, see ``has_slender_pieces``.
    """
    p, s = polytopes, spheres
    walls = 4 * s ** (2 / 3) + 8 if panels else 0
    hulls = (12 * p, max(4 * p, 5 * p - 32)) if is_general else (9 * p, 3 * p + 5)
    hulls = (36 * p, 24 * p) if is_slender else hulls
    hulls = (40 * p, 12 * p) if of_parts else hulls
    few = min(p, s)
    wanted = {
        "hulls": hulls,
        "mixed": (8 * few, 4 * few),
        "plates": (2 * walls, walls),
        "spheres": (8 * s, 4 * s),
    }
    out: list[tuple[str, int, int]] = []
    for kind in neighbour_list.PAIR_SOURCES:
        every = candidate_search.pair_count(kind, p, s, panels)
        if every:
            candidates, slots = (
                overflow_recovery.round_capacity(min(every, math.ceil(count)))
                for count in wanted[kind]
            )
            out.append((kind, candidates, slots))
    return tuple(out)


def has_slender_pieces(made: Sequence[Shape]) -> bool:
    """Whether any of some pieces is slender, see ``SLENDER``."""
    return any(
        shape.bounding_radius**3 > SLENDER**3 * shape.volume / (4 / 3 * math.pi) for shape in made
    )


def estimate_contacts_per_piece(
    parts: Parts, panels: int, is_general: bool, is_slender: bool = False
) -> int:
    """Initial capacity for the contacts of one piece."""
    usual = 64 if is_slender else 20 if is_general else 12
    if parts.owner is not None:
        usual = 24 * int(np.max(np.bincount(np.asarray(parts.owner))))
    return min(usual, overflow_recovery.max_contacts_per_piece(parts, panels))


def estimate_row_capacity(made: Sequence[Shape], choice: str) -> int:
    """Number of densely packed pieces in three cells of their bounding diameter, the initial
    capacity; 0 without cells.
    """
    if candidate_search.choose_search(choice, len(made)) != "cells":
        return 0
    cell, volume = _diameter_and_volume(made)
    return overflow_recovery.round_capacity(int(np.ceil(3 * 0.65 * cell**3 / volume)))


def estimate_partition(
    made: Sequence[Shape], choice: str, domain: tuple[np.ndarray, np.ndarray]
) -> Partition | None:
    """Initial capacity of jax-md's neighbour list, if the scene selects it."""
    if candidate_search.choose_search(choice, len(made)) != "jax-md":
        return None
    candidate_search.import_jax_md()  # before anything is traced
    return candidate_search.initial_partition(
        len(made), *_diameter_and_volume(made), domain[1] - domain[0]
    )


def _diameter_and_volume(made: Sequence[Shape]) -> tuple[float, float]:
    """Diameter of the largest bounding sphere (m) and volume of the smallest piece (m3)."""
    return 2 * max(shape.bounding_radius for shape in made), min(shape.volume for shape in made)
