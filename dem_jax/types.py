"""What a simulation is made of: System (never changes while it runs), State (what a step changes),
Sample (what is read).

All are frozen dataclasses registered as pytrees. Arrays keep the piece, part, panel or contact
index last; leading axes hold components. N pieces of M convex parts, W panels in G wall groups, B
blocks, P contact slots. SI units. R runs, mostly one, are computed as one system whose runs do not
see each other: N counts the pieces of all, and what there is of each run has R last (``of_run``).
"""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

Array = jax.Array
SETTLED_SPEED = 0.1  # m/s: slower pieces inside a block count as settled (paper, section 2.1)


T = TypeVar("T")


def as_array(array: Any) -> Array:
    """numpy's array (or number) as it is, where a tree has one of JAX's: what is built is of numpy
    until it is complete.
    """
    return array


def static_field() -> Any:
    """A field that is part of what is compiled, not an array."""
    return dataclasses.field(metadata={"static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(static_field,))
def pytree(cls: type[T]) -> type[T]:
    """Make a frozen dataclass that JAX sees as a tree of its fields, the ``static_field`` ones as
    part of its structure; its method ``replace(**changes)`` gives the same but for the changes.
    """
    cls = dataclasses.dataclass(frozen=True)(cls)
    cls.replace = dataclasses.replace  # type: ignore[attr-defined]
    return jax.tree_util.register_dataclass(cls)


class PytreeBase:
    """For type checkers, which do not see that ``pytree`` gives a class a method."""

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self: ...


@pytree
class PolytopeFeatures(PytreeBase):
    """Faces, corners and edges of S convex polytopes, padded to the same counts, for
    ``narrow_phase.feature_search``.
    """

    planes: Array  # [4, F, S]: outward unit normals and offsets (m) of the polytope by which depth
    # and normal are found
    corners: Array  # [3, V, S] (m): its corners
    edges: Array  # [13, E, S]: its edges: middle (m), unit direction, half length (m), unit
    # directions into both its faces
    extreme_vertices: Array  # [3, 14, S] (m): its corners that are furthest along its axes and
    # between them
    part_planes: Array  # [4, F', S]: of the part itself, where others continue it; else the same
    part_corners: Array  # [3, V', S] (m): likewise
    interior_faces: Array | None  # [F', S]: 1 for own faces that other parts of the piece cover, 0
    # for all others
    face_vertices: Array  # [k, F', S] int32: the corners of each of its own faces, some repeated
    counts: Array  # [4, S] int32: how many planes, corners, edges and own planes a shape has; the
    # rest repeats its first
    all_clip: bool = static_field()  # whether any is a part that others continue
    is_bent: bool = static_field()  # whether any is a panel that others continue at an angle


@pytree
class Hulls(PytreeBase):
    """A table of S convex polytopes, padded by repetition to the same counts of faces, corners and
    edge directions.

    Gathered to pairs, the last axis is the pair; with one shape it stays 1 and broadcasts.
    """

    normals: tuple[Array, Array, Array]  # [F, S] x 3: outward unit normals; of a zonotope face f +
    # F/2 is opposite to face f
    offsets: Array  # [F, S] (m): n . x <= offset
    corners: tuple[Array, Array, Array] | None  # [k, F, S] x 3 (m): corners of each face in order,
    # some repeated
    face_loops: Array | None  # [3 (1 + k), F S] (m): the same as columns, each closed by its first
    # corner; of zonotopes, whose edges come in opposite pairs, [3 (1 + k/2), F S]: centre of the
    # face, then the first half of its edges
    row: Array  # [S] int32: which shape of the table
    vertices: tuple[Array, Array, Array]  # [V, S] x 3 (m)
    directions: tuple[Array, Array, Array]  # [D, S] x 3: unit edge directions
    bounding_radius: Array  # [S] (m)
    half_lengths: Array | None  # [D, S] (m): of a zonotope, the lengths of its generators
    cross_widths: Array | None  # [D, F/2, S] (m): of a zonotope, C of collide._zonotope_axes
    seams: tuple[Array, Array, Array] | None  # [m, S] x 3: of a panel, outward across each edge
    # where another continues its plane; else 0
    open_edges: Array | None  # [k, F S]: how much of an edge is one of the surface, 0 where another
    # panel or part continues it in a plane, else 1, as columns; not gathered to pairs
    interior_faces: Array | None  # [F, S]: 1 for faces that other parts of the piece cover, 0 for
    # all others
    features: PolytopeFeatures | None  # of polytopes that are not all zonotopes of few edges, for
    # contacts of polytopes
    extended: "Hulls | None"  # of which depth and normal are found, of a part that others continue
    # more of the piece; None: these
    is_zonotope: bool = static_field()


@pytree
class SupportFaces(PytreeBase):
    """Which faces of P pairs of polytopes can look most along the normal of their contact, while it
    stays near a direction.

    Sides are those of a and of b, in the frame of the body that they belong to.
    """

    rows: tuple[Array, Array]  # [P] int32: the two in the table
    normals: Array  # [3, Kd, 2, P]: of the faces of each side that look most along it
    faces: Array  # [Kd, 2, P] int32: which these are
    direction: Array  # [3, 2, P]: outward normal of the contact
    validity_radius: Array  # [P]: by which the normal may differ from that; negative: nothing is
    # known


@pytree
class ActiveFeatures(PytreeBase):
    """The features of P pairs of convex polytopes that can decide their contact until they have
    moved, see ``narrow_phase.feature_search``.

    Pairs of arrays, and sides, [.., 2, P], are those of a and of b, in the frame of the body that
    they belong to.
    """

    rows: tuple[Array, Array]  # [P] int32: the two in the table
    faces: Array  # [4, Kf, 2, P]: normals and offsets (m) of faces
    corners: Array  # [3, Kv, 2, P] (m): of b that the faces of a may meet, and of a that those of b
    # may
    edges: tuple[Array, Array]  # [13, Ke, P]: couples of edges, as in Features
    clip_planes: Array  # [4, Kc, 2, P]: planes of own faces of b that may cut a, and of a that may
    # cut b
    needs_all_planes: Array  # [P] bool: whether more of them than these may
    validity_radius: Array  # [P] (m): way within which that is certain; negative: nothing is known
    offset: Array  # [3, P] (m): b's origin in a's frame at the look ...
    rotation: Array  # [9, P]: ... and rows of the rotation from b's frame to a's
    depth: Array  # [P] (m): their overlap then


@pytree
class Pieces(PytreeBase):
    """The N pieces. The principal frame of a piece is its body frame here."""

    mass: Array  # [N] (kg)
    inertia: Array  # [3, N] (kg m2): principal moments
    size: Array  # [N] (m): L of eqs 7 and 8
    curvature: Array  # [N] (1/m): of the sphere of equal volume
    material: Array  # [N] int32: row of Materials
    bounding_radius: Array  # [N] (m): about the centre of mass
    width: Array  # [N] (m): smallest width, of several parts of the narrowest: the measure of how
    # deep a contact is


@pytree
class Parts(PytreeBase):
    """The M convex parts of the pieces, piece by piece: what touches. Mostly each piece is its own
    only part.
    """

    owner: Array | None  # [M] int32: the piece that it is a part of; None: M = N, part k is piece k
    surface: Array | None  # [M] int32: the same number for parts that continue each other, -1 of
    # all others; None: all -1
    centre: Array | None  # [3, M] (m): in the principal frame of the piece, whose axes the part has
    # too; None: 0
    radius: Array  # [M] (m): of a sphere; 0 of a polytope
    bounding_radius: Array  # [M] (m): about the part's own centre
    polytopes: Array  # int32: which parts are polytopes ...
    spheres: Array  # int32: ... and which are spheres

    @property
    def count(self) -> int:
        """M."""
        return self.radius.shape[0]

    def owning_piece(self, part: Any) -> Any:
        """The piece that each part belongs to."""
        return part if self.owner is None else self.owner[part]


@pytree
class LoadCellModel(PytreeBase):
    """A spring and a damper along the vertical (z) that carry some wall groups as one rigid body."""

    mass: Array  # (kg): of all that it carries of itself: bucket, flaps, and what of the cell moves
    # with them
    stiffness: Array  # (N/m)
    damping: Array  # (N s/m)
    groups: Array  # [G]: 1 for the groups that it carries, 0 for all others
    panels: Array  # [W]: likewise


@pytree
class FlapDrives(PytreeBase):
    """Drives of limited torque that swing some of the G wall groups about their hinges."""

    groups: Array  # [G]: 1 for those, 0 for all others, whose motion is given
    axis: Array  # [3, G]: of the hinge, unit
    torque: Array  # [G] (N m): at most
    inertia: Array  # [G] (kg m2)
    stiffness: Array  # [G] (N m/rad)
    damping: Array  # [G] (N m s/rad)

    @property
    def is_driven(self) -> Array:
        """Which groups have one, [G] bool."""
        return self.groups > 0


@pytree
class CollisionBins(PytreeBase):
    """What is asked of the collisions with walls."""

    slowest: Array  # (m/s): a slower touch is not counted
    fastest: Array  # (m/s): where the last class of speeds begins to count all that is faster too
    classes: int = static_field()  # of speeds, of equal width
    cells: int = static_field()  # of the map along each side of the box around a panel


@pytree
class Plates(PytreeBase):
    """Panels for contacts with spheres: convex polygons of some thickness, in the panel's frame, z
    along the surface's normal.

    Padded by repetition of an edge to the same number k of edges. Gathered to pairs, the last axis
    is the pair.
    """

    corners: tuple[Array, Array]  # [k, W] x 2 (m): x and y, where each edge begins,
    # counter-clockwise
    directions: tuple[Array, Array]  # [k, W] x 2: unit, of each edge
    lengths: Array  # [k, W] (m)
    half_thickness: Array  # [W] (m)
    seams: tuple[Array, Array, Array] | None  # [m, W] x 3: as in ``Hulls``


@pytree
class Walls(PytreeBase):
    """Convex plates in G groups, each group moved as a rigid body or at rest.

    A name that forces are reported under may stand for several groups (``wb_flaps`` for both
    flaps).
    """

    centre: Array  # [3, W] (m): in the scene's rest pose
    rotation: Array  # [3, 3, W]: panel frame (z along the surface's normal) to scene, in the rest
    # pose
    half_extent: Array  # [3, W] (m): of the box around the panel, in its frame
    group: Array  # [W] int32
    material: Array  # [W] int32: row of Materials
    plates: Plates
    plane: Array | None  # [W] int32: the same number for panels that are one surface, -1 for all
    # others
    pivot: Array  # [3, G] (m): moves with the group; torques are about it; on the axis of a hinge
    motions: tuple  # of the kinds in walls.motion, each of all groups that move so; none: all rest
    load_cell: LoadCellModel | None  # None: no group is on one
    drive: FlapDrives | None  # None: no group has one
    is_bent: bool = static_field()  # whether panels of one surface meet at an angle, see
    # ``contacts.smooth_surfaces``
    groups: tuple[str, ...] = static_field()  # names of the G groups
    reports: tuple[tuple[str, tuple[int, ...]], ...] = static_field()  # ((reported name, (group,
    # ...)), ...)

    @property
    def has_motion(self) -> bool:
        """Whether any group moves."""
        return bool(self.motions) or self.load_cell is not None


@pytree
class Materials(PytreeBase):
    """The M materials of pieces and walls, and what each pair of them has; [1, 1] where all pairs
    have the same.
    """

    youngs_modulus: Array  # [M] (Pa): softened by NSF
    poisson_ratio: Array  # [M]
    restitution: Array  # [M, M]: epsilon of eq. 6
    friction: Array | None  # [M, M]: mu; None: no pair has any, and nothing of friction is computed
    pull_off: Array | None  # [M, M] (N): largest adhesive force; None: no pair has any
    rolling: Array | None  # [M, M]: mu_r; None: no pair has any
    is_wall: tuple[bool, ...] = static_field()  # [M] bool: whether it is a material of walls


class Partition(NamedTuple):
    """What jax-md's list must know before anything is compiled. Cells are counted round and round,
    as in a periodic box.
    """

    diameter: float  # (m): of the largest bounding sphere
    reach: float  # (m): largest gap within which pairs are listed
    sides: tuple[int, int, int]  # numbers of cells, at least 3
    pairs: int  # most pairs in the list
    cell: int  # most pieces in a cell


@pytree
class System(PytreeBase):
    """All that never changes while a scene runs: arrays, and the static choices that decide what is
    compiled.
    """

    pieces: Pieces
    parts: Parts
    hulls: Hulls | None  # shapes of the polytopes among the parts, then of the panels
    shape: Array  # [M + W] int32: row of each body in the table of hulls (0 of a sphere)
    walls: Walls
    materials: Materials
    law: Any  # a contact law, see contact.law
    reach: Array  # (m): the longest gap across which the law acts; 0: none
    gravity: Array  # [3] (m/s2)
    dt: Array  # (s)
    resolved: Array  # 1, or 0 where dt is more than RESOLVED of the stability limit
    substeps: Array  # int32: steps per sample (per part of a sample, if it has parts), at most
    # block_steps
    skin: Array  # (m): pairs nearer than this, beyond the way that present speeds take them, are
    # candidates
    block_low: Array  # [3, B] (m): corners of the blocks in which settled mass is counted
    block_high: Array  # [3, B] (m)
    domain_low: Array  # [3] (m): a piece outside has left the scene
    domain_high: Array  # [3] (m)
    capacity: tuple[tuple[str, int, int], ...] = static_field()  # of each kind of contact that the
    # scene has its name (see neighbours), candidates, slots
    touching: int = static_field()  # most contacts that a piece may have at once
    neighbours: str = static_field()  # how pairs of pieces are found, as in scene.RunSettings
    row_capacity: int = static_field()  # most pieces in three neighbouring cells in a row, where
    # there are cells
    partition: Partition | None = static_field()  # of jax-md's list
    has_hulls: bool = static_field()  # whether any piece is not a sphere
    alike: tuple[str, ...] = static_field()  # "hulls" if all polytopes of pieces are one shape,
    # "spheres" if all spheres are, of one material; never of pieces of several parts
    escape_stops: bool = static_field()  # whether a piece outside the domain stops the run
    has_rotation: bool = static_field()
    may_tie: bool = static_field()  # whether separating axes of polytopes may tie exactly: of
    # pieces that a scene places one by one
    ledger: bool = static_field()  # whether work and dissipation are added up
    statistics: CollisionBins | None  # of collisions with walls; None: nothing of them is computed
    sample_parts: int = static_field()  # a sample interval of more steps than the next is cut into
    # so many parts, a rebuild before each
    block_steps: int = static_field()  # most steps between rebuilds of the pairs; one comes before
    # the sample that exceeds it
    slot_block: int = static_field()  # contacts are computed so many at a time, at most; 0: all
    # slots at once
    present: Array | None  # [N] bool: False for the last pieces of a run that has fewer than others
    # of its ensemble; None: all are
    exchanges: bool = static_field()  # whether pieces come in and leave: State.exchange
    runs: int = static_field()  # R, how many runs this is, side by side; they do not see each other
    blocks: tuple[str, ...] = static_field()  # names of the B blocks
    quantities: tuple = static_field()  # dynamics.quantity.Quantity of all that is sampled


@pytree
class PatchMarker(PytreeBase):
    """A mark, without numbers: bodies that touch over a patch, not at a point, and rub about its
    normal too.
    """


@pytree
class ContactHistory(PytreeBase):
    """What contacts remember of the last step."""

    overlap: Array  # [P] (m): s_n, more by the law's reach; 0: no contact
    point: Array  # [3, P] (m): contact point relative to the centre of b, world axes
    law: Any  # [.., P]: the history that the contact law keeps
    arm: Array | None = None  # [P] (m): of friction about the normal; None: of contacts without a
    # patch
    tied: Array | None = None  # [P]: 1 where several separating axes tied as the contact began,
    # else 0; None: none can


@pytree
class ContactTable(PytreeBase):
    """P slots for contacts between two kinds of bodies; an empty slot has a = -1.

    Bodies are numbered parts first, then panels. b is always a part, a is a part or a panel.
    """

    a: Array  # [P] int32
    b: Array  # [P] int32
    memory: ContactHistory


@pytree
class PairConstants(PytreeBase):
    """What stays the same in each slot between two rebuilds."""

    live: Array  # [P] bool: whether the slot holds a pair
    a: Array  # [P] int32: as in the table, 0 where empty
    b: Array  # [P] int32
    radius_a: Array  # [P] or [1] (m): of spheres
    radius_b: Array  # [P] or [1] (m)
    width: Array  # [P] or [1] (m): of the narrower piece
    pair: Any  # [P] or [1]: the constants of the contact law
    hull_a: Hulls | None = None  # [.., P] or [.., 1]; of polytopes with Features none
    hull_b: Hulls | None = None
    plate_a: Plates | None = None  # [.., P]: of spheres on walls
    surface_a: Array | None = None  # [P] int32: of a, where others continue it: Walls.plane, or
    # beyond those Parts.surface; else -1
    surface_b: Array | None = None  # [P] int32: Parts.surface of b
    patch: PatchMarker | None = None  # None: they touch at a point, or without friction


@pytree
class SharedContacts(PytreeBase):
    """The contacts of the same surface with the same surface as each slot has, itself among them;
    none where no other body continues any of the two. See ``contacts.contact_reduction``.
    """

    order: Array  # [P] int32: slots, siblings next to each other and in order
    first: Array  # [P] int32: where in it those of each slot begin
    number: Array  # [P] int32: how many there are
    most: Array | int  # [] int32: of any slot; an int, touching, to go through all, which can be
    # differentiated


@pytree
class Ledger(PytreeBase):
    """What each run adds up; ``impulse``, ``peak`` and ``overlap`` start anew with each sample
    interval.
    """

    impulse: Array  # [3, G, R] (N s): of the pieces on each wall group
    peak: Array  # [reports, R] (N): largest force of the pieces along gravity on what Walls.reports
    # names, of all steps
    overlap: Array  # [R] (-): largest overlap relative to the width of the piece
    taken: Array  # [R] (J): work that contacts took: what they store and what is lost
    wall_work: Array  # [R] (J): work of the walls on the pieces


@pytree
class OverflowReport(PytreeBase):
    """What must not happen silently, as data: the host looks at it after each chunk."""

    needed: dict[str, Array]  # kind of contact -> int32 [2]: most candidates and slots that any
    # rebuild wanted
    touching: Array  # int32: most contacts of one piece that any rebuild wanted
    row: Array  # int32: most pieces in three neighbouring cells in a row
    partition: Array  # int32 [2]: most pairs, and most pieces in a cell, that any list of jax-md
    # wanted
    reach: Array  # (m): the largest reach that any list of jax-md wanted
    travel: Array  # (m): most that two bodies can have approached each other between rebuilds,
    # beyond Scratch.lead
    start_overlap: Array  # (-): largest overlap at the first rebuild, relative to the width of the
    # piece; -1: not yet
    start_pair: Array  # [2] int32: a and b of that pair


@pytree
class PieceMotion(PytreeBase):
    """How the pieces of all runs move, and the loads on them. Velocities and momenta are at the
    time of the positions.
    """

    position: Array  # [3, N] (m): centres of mass
    position_rest: Array  # [3, N] (m): what rounding left over of the position (zero in double
    # precision)
    orientation: Array  # [4, N]: unit quaternion w x y z, principal frame to world
    orientation_rest: Array  # [4, N]: what rounding left over of the orientation (zero in double
    # precision)
    velocity: Array  # [3, N] (m/s)
    velocity_rest: Array  # [3, N] (m/s): what rounding left over of the velocity
    angular_momentum: Array  # [3, N] (kg m2/s), world frame
    force: Array  # [3, N] (N): of contacts
    torque: Array  # [3, N] (N m): of contacts, about the centre of mass


@pytree
class WallLoads(PytreeBase):
    """Loads of the pieces on each wall group."""

    force: Array  # [3, G, R] (N)
    torque: Array  # [3, G, R] (N m): about the group's pivot


@pytree
class LoadCellMotion(PytreeBase):
    """How what a load cell carries moves, about where it is without pieces."""

    deflection: Array  # [R] (m), downwards
    velocity: Array  # [R] (m/s), at the time of the deflection


@pytree
class FlapDriveMotion(PytreeBase):
    """By how much flaps with a drive are turned beyond their motion, about the axis of the hinge; 0
    of all others.
    """

    lag: Array  # [G, R] (rad)
    rate: Array  # [G, R] (rad/s), at the time of the lag


@pytree
class CollisionTotals(PytreeBase):
    """What collisions with the walls have added up to since the first step; C = W cells^2 places on
    the panels.
    """

    cells: Array  # [3, C, R]: number, normal impulse (N s) and work that contacts took (J) in each
    # place
    speeds: Array  # [classes, G, R]: number by impact speed
    moments: Array  # [2, G, R] (m/s): sum of the impact speeds, and the largest
    load: Array  # [9, G, N] (N, N m): of each group on each piece: force, torque about its centre,
    # about the group's pivot
    place: Array  # [G, N] int32: where each piece last pushed on each group


@pytree
class PieceExchange(PytreeBase):
    """Which pieces are in the scene, and what came into it and left it; all others wait outside, at
    rest.
    """

    there: Array  # [N] bool
    count: Array  # [2, R] int32: pieces that came in, and that were taken out
    mass: Array  # [2, R] (kg): likewise
    energy: Array  # [R] (J): kinetic and potential, of what came in less that of what was taken out
    last: Array  # int32: step at which pieces were last exchanged


@pytree
class Scratch(PytreeBase):
    """What the rebuild at the beginning of each block of steps fills anew, from the rest of the
    state.
    """

    slots: dict[str, PairConstants]  # by kind of contact
    filled: dict[str, Array]  # kind of contact -> int32: how many slots hold a pair, the first ones
    max_contacts: Array  # int32: most contacts of a piece
    wall_contacts: Array  # [2, touching, N] int32: like ``State.incidence`` of contacts with walls,
    # and the numbers of their groups
    max_wall_contacts: Array  # int32: most contacts of a piece with walls
    loads: Array  # [7, columns] (N, N m, N): of each contact force and torque on a piece, about its
    # centre, and the rise of the force on b along gravity, see ``Response.rise``: all on b, then
    # all on a, kind by kind; one more column holds zeros
    rebuild_step: Array  # int32: the step of the rebuild
    displacement: Array  # [R] (m): most that two bodies can have approached each other since then
    # ...
    displacement_rate: Array  # [R] (m): ... of it in the last step
    expected_displacement: Array  # [R] (m): most that two bodies approach each other at the speeds
    # they had then, until the next rebuild
    shared_contacts: dict[str, SharedContacts]  # by kind of contact, where surfaces go on
    shares: dict[str, Array]  # likewise, [P]: the part that each slot has of a contact that several
    # have together
    active_features: dict[str, ActiveFeatures]  # by kind of contact, of polytopes with Features;
    # none where each step looks at all features
    support_faces: dict[str, SupportFaces]  # likewise
    is_first: Array  # bool: whether no overlap of near polytopes was noted in the guard yet
    remaining_margin: Array | None  # [P] (m): way that each pair of polytopes may still move before
    # it is asked whether a look is due
    refreshed_at: Array  # int32: after which step that was the way to go
    pending_bodies: Array | None  # [rows, M + W]: bodies.stack of the step that a look is due for,
    # or of the last one
    pending_step: Array  # int32: that step


@pytree
class State(PytreeBase):
    """What a step changes."""

    step: Array  # int32: time is step * dt
    motion: PieceMotion
    walls: WallLoads
    cell: LoadCellMotion | None  # None: no wall is on a load cell
    drive: FlapDriveMotion | None  # None: no flap has a drive of limited torque
    collisions: CollisionTotals | None  # None: nobody asked for them
    exchange: PieceExchange | None  # None: all pieces are there from beginning to end
    contacts: dict[str, ContactTable]  # by kind of contact
    incidence: Array  # [touching, N] int32: where the contacts of each piece stand among all (see
    # neighbours.find_incidence)
    ledger: Ledger
    guard: OverflowReport
    scratch: Scratch

    position = property(lambda self: self.motion.position)
    orientation = property(lambda self: self.motion.orientation)
    velocity = property(lambda self: self.motion.velocity)
    angular_momentum = property(lambda self: self.motion.angular_momentum)

    def replace_motion(self, **fields: Any) -> "State":
        """The state with some fields of its motion replaced."""
        return self.replace(motion=self.motion.replace(**fields))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sample:
    """What is read of each run at the end of a sample interval: the quantities of a System, each an
    attribute too.
    """

    values: dict[str, Array]  # name of the quantity -> [its axes, the last one first, R]

    def __getattr__(self, name: str) -> Array:
        values = self.__dict__.get("values", {})  # not there while it is unpickled
        if name not in values:
            raise AttributeError(f"a sample has no {name!r}; it has: {', '.join(values)}")
        return values[name]

    def replace(self, **values: Array) -> "Sample":
        """With other values of some quantities."""
        return Sample(self.values | values)


def float_dtype(precision: str) -> Any:
    """The dtype of a precision, "f32" or "f64"."""
    return {"f32": jnp.float32, "f64": jnp.float64}[precision]
