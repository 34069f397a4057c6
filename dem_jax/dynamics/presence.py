"""Presence of pieces in the scene: all, those that an inlet has released, or those of a run with
fewer pieces than others.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.types import Array, State, System


def find_present(system: System, state: State) -> Array | None:
    """Flags of the pieces in the scene, [N] bool; None: all. The others are outside, at rest and
    without weight.
    """
    return system.present if state.exchange is None else state.exchange.there


def find_present_per_run(systems: Sequence[System], state: State) -> np.ndarray | None:
    """Flags of the pieces in the scene, [K, N] bool, for a state of K runs or a single one; None:
    all. systems: of each run.
    """
    if state.exchange is not None:
        return np.atleast_2d(np.asarray(state.exchange.there))
    if systems[0].present is None:
        return None
    return np.stack([np.asarray(system.present) for system in systems])
