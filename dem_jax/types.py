"""What a simulation is made of: System (never changes while it runs), State (what a step changes), Sample (what is read).

All are frozen dataclasses registered as pytrees. Arrays keep the piece, panel or contact index last; leading axes hold
components. N pieces, W panels in G wall groups, B blocks, P contact slots. SI units. An ensemble puts a member axis first;
where R of its runs are one system (``System.runs``), N counts the pieces of all and what there is of each run has R last.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array


def pytree(cls=None, *, static=()):
    """Make a frozen dataclass that JAX sees as a tree of its fields, the static ones as part of its structure."""
    if cls is None:
        return partial(pytree, static=static)
    cls = dataclasses.dataclass(frozen=True)(cls)
    names = [f.name for f in dataclasses.fields(cls)]
    data = [n for n in names if n not in static]
    cls.replace = dataclasses.replace
    return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=list(static))


@pytree(static=("is_zonotope",))
class Hulls:
    """A table of S convex polytopes, padded by repetition to the same counts of faces, corners and edge directions.

    Gathered to pairs, the last axis is the pair; with one shape it stays 1 and broadcasts.
    """

    normals: tuple  # [F, S] x 3: outward unit normals; of a zonotope face f + F/2 is opposite to face f
    offsets: Array  # [F, S] (m): n . x <= offset
    corners: tuple | None  # [k, F, S] x 3 (m): corners of each face in order, some repeated
    loops: Array | None  # [3 (1 + k), F S] (m): the same as columns, each closed by its first corner; of zonotopes, whose
    # edges come in opposite pairs, [3 (1 + k/2), F S]: centre of the face, then the first half of its edges
    row: Array  # [S] int32: which shape of the table
    vertices: tuple  # [V, S] x 3 (m)
    directions: tuple  # [D, S] x 3: unit edge directions
    bounding_radius: Array  # [S] (m)
    half_lengths: Array | None  # [D, S] (m): of a zonotope, the lengths of its generators
    cross_widths: Array | None  # [D, F/2, S] (m): of a zonotope, C of collide._zonotope_axes
    seams: tuple | None  # [m, S] x 3: of a panel, outward across each edge where another continues its plane; else 0
    open_edges: Array | None  # [k, F S]: 0 for those edges, 1 for all others, as columns; not gathered to pairs
    is_zonotope: bool


@pytree
class Pieces:
    """The N pieces. The principal frame of a piece is its body frame here."""

    mass: Array  # [N] (kg)
    inertia: Array  # [3, N] (kg m2): principal moments
    load_stiffness: Array  # [N] (N/m): K_nl,p of eq. 7, softened
    wall_stiffness: Array  # [N] (N/m): K_nl of the piece against a wall, eqs 5 and 8, softened
    radius: Array  # [N] (m): of a sphere; 0 of a polytope
    bounding_radius: Array  # [N] (m)
    width: Array  # [N] (m): smallest width, the measure of how deep a contact is
    polytopes: Array  # int32: which pieces are polytopes ...
    spheres: Array  # int32: ... and which are spheres


@pytree(static=("groups", "reports"))
class Walls:
    """Convex plates in G groups, each group moved as a rigid body or at rest.

    A name that forces are reported under may stand for several groups (``wb_flaps`` for both flaps).
    """

    centre: Array  # [3, W] (m): in the scene's rest pose
    rotation: Array  # [3, 3, W]: panel frame (z along the surface's normal) to scene, in the rest pose
    half_extent: Array  # [3, W] (m): of the box around the panel, in its frame
    group: Array  # [W] int32
    plane: Array | None  # [W] int32: the same number for panels that continue each other in a plane, -1 for all others
    pivot: Array  # [3, G] (m): moves with the group; torques are about it; on the axis of a hinge
    motions: tuple  # of the kinds in contact.motion, each of all groups that move so; none: all rest
    groups: tuple  # names of the G groups
    reports: tuple  # ((reported name, (group, ...)), ...)

    @property
    def moving(self) -> bool:
        """Whether any group moves."""
        return bool(self.motions)


@pytree
class Law:
    """Parameters of the contact law, numbers."""

    restitution: Array  # epsilon of eq. 6
    separation: Array  # lambda of eq. 1
    friction_piece: Array  # mu, piece-piece
    friction_wall: Array  # mu, piece-wall
    tangential: Array  # K_t / K_nl
    damping: Array  # damping ratio of the unloading branch; 0 in the paper's model


class Partition(NamedTuple):
    """What jax-md's list must know before anything is compiled. Cells are counted round and round, as in a periodic box."""

    diameter: float  # (m): of the largest bounding sphere
    reach: float  # (m): largest gap within which pairs are listed
    sides: tuple  # (int, int, int): numbers of cells, at least 3
    pairs: int  # most pairs in the list
    cell: int  # most pieces in a cell


CHOICES = (
    "capacity",
    "touching",
    "neighbours",
    "row_capacity",
    "partition",
    "has_hulls",
    "alike",
    "escape_stops",
    "has_friction",
    "has_rotation",
    "has_damping",
    "ledger",
    "parts",
    "block_steps",
    "slot_block",
    "runs",
)


@pytree(static=CHOICES)
class System:
    """All that never changes while a scene runs: arrays, and the static choices that decide what is compiled."""

    pieces: Pieces
    hulls: Hulls | None  # shapes of the polytopes among the pieces, then of the panels
    shape: Array  # [N + W] int32: row of each body in the table of hulls (0 of a sphere)
    walls: Walls
    law: Law
    gravity: Array  # [3] (m/s2)
    dt: Array  # (s)
    substeps: Array  # int32: steps per sample (per part of a sample, if it has parts), at most block_steps
    skin: Array  # (m): pairs nearer than this, beyond the way that present speeds take them, are candidates
    block_low: Array  # [3, B] (m): corners of the blocks in which settled mass is counted
    block_high: Array  # [3, B] (m)
    domain_low: Array  # [3] (m): a piece outside has left the scene
    domain_high: Array  # [3] (m)
    capacity: tuple  # ((kind of contact, candidates, slots), ...): the kinds that the scene has, see neighbours
    touching: int  # most contacts that a piece may have at once
    neighbours: str  # how pairs of pieces are found, as in scene.RunSettings
    row_capacity: int  # most pieces in three neighbouring cells in a row, where there are cells
    partition: Partition | None  # of jax-md's list
    has_hulls: bool  # whether any piece is a polytope
    alike: tuple  # "hulls" if all polytopes among the pieces are one shape, "spheres" if all spheres are
    escape_stops: bool  # whether a piece outside the domain stops the run
    has_friction: bool
    has_rotation: bool
    has_damping: bool
    ledger: bool  # whether work and dissipation are added up
    parts: int  # a sample interval of more steps than the next is cut into so many parts, a rebuild before each
    block_steps: int  # most steps between rebuilds of the candidate pairs; a rebuild comes before the sample that exceeds it
    slot_block: int  # contacts are computed so many at a time, at most; 0: all slots at once
    runs: int  # how many runs of an ensemble this is, side by side (see joined); 0: one run by itself


@pytree
class ContactTable:
    """P slots for contacts between two kinds of bodies; an empty slot has a = -1. History of eqs 1-4 per slot.

    Bodies are numbered pieces first, then panels. b is always a piece, a is a piece or a panel.
    """

    a: Array  # [P] int32
    b: Array  # [P] int32
    force: Array  # [P] (N): F_n of the last step
    overlap: Array  # [P] (m): s_n of the last step
    spring: Array  # [3, P] (N): tangential force on b of the last step, world frame
    point: Array  # [3, P] (m): contact point of the last step relative to the centre of b, world axes; where there is friction


@pytree
class Slots:
    """What stays the same in each slot between two rebuilds."""

    live: Array  # [P] bool: whether the slot holds a pair
    a: Array  # [P] int32: as in the table, 0 where empty
    b: Array  # [P] int32
    hull_a: Hulls | None  # [.., P] or [.., 1]
    hull_b: Hulls | None
    radius_a: Array  # [P] or [1], as the next five (m): of spheres
    radius_b: Array  # [P] (m)
    stiffness: Array  # [P] (N/m): K_nl, eq. 5
    friction: Array  # [P]: mu
    mass: Array  # [P] (kg): effective mass
    width: Array  # [P] (m): of the narrower piece
    member: Array | None  # [G, P] bool: whether a is a panel of the group; None between spheres
    plane: Array | None  # [P] int32: of a, where it is a panel that another continues; else -1


@pytree
class Ledger:
    """What a run adds up; ``impulse`` and ``overlap`` start anew with each sample interval."""

    impulse: Array  # [3, G] (N s): of the pieces on each wall group
    overlap: Array  # (-): largest overlap relative to the width of the piece
    taken: Array  # (J): work that contacts took: what they store and what is lost
    wall_work: Array  # (J): work of the walls on the pieces


@pytree
class Guard:
    """What must not happen silently, as data: the host looks at it after each chunk."""

    needed: dict  # kind of contact -> int32 [2]: most candidates and slots that any rebuild wanted
    touching: Array  # int32: most contacts of one piece that any rebuild wanted
    row: Array  # int32: most pieces in three neighbouring cells in a row
    partition: Array  # int32 [2]: most pairs, and most pieces in a cell, that any list of jax-md wanted
    reach: Array  # (m): the largest reach that any list of jax-md wanted
    travel: Array  # (m): most that two bodies can have approached each other between rebuilds, beyond State.lead
    start_overlap: Array  # (-): largest overlap at the first rebuild, relative to the width of the piece; -1: not yet
    start_pair: Array  # [2] int32: a and b of that pair


@pytree
class State:
    """What a step changes. Velocities and momenta are at the time of the positions."""

    step: Array  # int32: time is step * dt
    position: Array  # [3, N] (m): centres of mass
    position_rest: Array  # [3, N] (m): what rounding left over of the position (zero in double precision)
    orientation: Array  # [4, N]: unit quaternion w x y z, principal frame to world
    velocity: Array  # [3, N] (m/s)
    velocity_rest: Array  # [3, N] (m/s): what rounding left over of the velocity
    angular_momentum: Array  # [3, N] (kg m2/s), world frame
    force: Array  # [3, N] (N): of contacts
    torque: Array  # [3, N] (N m): of contacts, about the centre of mass
    wall_force: Array  # [3, G] (N): of the pieces on each wall group
    wall_torque: Array  # [3, G] (N m): likewise, about the group's pivot
    contacts: dict  # kind of contact -> ContactTable
    slots: dict  # kind of contact -> Slots
    filled: dict  # kind of contact -> int32: how many slots hold a pair, the first ones
    busiest: Array  # int32: most contacts of a piece
    walled: Array | None  # [2, touching, N] int32: of runs side by side, as ``incidence`` the contacts with walls, and their groups
    most_walled: Array | None  # int32: most contacts of a piece with walls
    incidence: Array  # [touching, N] int32: where the contacts of each piece stand among all (see neighbours.find_incidence)
    loads: Array  # [6, columns] (N, N m): of each contact on b and on a, about their centres; of the last column, zero; of runs
    # side by side a seventh row, overlap relative to width
    ledger: Ledger
    anchor: Array  # [7, N]: position and orientation at the last rebuild
    since: Array  # int32: the step of the last rebuild
    lead: Array  # (m): most that two bodies approach each other at the speeds they had then, until the next rebuild
    guard: Guard


@pytree
class Sample:
    """What is read at the end of a sample interval."""

    step: Array  # int32
    force: Array  # [3, G] (N): of the pieces on each wall group, instantaneous
    mean_force: Array  # [3, G] (N): mean over the interval; closes the momentum balance
    torque: Array  # [3, G] (N m): instantaneous, about the group's pivot
    settled_mass: Array  # [B] (kg): inside the block and slower than 0.1 m/s
    energy: Array  # [6] (J): kinetic, potential, elastic, dissipated, wall_work, total (conserved)
    momentum: Array  # [3] (kg m/s)
    overlap: Array  # (-): largest overlap of the interval relative to the width of the piece
    fastest: Array  # (m/s): fastest piece in the domain
    culprit: Array  # int32: first piece that is not finite or has left the domain; -1: none


ENERGIES = ("kinetic", "potential", "elastic", "dissipated", "wall_work", "total")


def float_dtype(precision):
    """The dtype of a precision, "f32" or "f64"."""
    return {"f32": jnp.float32, "f64": jnp.float64}[precision]
