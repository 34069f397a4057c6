"""Contact laws: the force between two bodies from their materials and relative motion.

A law is a frozen pytree (``types.pytree``) of its parameters with the methods of ``ContactLaw``.
There is no base class, and the step has no list of names; any value with these methods is a law.
One file for each law: ``walton_braun`` (the paper's, the default), ``linear_dashpot``,
``hertz_mindlin``, ``densifying`` (foams), ``elastic_plastic`` (restitution that decreases with
speed). ``cohesion`` adds cohesion to any of them and ``rolling_friction`` rolling friction; they
share the tangential spring of ``friction`` and the damping of ``dashpot``. ``LAWS`` of
``dem_jax.assembly.contact_law`` lists them by the names that a scene uses;
``dem_jax.scene.sections.contact`` has their keys.
"""

from typing import Any, NamedTuple, Protocol

import jax

from dem_jax.contact_laws.springs import Real
from dem_jax.math.vector import Vector
from dem_jax.types import MaterialPair as MaterialPair

Array = jax.Array


class Torsion(NamedTuple):
    """Rotation of one body relative to the other about the normal, as friction of a contact patch
    resists it, arrays [P].
    """

    arm: Array  # (m): mean distance at which friction acts from the contact point, see
    # ``narrow_phase.patch_moments``
    slip: Array  # (m): sliding distance of b past a at that arm in this step, counter-clockwise
    # about the normal


class ContactKinematics(NamedTuple):
    """Relative motion of two bodies in contact in one step, arrays [P]."""

    overlap: Array  # (m): s_n now; separated where not positive
    approach: Array  # (m): approach of the bodies at the contact point in this step, Delta s_n of
    # eq. 4
    slip: Vector  # [P] x 3 (m): tangential displacement of b relative to a at the contact point in
    # this step
    normal: Vector  # [P] x 3: unit, from a to b
    dt: Array  # (s)
    relative_rotation: Vector | None = None  # [P] x 3 (rad): rotation of b relative to a in this
    # step, world axes; None unless both are polytopes
    rolling_rotation: Vector | None = None  # the same for bodies of any kind; None where no pair of
    # the scene has rolling friction
    torsion: Torsion | None = None  # None: the bodies touch at a point, or without friction
    resolved: Array | float = 1.0  # 0 where the time step is too near the stability limit for
    # corrections within it


class Response(NamedTuple):
    """Result of a law in one step."""

    normal_force: Array  # [P] (N): along the normal on b; positive pushes apart
    tangential_force: Vector | None  # [P] x 3 (N): tangential, on b; None of a law without friction
    history: Any  # the history after this step
    torque: Vector | None = None  # [P] x 3 (N m): torque on b in addition to that of the force at
    # the contact point; its negative acts on a
    reversal_increment: Array | None = None  # [P] (N): excess of the normal force at a reversal
    # within this step over that before the step, else 0; None: unknown


class ContactLaw(Protocol):
    """The methods of a law.

    ``pair`` is the result of its ``pair_parameters``, ``history`` begins as the result of its
    ``init_history``; both are opaque to the caller. All methods are traced, except those about
    steps and stiffness, which take numpy arrays in double precision.
    """

    def pair_parameters(self, couple: MaterialPair) -> Any:
        """Constants of pairs of bodies: a pytree of arrays with the last axis of the material
        pair.
        """

    def init_history(self, pair: Any, like: Array) -> Any:
        """History of contacts at first touch: a pytree of arrays [.., P] of zeros; like: [P], of
        the right dtype.
        """

    def force(self, pair: Any, history: Any, contact: ContactKinematics) -> Response:
        """Force in this step, and the history after it. Called once per step."""

    def energy(self, pair: Any, history: Any, overlap: Array) -> Array:
        """Recoverable energy of each contact, [P] (J)."""

    def interaction_range(self, pair: Any) -> Array | None:
        """Gap (m), [P] or [1], across which the law still acts; None if it ends at separation."""

    def critical_steps(self, pair: Any, mass: Real) -> dict[str, Real]:
        """Largest time steps (s) that resolve contacts of effective masses (kg), by a description
        of the limit.
        """

    def stable_step(self, pair: Any, mass: Real) -> Real:
        """Time steps (s), of the shape of mass, above which a contact of that effective mass (kg)
        gains energy: 2 / omega of its stiffest normal branch.
        """

    def loading_step(self, pair: Any, mass: Real) -> Real:
        """2 / omega (s), of the shape of mass, of the loading branch: the energy error of impacts
        is proportional to its square. Optional; the default is ``stable_step``.
        """
        return self.stable_step(pair, mass)

    def tangential_stiffness(self, pair: Any) -> Real | None:
        """Largest K_t (N/m); None without friction. Optional."""
        return None
