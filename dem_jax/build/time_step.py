"""The time step: as asked for, or from the smallest critical step over all contacts that can be."""

from dataclasses import dataclass

import numpy as np

from dem_jax.build.pieces import distinct_shapes
from dem_jax.contact import materials, springs
from dem_jax.errors import SceneError
from dem_jax.maths import pose
from dem_jax.pairs import guard
from dem_jax.scene import Scene
from dem_jax.types import Pieces


@dataclass(frozen=True)
class TimeStep:
    """The time step and what limits it."""

    dt: float  # s
    substeps: int  # steps per sample
    parts: int  # of equally many steps that a sample is cut into, none of more steps than a rebuild is good for
    critical: float  # s: the smallest critical step, by materials.steps or by the accuracy asked for
    stable: float  # s: linear stability limit, which no step may exceed
    limit: str  # what sets the critical step, in words

    def __str__(self):
        return (
            f"dt = {self.dt:.4g} s ({self.substeps} steps per sample), dt/dt_crit = {self.dt / self.critical:.3g}; "
            f"dt_crit = {self.critical:.4g} s from {self.limit}; stable below {self.stable:.4g} s"
        )


def choose_step(scene: Scene, made, pieces: Pieces) -> TimeStep:
    """The time step: as asked for, or from the smallest critical step over all contacts that can be. Raises SceneError."""
    epsilon, sample = scene.material.restitution, scene.run.sample
    contacts = _possible_contacts(made, pieces)
    critical, limit = (_accurate_step if scene.run.accuracy else _default_step)(scene, contacts)
    stable = float(
        materials.stable_step(contacts["mass"], contacts["stiffness"], epsilon, contacts["eccentricity"]).min()
    )
    wanted = critical if scene.run.step == "auto" else scene.run.step
    if wanted > stable:
        raise SceneError(f"run.step = {wanted:g}: allowed: at most {stable:.4g} s, the stability limit of {limit}")
    substeps = max(1, int(np.ceil(sample / wanted - 1e-9)))
    parts = -(-substeps // block_steps(scene))
    substeps = parts * -(-substeps // parts)
    return TimeStep(sample / substeps, substeps, parts, critical, stable, limit)


def _default_step(scene: Scene, contacts):
    """The critical step (s) of the default resolution, and what sets it."""
    load, unload = materials.steps(contacts["mass"], contacts["stiffness"], scene.material.restitution)
    both = np.minimum(load, unload)
    worst = int(np.argmin(both))
    branch = "loading" if load[worst] <= unload[worst] else "unloading"
    count = materials.LOAD_STEPS if branch == "loading" else materials.UNLOAD_STEPS
    return float(both[worst]), f"{count} steps per {branch} quarter period, {contacts['words'][worst]}"


def _accurate_step(scene: Scene, contacts):
    """The largest step (s) that keeps the accuracy that the scene asks for, and what sets it. Raises SceneError."""
    asked = scene.run.accuracy.model_dump(exclude_none=True)
    found = []
    for mass, spring, least, words in zip(*(contacts[k] for k in ("mass", "stiffness", "eccentricity", "words")), strict=True):
        bound = materials.SPHERE if least == 1 else materials.POLYTOPE
        for key, value in asked.items():
            finest = bound.single[key]
            if scene.run.precision == "f32" and value < finest:
                raise SceneError(
                    f"run.accuracy.{key} = {value:g}: allowed in single precision: at least {finest:g} for {words}; "
                    f'or run.precision = "f64"'
                )
        number, key = bound.steps(asked, scene.material.restitution)
        quarter = materials.quarter_period(mass, spring)
        why = f"run.accuracy.{key} = {asked[key]:g}" if key else "the coarsest step whose error is known (run.accuracy)"
        step = np.sqrt(least) * quarter / number
        found.append((float(step), f"{why}: {quarter / step:.3g} steps per loading quarter period, {words}"))
    return min(found)


def block_steps(scene: Scene) -> int:
    """Most steps between rebuilds: few distinct numbers, as they are part of what is compiled."""
    return guard.round_to(8, scene.run.rebuild_steps)


def _possible_contacts(made, pieces: Pieces):
    """Effective mass, K_nl and eccentricity of each kind of piece against a wall and against the kinds that move quickest
    on its contact, about the centre of mass and off it: of as many kinds as pieces, all pairs would be too many to list."""
    _, index = distinct_shapes(made)
    kinds = np.stack([index, pieces.mass, pieces.load_stiffness])  # one shape may be of several materials
    _, first, number = np.unique(kinds, axis=1, return_index=True, return_counts=True)
    least = np.array([_eccentricity(made[i]) for i in first])
    mass, k = pieces.mass[first], pieces.load_stiffness[first]
    rows = [(mass[i], pieces.wall_stiffness[first[i]], least[i], _words(made[p], "a wall")) for i, p in enumerate(first)]
    for i, p in enumerate(first):
        others = slice(i if number[i] > 1 else i + 1, None)
        m, s = springs.series(mass[i], mass[others]), springs.series(k[i], k[others])
        worst = np.minimum(least[i], least[others])
        for j in {int(np.argmin(m / s)), int(np.argmin(m * worst / s))} if len(m) else ():
            rows.append((m[j], s[j], worst[j], _words(made[p], f"another ({made[first[others][j]].name})")))
    m, s, e, words = zip(*rows, strict=True)
    return {"mass": np.array(m), "stiffness": np.array(s), "eccentricity": np.array(e), "words": words}


def _words(shape, other):
    return f"{shape.name} of {shape.volume * 1e9:.4g} mm3 against {other}"


def _eccentricity(shape):
    """Smallest effective mass of a frictionless contact at a vertex, relative to the whole mass, in any direction."""
    if shape.radius > 0:
        return 1.0
    vertices = shape.vertices @ pose.matrix_of_quaternion(shape.principal)
    arms = np.cross(vertices[:, None], np.eye(3)[None])  # [V, 3, 3]: r x n for n along each axis
    compliance = np.einsum("vik,vjk->vij", arms / shape.gyration, arms)
    return float(1 / (1 + np.linalg.eigvalsh(compliance).max()))
