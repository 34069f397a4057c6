"""The time step: as asked for, or from the smallest critical step over all contacts that can be."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.build.pieces import distinct_shapes
from dem_jax.contact.law import ContactLaw, Couple, walton_braun_accuracy
from dem_jax.contact.law.springs import quarter_period, series
from dem_jax.contact.law.walton_braun import WaltonBraun
from dem_jax.contact.materials import couple
from dem_jax.errors import SceneError
from dem_jax.maths import pose
from dem_jax.pairs import guard
from dem_jax.scene import Scene
from dem_jax.scene.extreme import furthest
from dem_jax.shapes import Shape, parts_of
from dem_jax.types import Materials, Pieces, host


@dataclass(frozen=True)
class TimeStep:
    """The time step and what limits it."""

    dt: float  # s
    substeps: int  # steps per sample
    parts: int  # of equally many steps that a sample is cut into, none of more steps than a rebuild is good for
    critical: float  # s: the smallest critical step, by the law's critical steps or by the accuracy asked for
    stable: float  # s: linear stability limit, which no step may exceed
    limit: str  # what sets the critical step, in words

    def __str__(self) -> str:
        return (
            f"dt = {self.dt:.4g} s ({self.substeps} steps per sample), dt/dt_crit = {self.dt / self.critical:.3g}; "
            f"dt_crit = {self.critical:.4g} s from {self.limit}; stable below {self.stable:.4g} s"
        )


@dataclass(frozen=True)
class PossibleContact:
    """A kind of contact that a scene can have."""

    mass: float  # (kg): effective mass of a central contact
    eccentricity: float  # smallest ratio of the effective mass of an off-centre contact to it
    pair: Any  # the law's constants, each [1]
    words: str


def choose_step(scene: Scene, law: ContactLaw, contacts: list[PossibleContact]) -> TimeStep:
    """The time step: as asked for, or from the smallest critical step over all contacts that can be. Raises SceneError."""
    sample = scene.run.sample
    critical, limit = (_accurate_step if scene.run.accuracy else _default_step)(scene, law, contacts)
    stable = min(float(np.min(law.stable_step(c.pair, c.mass * c.eccentricity))) for c in contacts)
    wanted = critical if scene.run.step == "auto" else scene.run.step
    if not (0 < critical < np.inf and 0 < stable):
        raise SceneError(f"{scene.name}: no time step for {limit}; furthest from what is usual is {furthest(scene)}")
    if wanted > stable:
        raise SceneError(f"run.step = {wanted:g}: allowed: at most {stable:.4g} s, the stability limit of {limit}")
    substeps = max(1, int(np.ceil(sample / wanted - 1e-9)))
    parts = -(-substeps // block_steps(scene))
    substeps = parts * -(-substeps // parts)
    return TimeStep(sample / substeps, substeps, parts, critical, stable, limit)


def longest_reach(law: ContactLaw, contacts: list[PossibleContact]) -> float:
    """The longest gap (m) across which the law acts."""
    reaches = [law.reach(c.pair) for c in contacts]
    return max(0.0 if reach is None else float(np.max(reach)) for reach in reaches)


def _default_step(_: Scene, law: ContactLaw, contacts: list[PossibleContact]) -> tuple[float, str]:
    """The critical step (s) of the default resolution, and what sets it."""
    steps = [(float(np.min(s)), f"{what}, {c.words}") for c in contacts for what, s in law.critical_steps(c.pair, c.mass).items()]
    return min(steps, key=lambda pair: pair[0])


def _accurate_step(scene: Scene, law: ContactLaw, contacts: list[PossibleContact]) -> tuple[float, str]:
    """The largest step (s) that keeps the accuracy that the scene asks for, and what sets it. Raises SceneError."""
    if not isinstance(law, WaltonBraun):
        raise SceneError(f"run.accuracy: known of the law of Walton and Braun only, not of {type(law).__name__}; give run.step")
    assert scene.run.accuracy is not None
    asked = scene.run.accuracy.model_dump(exclude_none=True)
    found = []
    for c in contacts:
        bound = walton_braun_accuracy.SPHERE if c.eccentricity == 1 else walton_braun_accuracy.POLYTOPE
        for key, value in asked.items():
            finest = bound.single[key]
            if scene.run.precision == "f32" and value < finest:
                raise SceneError(
                    f"run.accuracy.{key} = {value:g}: allowed in single precision: at least {finest:g} for {c.words}; "
                    f'or run.precision = "f64"'
                )
        number, first = bound.steps(asked, float(np.min(c.pair.restitution)))
        quarter = float(np.min(quarter_period(c.mass, c.pair.stiffness)))
        why = f"run.accuracy.{first} = {asked[first]:g}" if first else "the coarsest step whose error is known (run.accuracy)"
        step = np.sqrt(c.eccentricity) * quarter / number
        found.append((float(step), f"{why}: {quarter / step:.3g} steps per loading quarter period, {c.words}"))
    return min(found)


def block_steps(scene: Scene) -> int:
    """Most steps between rebuilds: few distinct numbers, as they are part of what is compiled."""
    return guard.round_to(8, scene.run.rebuild_steps)


def possible_contacts(law: ContactLaw, materials: Materials, made: Sequence[Shape], pieces: Pieces) -> list[PossibleContact]:
    """Each kind of piece against each material of walls, and against the kinds that move quickest on its contact, about the
    centre of mass and off it: of as many kinds as pieces, all pairs would be too many to list."""
    _, index = distinct_shapes(made)
    _, first, number = np.unique(np.stack([index, pieces.material]), axis=1, return_index=True, return_counts=True)
    order = np.argsort(first)
    first, number = first[order], number[order]
    of_shape = {id(made[i]): _eccentricity(made[i]) for i in first}
    least = np.array([of_shape[id(made[i])] for i in first])
    out = []
    for i, p in enumerate(first):
        for wall in np.flatnonzero(materials.is_wall):
            pair = law.pair(_couple(materials, pieces, p, None, wall))
            out.append(PossibleContact(float(pieces.mass[p]), float(least[i]), pair, _words(made[p], "a wall")))
        others = first[i if number[i] > 1 else i + 1 :]
        if not len(others):
            continue
        couple = _couple(materials, pieces, np.full(len(others), p), others, None)
        pairs, worst = law.pair(couple), np.minimum(least[i], least[len(first) - len(others) :])
        critical = np.min([np.broadcast_to(s, couple.mass.shape) for s in law.critical_steps(pairs, couple.mass).values()], axis=0)
        stable = np.broadcast_to(law.stable_step(pairs, couple.mass * worst), couple.mass.shape)
        for j in sorted({int(np.argmin(critical)), int(np.argmin(stable))}):
            pair = law.pair(_couple(materials, pieces, p, others[j], None))
            words = _words(made[p], f"another ({made[others[j]].name})")
            out.append(PossibleContact(float(couple.mass[j]), float(worst[j]), pair, words))
    return out


def _couple(materials: Materials, pieces: Pieces, b: ArrayLike, a: ArrayLike | None, wall: np.integer | None) -> Couple:
    """The couple of pieces b and a, or of b and a wall of a material."""
    b = np.atleast_1d(b)
    own = b if a is None else np.atleast_1d(a)
    material = pieces.material[own] if wall is None else host(np.full(len(b), wall))
    curvature = pieces.curvature[own] if wall is None else host(np.zeros(len(b)))
    mass = series(pieces.mass[own], pieces.mass[b]) if wall is None else pieces.mass[b]
    both = lambda rows: (rows[own], rows[b])  # noqa: E731
    return couple(materials, (material, pieces.material[b]), both(pieces.size), (curvature, pieces.curvature[b]), mass)


def _words(shape: Shape, other: str) -> str:
    return f"{shape.name} of {shape.volume * 1e9:.4g} mm3 against {other}"


def _eccentricity(shape: Shape) -> float:
    """Smallest effective mass of a frictionless contact at a vertex or on a ball, relative to the whole mass, in any
    direction."""
    if shape.radius > 0:
        return 1.0
    points = [part.centre + (part.shape.vertices if part.shape.radius == 0 else 0) for part in parts_of(shape)]
    vertices = np.concatenate([np.reshape(p, (-1, 3)) for p in points]) @ pose.matrix_of_quaternion(shape.principal)
    arms = np.cross(vertices[:, None], np.eye(3)[None])  # [V, 3, 3]: r x n for n along each axis
    compliance = np.einsum("vik,vjk->vij", arms / shape.gyration, arms)
    return float(1 / (1 + np.linalg.eigvalsh(compliance).max()))
