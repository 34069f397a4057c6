"""Contact laws: from what two bodies are made of to the force between them.

A law is a value with a type: a frozen pytree (``types.pytree``) of its parameters with the methods
of ``ContactLaw``. There is no base class and no list of names in the step; whatever has these
methods is a law. One file for each law: ``walton_braun`` (the paper's, the default),
``linear_dashpot``, ``hertz_mindlin``, ``densifying`` (foams), ``elastic_plastic`` (restitution that
falls with the speed); ``cohesion`` makes a cohesive law of any of them, ``rolling`` one with
rolling friction; ``friction`` is the tangential spring and ``dashpot`` the damping that they share.
``LAWS`` of ``dem_jax.assembly.contact_law`` has them by the names that a scene uses,
``dem_jax.scene.sections.contact`` has their keys.
"""

from typing import Any, NamedTuple, Protocol

import jax

from dem_jax.contact_laws.springs import Real, combine_in_series
from dem_jax.math.vector import Vector
from dem_jax.types import PatchMarker

Array = jax.Array


class MaterialPair(NamedTuple):
    """Two kinds of bodies, b a piece and a a piece or a wall, as a law sees them; arrays [P], or
    [1] where all are alike.

    Moduli are softened by NSF. Pairs of arrays are of a and of b.
    """

    youngs_modulus: tuple[Array, Array]  # (Pa)
    poisson_ratio: tuple[Array, Array]
    size: tuple[Array, Array]  # (m): L of eqs 7 and 8; of a wall that of the piece
    curvature: tuple[Array, Array]  # (1/m): one over the radius; of a wall 0, of a polytope that of
    # the sphere of its size
    mass: Array  # (kg): effective mass
    restitution: Array
    friction: Array | None  # mu; None where no pair of the scene has any
    pull_off: Array | None  # (N): largest adhesive force; None where no pair of the scene has any
    rolling: Array | None = None  # mu_r; None where no pair of the scene has any
    patch: PatchMarker | None = None  # of polytopes with friction; None: bodies that touch at a
    # point

    @property
    def stiffness(self) -> Array:
        """K (N/m): E L of both in series, eqs 5, 7 and 8."""
        return combine_in_series(
            *(e * size for e, size in zip(self.youngs_modulus, self.size, strict=True))
        )


class Torsion(NamedTuple):
    """The turning of one body on the other about the normal, as friction of a contact patch meets
    it, arrays [P].
    """

    arm: Array  # (m): mean distance at which friction acts from the contact point, see
    # ``narrow_phase.patch_moments``
    slip: Array  # (m): how far b has slid past a at that distance in this step, counter-clockwise
    # about the normal


class ContactKinematics(NamedTuple):
    """What a contact does in one step, arrays [P]."""

    overlap: Array  # (m): s_n now; separated where not positive
    approach: Array  # (m): by how much the bodies came nearer at the contact point in this step,
    # Delta s_n of eq. 4
    slip: Vector  # [P] x 3 (m): tangential way of b relative to a at the contact point in this step
    normal: Vector  # [P] x 3: unit, from a to b
    dt: Array  # (s)
    relative_rotation: Vector | None = None  # [P] x 3 (rad): turn of b relative to a in this step,
    # world axes; None unless both are polytopes
    rolling_rotation: Vector | None = None  # the same, of bodies of any kind; None where no pair of
    # the scene has rolling friction
    torsion: Torsion | None = None  # None: the bodies touch at a point, or without friction
    resolved: Array | float = 1.0  # 0 where the time step is too near the stability limit to tell
    # what happens within it


class Response(NamedTuple):
    """What a law answers."""

    normal_force: Array  # [P] (N): along the normal on b; positive pushes apart
    tangential_force: Vector | None  # [P] x 3 (N): tangential, on b; None of a law without friction
    history: Any  # as it was given, after this step
    torque: Vector | None = None  # [P] x 3 (N m): torque on b beside that of the force at the
    # contact point, -twist on a
    reversal_increment: Array | None = None  # [P] (N): by how much push was larger where it turned
    # than before this step, else 0; None: unknown


class ContactLaw(Protocol):
    """The methods of a law. ``pair`` is what its own method ``pair`` made, ``history`` what
    ``start`` began with: nobody else looks inside. All but those that speak of steps and stiffness,
    which take numpy in double precision, are traced.
    """

    def pair_parameters(self, couple: MaterialPair) -> Any:
        """Constants of pairs of bodies: a pytree of arrays whose last axis is that of the couple's."""

    def init_history(self, pair: Any, like: Array) -> Any:
        """The history of contacts at first touch: a pytree of arrays [.., P] of zeros; like: [P],
        of the right dtype.
        """

    def force(self, pair: Any, history: Any, contact: ContactKinematics) -> Response:
        """Force in this step, and the history after it. Called once a step."""

    def energy(self, pair: Any, history: Any, overlap: Array) -> Array:
        """What each contact would give back, [P] (J)."""

    def interaction_range(self, pair: Any) -> Array | None:
        """Gap (m), [P] or [1], across which the law still acts; None: it ends where bodies part."""

    def critical_steps(self, pair: Any, mass: Real) -> dict[str, Real]:
        """The largest time steps (s) that resolve contacts of effective masses (kg), by what limits
        them, in words.
        """

    def stable_step(self, pair: Any, mass: Real) -> Real:
        """Time steps (s), like mass, above which a contact of that effective mass (kg) gains
        energy: 2 / omega of its stiffest normal branch.
        """

    def loading_step(self, pair: Any, mass: Real) -> Real:
        """2 / omega (s), like mass, of the branch on which impacts load: the error of their energy
        goes with its square. A law may leave it out: it is then that of ``stable_step``.
        """
        return self.stable_step(pair, mass)

    def tangential_stiffness(self, pair: Any) -> Real | None:
        """K_t (N/m) where it is largest; None: no friction. A law may leave it out."""
        return None
