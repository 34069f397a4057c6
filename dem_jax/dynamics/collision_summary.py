"""Summary of the collisions with walls: sums for each group, and all statistics at the end of a
run.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dem_jax.contacts import batch_reduction, forces
from dem_jax.contacts.ledger import sum_reported_groups
from dem_jax.types import Array, State, System


def collision_totals(system: System, state: State) -> Array:
    """Number, normal impulse (N s) and work (J) of the collisions with each entry of
    ``Walls.reports``, [3, reports, R].
    """
    assert state.collisions is not None
    panels = state.collisions.cells.reshape(3, system.walls.group.shape[0], -1, system.runs).sum(
        axis=2
    )
    groups = jnp.arange(len(system.walls.groups), dtype=system.walls.group.dtype)
    is_of = (system.walls.group[None] == groups[:, None])[None, :, :, None]
    return sum_reported_groups(system, jnp.sum(jnp.where(is_of, panels[:, None], 0), axis=2))


def dissipated_energy(system: System, state: State) -> Array:
    """Energy (J) dissipated by contacts with each entry of ``Walls.reports``, [reports, R]: the
    work that they took minus the energy that they would still return.
    """
    number, parts = system.walls.group, system.parts.count
    elastic = jnp.zeros((len(system.walls.groups), system.runs), state.position.dtype)
    for kind, slots in state.scratch.slots.items():
        energy = forces.elastic_energy(system, state, kind)
        of_group = jnp.where(
            slots.live & (slots.a >= parts), number[jnp.maximum(slots.a - parts, 0)], -1
        )
        rows = [
            batch_reduction.sum_contacts_per_run(
                system, jnp.where(of_group == g, energy, 0), slots.b
            )
            for g in range(len(elastic))
        ]
        elastic = elastic + jnp.stack(rows)
    return collision_totals(system, state)[2] - sum_reported_groups(system, elastic)


def summarize_collisions(system: System, state: State) -> dict[str, Any]:
    """All collision statistics as plain numbers for a file, for each run of an ensemble; map cells
    only if they are not empty.

    Energy is the work taken, which for ended contacts equals their dissipation.
    """
    now, rule = state.collisions, system.statistics
    assert now is not None and rule is not None
    cells, speeds, moments = (
        np.asarray(x, np.float64)[..., 0] for x in (now.cells, now.speeds, now.moments)
    )
    runs = (
        zip(cells, speeds, moments, strict=True) if cells.ndim == 3 else [(cells, speeds, moments)]
    )
    return {
        "groups": list(system.walls.groups),
        "cells": rule.cells,
        "fastest": float(np.ravel(rule.fastest)[0]),
        "runs": [_summarize_run(*run) for run in runs],
    }


def _summarize_run(cells: np.ndarray, speeds: np.ndarray, moments: np.ndarray) -> dict[str, Any]:
    places = np.flatnonzero(cells.any(axis=0))
    number, impulse, energy = cells[:, places]
    return {
        "place": places.tolist(),
        "number": number.astype(int).tolist(),
        "impulse": impulse.tolist(),
        "energy": energy.tolist(),
        "speeds": speeds.T.astype(int).tolist(),
        "sum": moments[0].tolist(),
        "largest": moments[1].tolist(),
    }
