"""Data types of a simulation: System (constant during a run), State (changed by a step), Sample
(observables).

All are frozen dataclasses registered as pytrees. Arrays have the piece, part, panel or contact
index last; leading axes hold components. N pieces of M convex parts, W panels in G wall groups, B
blocks, P contact slots. SI units. R runs, mostly one, are computed as one system of independent
runs: N counts the pieces of all runs, and arrays per run have R last
(``contacts.batch_reduction``).
"""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

Array = jax.Array
SETTLED_SPEED = 0.1  # m/s: slower pieces inside a block count as settled (paper, section 2.1)


T = TypeVar("T")


def as_array(array: Any) -> Array:
    """Return a numpy array or number unchanged, typed as a JAX array: trees are assembled in numpy
    until they are complete.
    """
    return array


def static_field() -> Any:
    """A field that is part of the compiled program's structure, not an array."""
    return dataclasses.field(metadata={"static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(static_field,))
def pytree(cls: type[T]) -> type[T]:
    """Make a frozen dataclass that JAX treats as a tree of its fields, with ``static_field`` fields
    as part of its structure. Its method ``replace(**changes)`` returns a copy with changes.
    """
    cls = dataclasses.dataclass(frozen=True)(cls)
    cls.replace = dataclasses.replace  # type: ignore[attr-defined]
    return jax.tree_util.register_dataclass(cls)


class PytreeBase:
    """Base class for type checkers, which do not see the method that ``pytree`` adds."""

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self: ...


@pytree
class PolytopeFeatures(PytreeBase):
    """Faces, corners and edges of S convex polytopes, padded to the same counts, for
    ``narrow_phase.feature_search``.
    """

    planes: Array  # [4, F, S]: outward unit normals and offsets (m) of the polytope from which
    # depth and normal are found
    corners: Array  # [3, V, S] (m): its corners
    edges: Array  # [13, E, S]: its edges: middle (m), unit direction, half length (m), unit
    # directions into both its faces
    extreme_vertices: Array  # [3, 14, S] (m): its support points along 14 fixed directions
    part_planes: Array  # [4, F', S]: of the part itself, if others continue it; else the same as
    # planes
    part_corners: Array  # [3, V', S] (m): the same for corners
    interior_faces: Array | None  # [F', S]: 1 for own faces that other parts of the piece cover, 0
    # for all others
    face_vertices: Array  # [k, F', S] int32: the corners of each own face, some repeated
    counts: Array  # [4, S] int32: numbers of planes, corners, edges and own planes of a shape;
    # further entries repeat the first
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
    row: Array  # [S] int32: row of the shape in the table
    vertices: tuple[Array, Array, Array]  # [V, S] x 3 (m)
    directions: tuple[Array, Array, Array]  # [D, S] x 3: unit edge directions
    bounding_radius: Array  # [S] (m)
    half_lengths: Array | None  # [D, S] (m): of a zonotope, the lengths of its generators
    cross_widths: Array | None  # [D, F/2, S] (m): of a zonotope, C of
    # collision_primitives._zonotope_overlaps
    seams: tuple[Array, Array, Array] | None  # [m, S] x 3: of a panel, outward across each edge
    # where another continues its plane; else 0
    open_edges: Array | None  # [k, F S]: openness of edges: 0 where another panel or part continues
    # the surface in a plane, 1 at edges of the surface, as columns; not gathered to pairs
    interior_faces: Array | None  # [F, S]: 1 for faces that other parts of the piece cover, 0 for
    # all others
    features: PolytopeFeatures | None  # for contacts of polytopes, unless all are zonotopes with
    # few edge directions
    extended: "Hulls | None"  # extended polytopes from which depth and normal are found, for parts
    # that others continue; None: the polytopes themselves
    is_zonotope: bool = static_field()


@pytree
class SupportFaces(PytreeBase):
    """Candidate support faces of P pairs of polytopes: those that can be most aligned with the
    normal of the contact while it stays near a direction.

    Sides are those of a and of b, in the frame of the body that they belong to.
    """

    rows: tuple[Array, Array]  # [P] int32: the two in the table
    normals: Array  # [3, Kd, 2, P]: of the faces of each side that are most aligned with the
    # direction
    faces: Array  # [Kd, 2, P] int32: indices of these faces
    direction: Array  # [3, 2, P]: outward normal of the contact
    validity_radius: Array  # [P]: deviation of the normal within which these are valid; negative:
    # invalid


@pytree
class ActiveFeatures(PytreeBase):
    """The features of P pairs of convex polytopes that can determine their contact within a
    validity radius, see ``narrow_phase.feature_search``.

    Pairs of arrays, and sides, [.., 2, P], are those of a and of b, in the frame of the body that
    they belong to.
    """

    rows: tuple[Array, Array]  # [P] int32: the two in the table
    faces: Array  # [4, Kf, 2, P]: normals and offsets (m) of faces
    corners: Array  # [3, Kv, 2, P] (m): corners of b that the faces of a may touch, and of a that
    # those of b may
    edges: tuple[Array, Array]  # [13, Ke, P]: edge pairs, as in PolytopeFeatures
    clip_planes: Array  # [4, Kc, 2, P]: planes of own faces of b that may cut a, and of a that may
    # cut b
    needs_all_planes: Array  # [P] bool: whether further planes may
    validity_radius: Array  # [P] (m): relative displacement within which the features are valid;
    # negative: invalid
    offset: Array  # [3, P] (m): b's origin in a's frame at the search ...
    rotation: Array  # [9, P]: ... and rows of the rotation from b's frame to a's
    depth: Array  # [P] (m): overlap at the search


@pytree
class Pieces(PytreeBase):
    """The N pieces. The principal frame of a piece is its body frame here."""

    mass: Array  # [N] (kg)
    inertia: Array  # [3, N] (kg m2): principal moments
    size: Array  # [N] (m): L of eqs 7 and 8
    curvature: Array  # [N] (1/m): of the sphere of equal volume
    material: Array  # [N] int32: row of Materials
    bounding_radius: Array  # [N] (m): about the centre of mass
    width: Array  # [N] (m): smallest width, of the narrowest of several parts; scale of the
    # relative overlap


@pytree
class Parts(PytreeBase):
    """The M convex parts of the pieces, piece by piece, which are the bodies in contact. Mostly
    each piece is its own only part.
    """

    owner: Array | None  # [M] int32: the piece that it is a part of; None: M = N, part k is piece k
    surface: Array | None  # [M] int32: surface number, equal for parts that continue each other, -1
    # for all others; None: all -1
    centre: Array | None  # [3, M] (m): in the principal frame of the piece, which also gives the
    # axes of the part; None: 0
    radius: Array  # [M] (m): of a sphere; 0 of a polytope
    bounding_radius: Array  # [M] (m): about the part's own centre
    polytopes: Array  # int32: which parts are polytopes ...
    spheres: Array  # int32: ... and which are spheres

    @property
    def count(self) -> int:
        """Number of parts, M."""
        return self.radius.shape[0]

    def owning_piece(self, part: Any) -> Any:
        """Index of the piece that each part belongs to."""
        return part if self.owner is None else self.owner[part]


@pytree
class LoadCellModel(PytreeBase):
    """A spring and a damper along the vertical (z) that carry some wall groups as one rigid
    body.
    """

    mass: Array  # (kg): of the bucket, its flaps and the moving part of the cell
    stiffness: Array  # (N/m)
    damping: Array  # (N s/m)
    groups: Array  # [G]: 1 for the groups that it carries, 0 for all others
    panels: Array  # [W]: the same for panels


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
        """Groups that have a drive, [G] bool."""
        return self.groups > 0


@pytree
class CollisionBins(PytreeBase):
    """Bins of the statistics of collisions with walls."""

    slowest: Array  # (m/s): a slower touch is not counted
    fastest: Array  # (m/s): the last class of speeds includes all faster touches
    classes: int = static_field()  # of speeds, of equal width
    cells: int = static_field()  # of the map along each side of the box around a panel


@pytree
class Plates(PytreeBase):
    """Panels for contacts with spheres: convex polygons with a thickness, in the panel's frame, z
    along the surface normal.

    Padded by repetition of an edge to the same number k of edges. Gathered to pairs, the last axis
    is the pair.
    """

    corners: tuple[Array, Array]  # [k, W] x 2 (m): x and y, where each edge begins,
    # counter-clockwise
    directions: tuple[Array, Array]  # [k, W] x 2: unit, of each edge
    lengths: Array  # [k, W] (m)
    half_thickness: Array  # [W] (m)
    seams: tuple[Array, ...] | None  # [k, W] x 5: 1 for an edge at which
    # another panel continues this one, else 0; the unit directions (x, y), or 0, in which the
    # outline of that panel goes on from where the edge begins and from where it ends


@pytree
class Walls(PytreeBase):
    """Convex plates in G groups, each moved as a rigid body or at rest.

    A reported name of forces may stand for several groups (``wb_flaps`` for both flaps).
    """

    centre: Array  # [3, W] (m): in the scene's rest pose
    rotation: Array  # [3, 3, W]: panel frame (z along the surface's normal) to scene, in the rest
    # pose
    half_extent: Array  # [3, W] (m): of the box around the panel, in its frame
    group: Array  # [W] int32
    material: Array  # [W] int32: row of Materials
    plates: Plates
    plane: Array | None  # [W] int32: surface number of panels that continue each other, -1 for all
    # others
    pivot: Array  # [3, G] (m): moves with the group; torques are about it; on the axis of a hinge
    motions: tuple  # kinds of walls.motion, each for all groups; empty if all rest
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
class PatchMarker(PytreeBase):
    """A marker without numbers: the bodies touch over a patch, not at a point, and have friction
    about the normal.
    """


# What each pair of materials has: a table in Materials, values of pairs of bodies in MaterialPair.
PAIR_PROPERTIES = ("restitution", "friction", "pull_off", "rolling")


@pytree
class Materials(PytreeBase):
    """The M materials of pieces and walls, and the properties of each pair of them; [1, 1] if all
    pairs have the same value.
    """

    youngs_modulus: Array  # [M] (Pa): softened by NSF
    poisson_ratio: Array  # [M]
    restitution: Array  # [M, M]: epsilon of eq. 6
    friction: Array | None  # [M, M]: mu; None: no pair has any, and friction is not computed
    pull_off: Array | None  # [M, M] (N): largest adhesive force; None: no pair has any
    rolling: Array | None  # [M, M]: mu_r; None: no pair has any
    is_wall: tuple[bool, ...] = static_field()  # [M] bool: whether it is a material of walls


class MaterialPair(NamedTuple):
    """Properties of two bodies, b a piece and a a piece or a wall, as input of a law; arrays [P],
    or [1] if all pairs are alike.

    Moduli are softened by NSF. Tuples hold the values of a and of b.
    """

    youngs_modulus: tuple[Array, Array]  # (Pa)
    poisson_ratio: tuple[Array, Array]
    size: tuple[Array, Array]  # (m): L of eqs 7 and 8; for a wall that of the piece
    curvature: tuple[Array, Array]  # (1/m): one over the radius; 0 for a wall, for a polytope that
    # of the sphere of its size
    mass: Array  # (kg): effective mass
    restitution: Array
    friction: Array | None  # mu; None where no pair of the scene has any
    pull_off: Array | None  # (N): largest adhesive force; None where no pair of the scene has any
    rolling: Array | None = None  # mu_r; None where no pair of the scene has any
    patch: PatchMarker | None = None  # for polytopes with friction; None for bodies that touch at a
    # point

    @property
    def stiffness(self) -> Array:
        """K (N/m): E L of both in series, eqs 5, 7 and 8."""
        a, b = (e * size for e, size in zip(self.youngs_modulus, self.size, strict=True))
        return a * b / (a + b)


class Partition(NamedTuple):
    """Static sizes of jax-md's neighbour list. Cells are counted cyclically, as in a periodic
    box.
    """

    diameter: float  # (m): of the largest bounding sphere
    reach: float  # (m): largest gap within which pairs are listed
    sides: tuple[int, int, int]  # numbers of cells, at least 3
    pairs: int  # most pairs in the list
    cell: int  # most pieces in a cell


@pytree
class System(PytreeBase):
    """All data that are constant during a run: arrays, and the static choices that determine the
    compiled program.
    """

    pieces: Pieces
    parts: Parts
    hulls: Hulls | None  # shapes of the polytopes among the parts, then of the panels
    shape: Array  # [M + W] int32: row of each body in the table of hulls (0 of a sphere)
    walls: Walls
    materials: Materials
    law: Any  # a contact law, see contact_laws
    reach: Array  # (m): the longest gap across which the law acts; 0: none
    gravity: Array  # [3] (m/s2)
    dt: Array  # (s)
    resolved: Array  # 1, or 0 if dt is more than RESOLVED_SHARE of the stability limit
    substeps: Array  # int32: steps per sample (per part of a sample, if it has parts), at most
    # block_steps
    skin: Array  # (m): pairs nearer than this plus their expected displacement are candidates
    block_low: Array  # [3, B] (m): corners of the blocks in which settled mass is counted
    block_high: Array  # [3, B] (m)
    domain_low: Array  # [3] (m): a piece outside has left the scene
    domain_high: Array  # [3] (m)
    capacity: tuple[tuple[str, int, int], ...] = static_field()  # for each kind of contact in the
    # scene: its name (see neighbour_list), candidates, slots
    touching: int = static_field()  # most contacts that a piece may have at once
    neighbours: str = static_field()  # how pairs of pieces are found, as in scene.RunSettings
    row_capacity: int = static_field()  # most pieces in three neighbouring cells in a row, where
    # there are cells
    partition: Partition | None = static_field()  # of jax-md's list
    has_hulls: bool = static_field()  # whether any piece is not a sphere
    alike: tuple[str, ...] = static_field()  # "hulls" if all polytopes of pieces have one shape,
    # "spheres" if all spheres have one shape and material; empty for pieces of several parts
    escape_stops: bool = static_field()  # whether a piece outside the domain stops the run
    has_rotation: bool = static_field()
    may_tie: bool = static_field()  # whether separating axes of polytopes may tie exactly, as for
    # pieces that a scene places one by one
    ledger: bool = static_field()  # whether work and dissipation are accumulated
    statistics: CollisionBins | None  # of collisions with walls; None without statistics
    sample_parts: int = static_field()  # parts of a sample interval with more than block_steps
    # steps, with a rebuild before each
    block_steps: int = static_field()  # most steps between rebuilds; a rebuild precedes the sample
    # that would exceed it
    slot_block: int = static_field()  # largest number of contacts that are computed at a time; 0:
    # all slots at once
    present: Array | None  # [N] bool: False for the padding of a run with fewer pieces than others
    # of its ensemble; None: all are present
    exchanges: bool = static_field()  # whether pieces enter and leave, see State.exchange
    runs: int = static_field()  # R, number of independent runs in this system
    blocks: tuple[str, ...] = static_field()  # names of the B blocks
    quantities: tuple = static_field()  # dynamics.quantity.Quantity of each sampled quantity


@pytree
class ContactHistory(PytreeBase):
    """History of contacts at the last step."""

    overlap: Array  # [P] (m): s_n plus the law's interaction range; 0: no contact
    point: Array  # [3, P] (m): contact point relative to the centre of b, world axes
    law: Any  # [.., P]: the history that the contact law keeps
    arm: Array | None = None  # [P] (m): of friction about the normal; None for contacts without a
    # patch
    tied: Array | None = None  # [P]: 1 if several separating axes tied when the contact began, else
    # 0; None if none can


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
    """Constants of each slot between two rebuilds."""

    live: Array  # [P] bool: whether the slot holds a pair
    a: Array  # [P] int32: as in the table, 0 where empty
    b: Array  # [P] int32
    radius_a: Array  # [P] or [1] (m): of spheres
    radius_b: Array  # [P] or [1] (m)
    width: Array  # [P] or [1] (m): of the narrower piece
    pair: Any  # [P] or [1]: the constants of the contact law
    hull_a: Hulls | None = None  # [.., P] or [.., 1]; None for polytopes with PolytopeFeatures
    hull_b: Hulls | None = None
    plate_a: Plates | None = None  # [.., P]: of spheres on walls
    surface_a: Array | None = None  # [P] int32: of a, if others continue it: Walls.plane, or
    # numbered after these Parts.surface; else -1
    surface_b: Array | None = None  # [P] int32: Parts.surface of b
    patch: PatchMarker | None = None  # None for contacts at a point, or without friction


@pytree
class SharedContacts(PytreeBase):
    """For each slot the contacts between the same two surfaces, including itself; none if no other
    body continues either surface. See ``contacts.contact_reduction``.
    """

    order: Array  # [P] int32: slots, with merged contacts adjacent and in order
    first: Array  # [P] int32: index in order where the contacts merged with each slot begin
    number: Array  # [P] int32: number of these
    most: Array | int  # [] int32: largest number of any slot; an int, touching, for a
    # differentiable loop over all


@pytree
class Ledger(PytreeBase):
    """Accumulated quantities of each run; ``impulse``, ``peak`` and ``overlap`` restart with each
    sample interval.
    """

    impulse: Array  # [3, G, R] (N s): of the pieces on each wall group
    peak: Array  # [reports, R] (N): largest force of the pieces along gravity on each entry of
    # Walls.reports, of all steps
    overlap: Array  # [R] (-): largest overlap relative to the width of the piece
    taken: Array  # [R] (J): work that contacts took: stored and dissipated energy
    wall_work: Array  # [R] (J): work of the walls on the pieces


@pytree
class OverflowReport(PytreeBase):
    """Overflows and other failures as data, which the host checks after each chunk."""

    needed: dict[str, Array]  # kind of contact -> int32 [2]: most candidates and slots that any
    # rebuild wanted
    touching: Array  # int32: most contacts of one piece that any rebuild wanted
    row: Array  # int32: most pieces in three neighbouring cells in a row
    partition: Array  # int32 [2]: most pairs, and most pieces in a cell, that any list of jax-md
    # wanted
    reach: Array  # (m): the largest reach that any list of jax-md wanted
    travel: Array  # (m): largest possible approach of two bodies between rebuilds, beyond
    # Scratch.expected_displacement
    start_overlap: Array  # (-): largest overlap at the first rebuild, relative to the width of the
    # piece; -1: not yet
    start_pair: Array  # [2] int32: a and b of that pair


@pytree
class PieceMotion(PytreeBase):
    """Motion of the pieces of all runs, and the loads on them. Velocities and momenta are at the
    time of the positions.
    """

    position: Array  # [3, N] (m): centres of mass
    position_rest: Array  # [3, N] (m): rounding residual of the position (zero in double precision)
    orientation: Array  # [4, N]: unit quaternion w x y z, principal frame to world
    orientation_rest: Array  # [4, N]: rounding residual of the orientation (zero in double
    # precision)
    velocity: Array  # [3, N] (m/s)
    velocity_rest: Array  # [3, N] (m/s): rounding residual of the velocity
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
    """Motion of the walls on a load cell, relative to their rest position without pieces."""

    deflection: Array  # [R] (m), downwards
    velocity: Array  # [R] (m/s), at the time of the deflection


@pytree
class FlapDriveMotion(PytreeBase):
    """Rotation of flaps with a drive beyond their prescribed motion, about the axis of the hinge; 0
    for all others.
    """

    lag: Array  # [G, R] (rad)
    rate: Array  # [G, R] (rad/s), at the time of the lag


@pytree
class CollisionTotals(PytreeBase):
    """Totals of the collisions with walls since the first step, on C = W cells^2 places of the
    panels.
    """

    cells: Array  # [3, C, R]: number, normal impulse (N s) and work that contacts took (J) in each
    # place
    speeds: Array  # [classes, G, R]: number by impact speed
    moments: Array  # [2, G, R] (m/s): sum of the impact speeds, and the largest
    load: Array  # [9, G, N] (N, N m): of each group on each piece: force, torque about its centre,
    # torque about the group's pivot
    place: Array  # [G, N] int32: place where each piece last pushed on each group


@pytree
class PieceExchange(PytreeBase):
    """Pieces in the scene, and totals of those that entered and left it; all others wait outside,
    at rest.
    """

    there: Array  # [N] bool
    count: Array  # [2, R] int32: numbers of pieces that entered, and that were removed
    mass: Array  # [2, R] (kg): masses of these
    energy: Array  # [R] (J): kinetic and potential energy of entered minus that of removed pieces
    last: Array  # int32: step at which pieces were last exchanged


@pytree
class Scratch(PytreeBase):
    """Data that the rebuild at the beginning of each block of steps derives from the rest of the
    state.
    """

    slots: dict[str, PairConstants]  # by kind of contact
    filled: dict[str, Array]  # kind of contact -> int32: number of slots that hold a pair; these
    # come first
    max_contacts: Array  # [tiles] int32: most contacts of a piece, in each tile of pieces, see
    # ``contacts.tiling.piece_tile_size``
    wall_contacts: Array  # [2, touching, N] int32: like ``State.incidence`` for contacts with
    # walls, and the numbers of their groups
    max_wall_contacts: Array  # [tiles] int32: the same for contacts with walls
    loads: Array  # [7, columns] (N, N m, N): force and torque of each contact on a piece, about its
    # centre, and the increment of the force on b along gravity, see
    # ``Response.reversal_increment``: all on b, then all on a, kind by kind; one more column holds
    # zeros
    rebuild_step: Array  # int32: the step of the rebuild
    displacement: Array  # [R] (m): largest possible approach of two bodies since then ...
    displacement_rate: Array  # [R] (m): ... and its part in the last step
    expected_displacement: Array  # [R] (m): largest approach of two bodies until the next rebuild,
    # at the speeds of this one
    shared_contacts: dict[str, SharedContacts]  # by kind of contact, if surfaces are shared
    shares: dict[str, Array]  # by kind of contact, [P]: share of each slot in its merged contact
    active_features: dict[str, ActiveFeatures]  # by kind of contact, of polytopes with
    # PolytopeFeatures; empty if each step searches all features
    support_faces: dict[str, SupportFaces]  # by kind of contact, as active_features
    is_first: Array  # bool: whether no initial overlap of polytopes has been recorded yet
    remaining_margin: Array | None  # [P] (m): relative displacement of each pair of polytopes until
    # the next check for a refresh
    refreshed_at: Array  # int32: step at which the features were last refreshed
    pending_bodies: Array | None  # [rows, M + W]: packed bodies of the step for which a refresh is
    # due, or of the last one
    pending_step: Array  # int32: that step


@pytree
class State(PytreeBase):
    """All data that a step changes."""

    step: Array  # int32: time is step * dt
    motion: PieceMotion
    walls: WallLoads
    cell: LoadCellMotion | None  # None: no wall is on a load cell
    drive: FlapDriveMotion | None  # None: no flap has a drive of limited torque
    collisions: CollisionTotals | None  # None without statistics
    exchange: PieceExchange | None  # None: all pieces are in the scene throughout
    contacts: dict[str, ContactTable]  # by kind of contact
    incidence: Array  # [touching, N] int32: columns of the contacts of each piece (see
    # neighbour_list.find_incidence)
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
    """Observables of each run at the end of a sample interval: the quantities of a System, each
    also an attribute.
    """

    values: dict[str, Array]  # name of the quantity -> [its axes, the last one first, R]

    def __getattr__(self, name: str) -> Array:
        values = self.__dict__.get("values", {})  # not set during unpickling
        if name not in values:
            raise AttributeError(f"a sample has no {name!r}; it has: {', '.join(values)}")
        return values[name]

    def replace(self, **values: Array) -> "Sample":
        """The sample with other values of some quantities."""
        return Sample(self.values | values)


def float_dtype(precision: str) -> Any:
    """The dtype of a precision, "f32" or "f64"."""
    return {"f32": jnp.float32, "f64": jnp.float64}[precision]
