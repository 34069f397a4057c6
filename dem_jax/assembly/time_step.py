"""The time step: as requested, or from the smallest critical step of all contacts that can occur.

No step may exceed 2 / sqrt(lambda), with lambda the largest eigenvalue of stiffness over mass at a
contact. Normal and tangential springs act at a contact point off the centre of mass, which moves
less than the whole mass (2/7 of it for a sphere's tangential spring). Contacts of one body add up:
with contacts on both sides lambda is twice that of one contact, as in a row of pieces of which
every other one moves against its neighbours. (In a pile the factor is the number of contacts;
Otsubo, O'Sullivan and Shire, Computers and Geotechnics 86 (2017) 60-73.)

A step is stable if no impact gains more than 1 % of its energy (``LARGEST_GAIN``). The stable step
is a share of the limits of a single contact, for its normal and its tangential spring separately
(``STEP_SHARES``), and never beyond the linear limit above. A longer step is refused unless the
scene allows it (run.allow_unstable_step); a warning then states the possible gain of an impact:
about (dt / dt_l)^2, with dt_l = 2 / omega of the loading branch, and near the linear limit, at a
share q of it, this over sqrt(1 - q^2).

Measured at epsilon = 1, where no loss hides a gain, over the moment of first touch within a step,
direction and orientation; q is relative to the limit of a single contact.

- Walton and Braun, central impact without friction: at most 0.24, 0.58, 1.1, 2.7 and 4.2 % at q =
  0.2, 0.25, 0.28, 0.35 and 0.4; Hertz 0.41, 0.80 and 1.7 % at 0.2, 0.25 and 0.3; a linear spring,
  without kink corrections, 0.24, 0.87 and 2.3 % at 0.05, 0.1 and 0.15.
- A sphere that sticks (mu = 10), q of the tangential limit: 0.14, 0.47, 1.6 and 3.0 % at 0.1, 0.15,
  0.2 and 0.25.
- A marshmallow that sticks: 0 and 1.0 % at 0.1 and 0.15; a plate of 30 x 20 x 5 mm 0.04, 0.3 and
  1.5 % at 0.1, 0.15, 0.2.
- Without friction that plate, a marshmallow and a cube gain at most 0.1 % at 0.3.
- At the stable step itself, 64 impacts each that stick (mu = 10), Walton and Braun: a hull of an
  almond's size 0.30 %, needles of 100 x 4 x 4 mm and cylinders of 60 x 6 mm 0.35 and 0.30 %, a
  tetrahedron 0.11 %, a flat and a long hull nothing. Hertz with friction (sphere, marshmallow,
  almond, rod of 60 x 6 x 6 mm, flat hull) nothing; a linear spring 0.38 % (sphere), 0.06 %
  (needle).

At epsilon = 0.9 and less an impact loses at least 19 % of the energy along the normal, and gains
none at q = 0.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.piece_arrays import find_distinct_shapes
from dem_jax.broad_phase import overflow_recovery
from dem_jax.contact_laws import ContactLaw, MaterialPair, walton_braun_accuracy
from dem_jax.contact_laws.cohesion import Cohesive
from dem_jax.contact_laws.hertz_mindlin import HertzMindlin
from dem_jax.contact_laws.material_pairs import make_material_pair
from dem_jax.contact_laws.rolling_friction import Rolling
from dem_jax.contact_laws.springs import combine_in_series, quarter_period
from dem_jax.contact_laws.walton_braun import WaltonBraun
from dem_jax.errors import SceneError
from dem_jax.math import pose
from dem_jax.scene import Scene
from dem_jax.scene.unusual_numbers import most_unusual_key
from dem_jax.shapes import Shape, list_parts
from dem_jax.types import Materials, Pieces, as_array

LARGEST_GAIN = 0.01  # largest relative gain of energy of an impact at a stable step
NEARLY_ELASTIC = 0.9  # restitution up to which an impact loses more energy than a step can add
AUTOMATIC_SHARE = (
    0.3  # of the linear limit: no step is longer without run.time_step and run.accuracy
)
DRAFT_FACTOR = 2.0  # of the default step, with run.accuracy = "draft"
RESOLVED_SHARE = 0.5  # of the linear limit, up to which laws apply their kink corrections; beyond,
# these would excite oscillations


class StepShares(NamedTuple):
    """Shares of the linear limits of a single contact up to which no impact gains more than
    ``LARGEST_GAIN`` of its energy.
    """

    normal: float  # of the normal spring, for a restitution above NEARLY_ELASTIC
    damped: float  # of the normal spring, for a restitution up to NEARLY_ELASTIC
    tangential: float


STEP_SHARES: dict[type, StepShares] = {
    WaltonBraun: StepShares(0.25, 0.4, 0.14),
    HertzMindlin: StepShares(0.25, 0.4, 0.14),
}
DEFAULT_STEP_SHARES = StepShares(0.1, 0.4, 0.14)  # for a linear spring and for user-defined laws


@dataclass(frozen=True)
class TimeStep:
    """The time step and the limits from which it was chosen."""

    dt: float  # s
    substeps: int  # steps per sample
    parts: int  # parts of equally many steps per sample, each within the largest number of steps
    # between rebuilds
    critical: float  # s: the smallest critical step, from the law or from the requested accuracy
    stable: float  # s: up to here no impact gains more than LARGEST_GAIN of its energy
    linear_limit: float  # s: beyond, contacts are unstable; no step may exceed it
    limit: str  # description of the limit that sets the critical step
    resolved: float  # 1, or 0 above RESOLVED_SHARE of the linear limit
    error: float  # approximate bound of the relative energy error of an impact
    warning: str | None  # for an unstable step that the scene allows

    def __str__(self) -> str:
        return (
            f"dt = {self.dt:.4g} s ({self.substeps} steps per sample), dt/dt_crit = {self.dt / self.critical:.3g}; "
            f"dt_crit = {self.critical:.4g} s from {self.limit}; stable below {self.stable:.4g} s"
        )


@dataclass(frozen=True)
class PossibleContact:
    """A kind of contact that can occur in a scene, or P kinds at once, with arrays [P] instead of
    numbers.
    """

    mass: Any  # (kg): effective mass of a central contact
    normal_mass_ratio: Any  # smallest ratio of the effective mass of an off-centre contact to it
    tangential_mass_ratio: Any  # the same ratio for a tangential contact
    restitution: Any
    pair: Any  # the law's constants, each [1]
    description: str


def largest_stiffness(law: ContactLaw, contacts: Sequence[PossibleContact]) -> float:
    """Stiffness (N/m) of the stiffest contact."""
    return max(
        float(np.max(4 * c.mass / np.asarray(law.stable_step(c.pair, c.mass)) ** 2))
        for c in contacts
    )


def choose_step(
    scene: Scene,
    law: ContactLaw,
    contacts: list[PossibleContact],
    together: int = 2,
    added: float = 0.0,
) -> TimeStep:
    """Choose the time step: as requested, or the smallest critical step of all contacts that can
    occur.

    Args:
        scene: the scene.
        law: its contact law.
        contacts: all kinds of contact that can occur.
        together: number of contacts that can act on a body from opposite sides.
        added: contribution (1/s2) of load cell and drives to the largest eigenvalue.

    Raises:
        SceneError: no step is possible, or the requested step is not allowed.
    """
    sample = scene.run.sample_interval
    linear = min(float(np.min(_linear_limit(law, c))) for c in contacts) / np.sqrt(together)
    swings = np.sqrt(1 + 0.25 * added * linear**2)
    linear = linear / swings
    stable = min(linear, min(float(np.min(_stable_step(law, c))) for c in contacts) / swings)
    accuracy = scene.run.accuracy
    if accuracy is None:
        critical, limit = _default_step(law, contacts)
    elif accuracy.draft:
        critical, limit = _draft_step(law, contacts, linear)
    else:
        critical, limit = _accurate_step(scene, law, contacts, linear)
    most = min(AUTOMATIC_SHARE * linear, stable) if accuracy is None else stable
    if scene.run.time_step == "auto" and critical > most:
        critical, limit = most, f"{most / linear:.2g} of the linear stability limit"
    wanted = critical if scene.run.time_step == "auto" else scene.run.time_step
    if not (0 < critical < np.inf and 0 < stable):
        raise SceneError(
            f"{scene.name}: no time step for {limit}; furthest from what is usual is {most_unusual_key(scene)}"
        )
    substeps = max(1, int(np.ceil(sample / wanted - 1e-9)))
    parts = -(-substeps // block_steps(scene))
    substeps = parts * -(-substeps // parts)
    dt = sample / substeps
    _check_step(scene, wanted, stable, linear)
    loading = min(
        float(np.min(getattr(law, "loading_step", law.stable_step)(c.pair, c.mass)))
        for c in contacts
    )
    error = (dt / loading) ** 2 / np.sqrt(max(1 - (dt / linear) ** 2, 0.01))
    warning = (
        _describe_instability(dt, stable, error, critical) if dt > stable * (1 + 1e-9) else None
    )
    resolved = float(dt <= RESOLVED_SHARE * linear * (1 + 1e-9))
    return TimeStep(dt, substeps, parts, critical, stable, linear, limit, resolved, error, warning)


def _check_step(scene: Scene, wanted: float, stable: float, linear: float) -> None:
    """Raise SceneError for a step (s) beyond the linear limit (s), or beyond the stable step (s)
    unless the scene allows it.
    """
    if wanted > linear * (1 + 1e-9):
        raise SceneError(
            f"run.time_step = {wanted:g}: allowed: at most {linear:.4g} s, the linear stability limit"
        )
    if wanted > stable * (1 + 1e-9) and not scene.run.allow_unstable_step:
        raise SceneError(
            f"run.time_step = {wanted:g}: allowed: at most {stable:.4g} s, up to which no impact gains more than "
            f"{100 * LARGEST_GAIN:g} % of its energy; with run.allow_unstable_step = true up to {linear:.4g} s, the linear stability limit"
        )


def _describe_instability(dt: float, stable: float, error: float, critical: float) -> str:
    """Warning about a step (s) beyond the stable one (s). error: possible relative gain of energy;
    critical: (s).
    """
    return (
        f"run.time_step: dt = {dt:.3g} s is {dt / stable:.2g} times the stable step: an impact may gain up to about "
        f"{100 * error:.2g} % of its energy, more where many contacts act at once; the automatic step is "
        f"{min(critical, stable):.3g} s"
    )


def _stable_step(law: ContactLaw, c: PossibleContact) -> np.ndarray:
    """Longest step (s), of the shape of the law's constants, at which an impact gains no more than
    ``LARGEST_GAIN`` of its energy.
    """
    shares = STEP_SHARES.get(type(_unwrap_law(law)), DEFAULT_STEP_SHARES)
    share = np.where(np.asarray(c.restitution) > NEARLY_ELASTIC, shares.normal, shares.damped)
    normal, tangential = _linear_limits(law, c)
    return np.minimum(share * normal, shares.tangential * tangential)


def _unwrap_law(law: ContactLaw) -> ContactLaw:
    """The law without added cohesion and rolling friction."""
    while isinstance(law, Cohesive | Rolling):
        law = law.law
    return law


def _linear_limits(law: ContactLaw, c: PossibleContact) -> tuple[np.ndarray, np.ndarray]:
    """Linear stability limits (s) of the normal and the tangential spring of one contact, of the
    shape of the law's constants (inf without a tangential spring).
    """
    normal = np.asarray(law.stable_step(c.pair, c.mass * c.normal_mass_ratio))
    tangential = getattr(law, "tangential_stiffness", lambda _: None)(c.pair)
    if tangential is None:
        return normal, np.full_like(normal, np.inf, dtype=float)
    return normal, 2 * np.sqrt(
        c.mass * c.tangential_mass_ratio / np.maximum(tangential, np.finfo(float).tiny)
    )


def _linear_limit(law: ContactLaw, c: PossibleContact) -> np.ndarray:
    """The smaller of the two linear stability limits (s)."""
    return np.minimum(*_linear_limits(law, c))


def largest_interaction_range(law: ContactLaw, contacts: list[PossibleContact]) -> float:
    """The longest gap (m) across which the law acts."""
    reaches = [law.interaction_range(c.pair) for c in contacts]
    return max(0.0 if reach is None else float(np.max(reach)) for reach in reaches)


def _default_step(law: ContactLaw, contacts: list[PossibleContact]) -> tuple[float, str]:
    """The critical step (s) at the default resolution, and a description of the limit."""
    steps = [
        (float(np.min(s)), f"{what}, {c.description}")
        for c in contacts
        for what, s in law.critical_steps(c.pair, c.mass).items()
    ]
    return min(steps, key=lambda pair: pair[0])


def _draft_step(
    law: ContactLaw, contacts: list[PossibleContact], linear: float
) -> tuple[float, str]:
    """The critical step (s) of run.accuracy = "draft", and a description of the limit with the
    error of an impact. linear: limit (s).
    """
    step, limit = _default_step(law, contacts)
    step *= DRAFT_FACTOR
    if not isinstance(law, WaltonBraun):
        return step, f"run.accuracy = draft, {DRAFT_FACTOR:g} times that of {limit}"
    worst = {"restitution": 0.0, "peak_force": 0.0}
    for c in contacts:
        quarter = float(np.min(quarter_period(c.mass, c.pair.stiffness)))
        number = float(np.sqrt(c.normal_mass_ratio)) * quarter / step
        corrected = step <= RESOLVED_SHARE * linear
        found = _find_bound(c).error_bounds(number, float(np.min(c.pair.restitution)), corrected)
        worst = {key: max(value, found[key]) for key, value in worst.items()}
    errors = ", ".join(f"{key} {100 * value:.2g} %" for key, value in worst.items())
    return step, (
        f"run.accuracy = draft, {DRAFT_FACTOR:g} times that of {limit} (one impact errs by at most: {errors})"
    )


def _find_bound(c: PossibleContact) -> walton_braun_accuracy.ErrorBound:
    """The measured errors of a kind of contact."""
    is_central = c.normal_mass_ratio == 1
    return walton_braun_accuracy.SPHERE if is_central else walton_braun_accuracy.POLYTOPE


def _accurate_step(
    scene: Scene, law: ContactLaw, contacts: list[PossibleContact], stable: float
) -> tuple[float, str]:
    """The largest step (s) with the accuracy that the scene requests, and a description of the
    limit. stable: linear limit (s). Raises SceneError.
    """
    if not isinstance(law, WaltonBraun):
        raise SceneError(
            f"run.accuracy: known of the law of Walton and Braun only, not of {type(law).__name__}; give run.time_step"
        )
    assert scene.run.accuracy is not None
    asked = scene.run.accuracy.model_dump(exclude_none=True, exclude={"draft"})
    found = []
    for c in contacts:
        bound = _find_bound(c)
        for key, value in asked.items():
            finest, finer = (
                bound.finest[precision][key] for precision in (scene.run.precision, "f64")
            )
            if value < finest:
                single = finer < finest
                raise SceneError(
                    f"run.accuracy.{key} = {value:g}: allowed{' in single precision' * single}: at least {finest:g} for {c.description}"
                    + '; or run.precision = "f64"' * single
                )
        quarter = float(np.min(quarter_period(c.mass, c.pair.stiffness)))
        either = []
        for corrected, most in ((False, np.inf), (True, RESOLVED_SHARE * stable)):
            number, first = bound.required_steps(
                asked, float(np.min(c.pair.restitution)), corrected
            )
            why = (
                f"run.accuracy.{first} = {asked[first]:g}"
                if first
                else "the coarsest step whose error is known (run.accuracy)"
            )
            step = min(float(np.sqrt(c.normal_mass_ratio) * quarter / number), most)
            either.append(
                (
                    step,
                    f"{why}: {quarter / step:.3g} steps per loading quarter period, {c.description}",
                )
            )
        found.append(max(either))
    return min(found)


def block_steps(scene: Scene) -> int:
    """Largest number of steps between rebuilds, rounded to few distinct numbers, as it is part of
    the compiled program.
    """
    return overflow_recovery.round_to_multiple(8, scene.run.max_rebuild_interval)


def list_possible_contacts(
    law: ContactLaw,
    materials: Materials,
    made: Sequence[Shape],
    pieces: Pieces,
    reuse: AssemblyCache | None = None,
) -> list[PossibleContact]:
    """Contacts of each kind of piece with each wall material, and with the other kinds that limit
    the step most, for central and off-centre contacts. All pairs would be too many if each piece is
    a kind of its own.
    """
    of_material = (np.asarray(pieces.material).tobytes(),)
    kinds = (reuse or AssemblyCache()).get(
        "kinds", lambda: _list_piece_kinds(made, pieces), of_material, tuple(made)
    )
    first, number, least, swing = kinds
    out = []
    for i, p in enumerate(first):
        for wall in np.flatnonzero(materials.is_wall):
            couple = _build_material_pair(materials, pieces, p, None, wall)
            factors, words = (
                (float(least[i]), float(swing[i])),
                _describe_contact(made[p], "a wall"),
            )
            out.append(
                PossibleContact(
                    float(pieces.mass[p]),
                    *factors,
                    _single_value(couple.restitution),
                    law.pair_parameters(couple),
                    words,
                )
            )
        others = first[i if number[i] > 1 else i + 1 :]
        if not len(others):
            continue
        couple = _build_material_pair(materials, pieces, np.full(len(others), p), others, None)
        pairs, rest = law.pair_parameters(couple), slice(len(first) - len(others), None)
        worst, least_swing = np.minimum(least[i], least[rest]), np.minimum(swing[i], swing[rest])
        critical = np.min(
            [
                np.broadcast_to(s, couple.mass.shape)
                for s in law.critical_steps(pairs, couple.mass).values()
            ],
            axis=0,
        )
        every = PossibleContact(couple.mass, worst, least_swing, couple.restitution, pairs, "")
        linear, stable = (
            np.broadcast_to(f(law, every), couple.mass.shape) for f in (_linear_limit, _stable_step)
        )
        for j in sorted({int(np.argmin(each)) for each in (critical, linear, stable)}):
            own = _build_material_pair(materials, pieces, p, others[j], None)
            words = _describe_contact(made[p], f"another ({made[others[j]].name})")
            factors = float(worst[j]), float(least_swing[j])
            out.append(
                PossibleContact(
                    float(couple.mass[j]),
                    *factors,
                    _single_value(own.restitution),
                    law.pair_parameters(own),
                    words,
                )
            )
    return out


def _list_piece_kinds(
    made: Sequence[Shape], pieces: Pieces
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """For each kind of piece, by shape and material: its first piece, the number of pieces, and the
    smallest effective masses of an off-centre and of a tangential contact, relative to the mass of
    a piece.
    """
    _, index = find_distinct_shapes(made)
    _, first, number = np.unique(
        np.stack([index, pieces.material]), axis=1, return_index=True, return_counts=True
    )
    order = np.argsort(first)
    first, number = first[order], number[order]
    of_shape = {
        id(made[i]): (_normal_mass_ratio(made[i]), _tangential_mass_ratio(made[i])) for i in first
    }
    least, swing = np.transpose([of_shape[id(made[i])] for i in first])
    return first, number, least, swing


def _single_value(values: ArrayLike) -> float:
    """The value of a single material pair."""
    return float(np.ravel(values)[0])


def _build_material_pair(
    materials: Materials, pieces: Pieces, b: ArrayLike, a: ArrayLike | None, wall: np.integer | None
) -> MaterialPair:
    """Material pair of pieces b and a, or of b and a wall of a given material."""
    b = np.atleast_1d(b)
    own = b if a is None else np.atleast_1d(a)
    material = pieces.material[own] if wall is None else as_array(np.full(len(b), wall))
    curvature = pieces.curvature[own] if wall is None else as_array(np.zeros(len(b)))
    mass = combine_in_series(pieces.mass[own], pieces.mass[b]) if wall is None else pieces.mass[b]
    both = lambda rows: (rows[own], rows[b])
    return make_material_pair(
        materials,
        (material, pieces.material[b]),
        both(pieces.size),
        (curvature, pieces.curvature[b]),
        mass,
    )


def _describe_contact(shape: Shape, other: str) -> str:
    return f"{shape.name} of {shape.volume * 1e9:.4g} mm3 against {other}"


def _normal_mass_ratio(shape: Shape) -> float:
    """Smallest effective mass of a frictionless contact at a vertex or on a ball, in any direction,
    relative to the whole mass.
    """
    if shape.radius > 0:
        return 1.0
    points = [
        part.centre + (part.shape.vertices if part.shape.radius == 0 else 0)
        for part in list_parts(shape)
    ]
    vertices = np.concatenate([np.reshape(p, (-1, 3)) for p in points]) @ pose.quaternion_to_matrix(
        shape.principal
    )
    arms = np.cross(vertices[:, None], np.eye(3)[None])  # [V, 3, 3]: r x n for n along each axis
    compliance = np.einsum("vik,vjk->vij", arms / shape.gyration, arms)
    return float(1 / (1 + np.linalg.eigvalsh(compliance).max()))


def _tangential_mass_ratio(shape: Shape) -> float:
    """Smallest effective mass of a tangential contact at a vertex or on a ball, relative to the
    whole mass.
    """
    if shape.radius == 0 and all(part.shape.radius == 0 for part in list_parts(shape)):
        return _normal_mass_ratio(shape)  # this covers all directions
    balls = [
        (part.centre, part.shape.radius) for part in list_parts(shape) if part.shape.radius > 0
    ]
    arm = max(float(np.linalg.norm(centre)) + radius for centre, radius in balls)
    return min(_normal_mass_ratio(shape), float(1 / (1 + arm**2 / np.min(shape.gyration))))
