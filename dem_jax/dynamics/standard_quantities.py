"""All sampled quantities, one entry each. An entry appears in every sample, file and run, and in
``python -m dem_jax run --help``.
"""

import jax.numpy as jnp
import numpy as np

from dem_jax.contacts import batch_reduction
from dem_jax.dynamics import collision_summary, load_cell_oscillator, observables
from dem_jax.dynamics.quantity import Axis, Quantity, Rows, validate_quantities
from dem_jax.types import Array, State, System, Walls


def _energy_rows(system: System) -> Rows:
    """Rows of the energies. Dissipation, the work of walls and the total are available only if the
    ledger is kept.
    """
    known = observables.ENERGIES if system.ledger else observables.ENERGIES[:3]
    return tuple(zip(known, range(len(known)), strict=True))


ENERGY = Axis("kind of energy", lambda _: len(observables.ENERGIES), _energy_rows, "KIND")

REPORT = Axis(
    "report",
    size=lambda system: len(system.walls.reports),
    rows=lambda system: tuple((name, k) for k, (name, _) in enumerate(system.walls.reports)),
    symbol="GROUP",
)

PARTNER = Axis(
    "partner",
    size=lambda system: len(system.walls.groups) + 1,
    rows=lambda system: (*system.walls.reports, ("between_pieces", len(system.walls.groups))),
    symbol="PARTNER",
)

READING = Axis(
    "reading",
    size=lambda _: len(load_cell_oscillator.READINGS),
    rows=lambda system: tuple(
        (name, k)
        for k, name in enumerate(load_cell_oscillator.READINGS)
        if system.walls.load_cell is not None
    ),
    symbol="READING",
)


DRIVEN_GROUP = Axis(
    "driven group",
    size=lambda system: len(system.walls.groups),
    rows=lambda system: _driven_group_rows(system.walls),
    symbol="GROUP",
)


def _driven_group_rows(walls: Walls) -> Rows:
    which = (
        [] if walls.drive is None else np.flatnonzero(np.asarray(walls.drive.is_driven)).tolist()
    )
    return tuple((walls.groups[k], k) for k in which)


FLOW = ("inside", "inserted", "removed")  # the rows of ``piece_count`` and ``piece_mass``

PLACE = Axis(
    "place",
    size=lambda _: len(FLOW),
    rows=lambda system: tuple((name, k) for k, name in enumerate(FLOW) if system.exchanges),
    symbol="PLACE",
)

COLLISIONS = ("collision_count", "collision_impulse", "collision_energy")


def _count_contacts(system: System, state: State) -> Array:
    """Number of contacts with the panels of each wall group and, as last row, between pieces, [G +
    1, R] int32.
    """
    parts, groups = system.parts.count, len(system.walls.groups)
    partner_of = jnp.pad(system.walls.group, (0, 1), constant_values=groups)  # of panels, and as
    # last entry of pieces
    found = jnp.zeros((groups + 1, system.runs), jnp.int32)
    for table in state.contacts.values():
        partner = partner_of[jnp.where(table.a >= parts, table.a - parts, -1)]
        found += batch_reduction.count_contacts_per_run(
            system, jnp.where(table.memory.overlap > 0, partner, -1), table.b, groups + 1
        )
    return found


QUANTITIES = validate_quantities(
    (
        Quantity(
            name="force", unit="N", axes=("group", "xyz"),
            of=lambda system, state: state.walls.force,
            help="of the pieces on the wall group, at that time",
        ),
        Quantity(
            name="mean_force", unit="N", axes=("group", "xyz"),
            of=lambda system, state: state.ledger.impulse / observables.sample_interval(system),
            help="its mean over the sample interval that ends then; closes the momentum balance",
        ),
        Quantity(
            name="peak_force", unit="N", axes=(REPORT,),
            of=lambda system, state: state.ledger.peak,
            help="along gravity, without it downward: the largest of every step of the sample interval and, with the law of Walton "
            "and Braun, of where contacts turn between two steps; at least 0",
        ),
        Quantity(
            name="torque", unit="N m", axes=("moving group", "xyz"),
            of=lambda system, state: state.walls.torque,
            help="of the pieces on a wall group that moves, about its pivot, at that time",
        ),
        Quantity(
            name="settled_mass", unit="kg", axes=("block",),
            of=observables.settled_mass,
            help="of the pieces inside the block that are slower than 0.1 m/s",
        ),
        Quantity(
            name="energy", unit="J", axes=(ENERGY,),
            of=observables.energy_terms,
            help=", ".join(observables.ENERGIES) + " (constant)",
        ),
        Quantity(
            name="momentum", unit="kg m/s", axes=("xyz",),
            of=lambda system, state: batch_reduction.sum_per_run(system, system.pieces.mass[None] * state.velocity),
            help="of all pieces",
        ),
        Quantity(
            name="max_relative_overlap", unit="1", axes=(),
            of=lambda system, state: state.ledger.overlap,
            help="the largest of the sample interval, relative to the width of the narrower piece",
        ),
        Quantity(
            name="contact_count", unit="1", axes=(PARTNER,),
            of=_count_contacts,
            help="number of contacts of pieces with the panels of a wall group, and between_pieces",
        ),
        Quantity(
            name="load_cell", unit=", ".join(load_cell_oscillator.READINGS.values()), axes=(READING,),
            of=load_cell_oscillator.cell_readings,
            help="of the load cell, if there is one, downwards: " + ", ".join(load_cell_oscillator.READINGS) + "; signal = k x + c x'",
        ),
        Quantity(
            name="flap_angle_error", unit="rad", axes=(DRIVEN_GROUP,),
            of=lambda _, state: state.drive.lag,  # type: ignore[union-attr]  # not sampled without one
            help="angle of a flap that has a drive, beyond its motion, about the axis of its hinge",
        ),
        Quantity(
            name="collision_count", unit="1", axes=(REPORT,),
            of=lambda system, state: collision_summary.collision_totals(system, state)[0],
            help="with the wall group since the first step, if the scene has [statistics]; a contact is one until it ends",
        ),
        Quantity(
            name="collision_impulse", unit="N s", axes=(REPORT,),
            of=lambda system, state: collision_summary.collision_totals(system, state)[1],
            help="of the normal forces on the wall group since the first step, likewise",
        ),
        Quantity(
            name="collision_energy", unit="J", axes=(REPORT,),
            of=collision_summary.dissipated_energy,
            help="that contacts with the wall group have dissipated since the first step, likewise",
        ),
        Quantity(
            name="piece_count", unit="1", axes=(PLACE,),
            of=observables.piece_count,
            help="in the scene, and since the first step: inside = at first + inserted - removed; of an inlet or outlet",
        ),
        Quantity(
            name="piece_mass", unit="kg", axes=(PLACE,),
            of=observables.piece_mass,
            help="mass of these pieces",
        ),
        Quantity(
            name="step", unit="1", axes=(), kept=False,
            of=lambda system, state: jnp.full((system.runs,), state.step),
            help="number of the time step",
        ),
        Quantity(
            name="fastest", unit="m/s", axes=(), kept=False,
            of=observables.max_speed,
            help="speed of the fastest piece in the domain",
        ),
        Quantity(
            name="stride", unit="1", axes=(), kept=False,
            of=observables.max_relative_displacement,
            help="way of the fastest piece in the domain in a time step, relative to the width of the narrowest piece",
        ),
        Quantity(
            name="culprit", unit="1", axes=(), kept=False,
            of=observables.first_invalid_body,
            help="first piece that is not finite or has left the domain; -1: none",
        ),
    )
)  # fmt: skip


def select_quantities(walls: Walls, statistics: bool, exchanges: bool) -> tuple[Quantity, ...]:
    """The quantities of a system: load cell, drive, collision and exchange quantities only if the
    system has them.
    """
    absent = set() if statistics else set(COLLISIONS)
    absences = (
        (READING, walls.load_cell is None),
        (DRIVEN_GROUP, walls.drive is None),
        (PLACE, not exchanges),
    )
    without = [axis for axis, is_absent in absences if is_absent]
    return tuple(
        q
        for q in QUANTITIES
        if q.name not in absent and not any(axis in q.axes for axis in without)
    )
