"""Which pieces are in the scene: all, those that an inlet has brought in, or those of a run that
has fewer than others.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.types import Array, State, System


def find_present(system: System, state: State) -> Array | None:
    """Which pieces are in the scene, [N] bool; None: all. The others are outside of it, at rest and
    without weight.
    """
    return system.present if state.exchange is None else state.exchange.there


def find_present_per_run(systems: Sequence[System], state: State) -> np.ndarray | None:
    """Which pieces are in the scene, [K, N] bool, of a state of K runs, or of a single one; None:
    all. systems: of each run.
    """
    if state.exchange is not None:
        return np.atleast_2d(np.asarray(state.exchange.there))
    if systems[0].present is None:
        return None
    return np.stack([np.asarray(system.present) for system in systems])
