"""A system some of whose arrays follow from values that JAX differentiates, in the place of numbers of its scene.

The host builds the system of the scene; here the arrays that the values decide are computed again, by the same functions. What
decides the program, its sizes and its time step stays that of the scene.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.build.drive import drive_of
from dem_jax.build.law import law_of, materials_of
from dem_jax.build.load_cell import load_cell_of
from dem_jax.build.pieces import piece_arrays
from dem_jax.build.start import Start, listed, motion_of_start, placed
from dem_jax.build.system import Built, build
from dem_jax.build.typed import typed
from dem_jax.build.walls import walls_of
from dem_jax.contact import motion
from dem_jax.errors import SceneError
from dem_jax.pairs import neighbours
from dem_jax.scene import Drive, NamedMaterial, Scene, Section, buckets
from dem_jax.scene.numbers import array, is_zero
from dem_jax.scene.words import choices, short
from dem_jax.types import State, System, Walls

Values = Mapping[str, Any]  # key of a scene -> a number, an array, or what stands for one while JAX traces

OF_MATERIAL = tuple(key for key in NamedMaterial.model_fields if key not in ("youngs_modulus_range", "wall_surface"))
OF_ALL = ("wall_youngs_modulus", "wall_poisson_ratio", "softening", "separation", "tangential_stiffness")
DAMPING = ("unloading_damping", "rest_damping")
FLAPS = ("opening_angle_deg", "opening_start", "opening_time", "open_dwell", "closing_time")
DRIVE = tuple(Drive.model_fields)
HINGE = ("swing_deg", "start", "opening", "dwell", "closing", "period")
VIBRATION = ("stroke", "frequency", "shake_start", "shake_end", "shake_ramp")
KEYS = {  # of each section those that only arrays depend on
    "material": (*OF_MATERIAL, *OF_ALL, *DAMPING),
    "pair": ("restitution", "friction", "rolling_friction", "pull_off"),
    "contact.cohesion": ("stiffness",),
    "run": ("gravity",),
    "drop": ("height",),
    "feed_bucket": FLAPS,
    "feed_bucket.drive": DRIVE,
    "weigh_bucket": FLAPS,
    "weigh_bucket.drive": DRIVE,
    "weigh_bucket.load_cell": ("mass", "stiffness", "natural_frequency", "rated_load", "damping_ratio"),
    "feeder": ("stroke", "frequency", "start", "duration", "ramp"),
    "motion": (*HINGE, *VIBRATION, "angles_deg", "ways"),
    "piece": ("position", "orientation", "velocity", "angular_velocity"),
}
# With 0 in the scene nothing of these is in its program.
SWITCHES = {"swing_deg", "opening_angle_deg", "stroke", *DAMPING}


def keys_of(scene: Scene) -> dict[str, tuple[int, ...]]:
    """The keys of a scene whose values may be given, and the form of each one's value."""
    found = {}
    for path, section, keys in _sections(scene):
        for key in keys:
            value = getattr(section, key)
            if value is not None or keys in (OF_MATERIAL, KEYS["pair"]):
                found[f"{path}.{key}"] = () if value is None else np.shape(value)
    return found


def _sections(scene: Scene) -> Iterator[tuple[str, Section, tuple[str, ...]]]:
    """Path of each section that has such keys, the section, and the keys."""
    yield "material", scene.material, KEYS["material"]
    for name, row in scene.material.named.items():
        yield f"material.{name}", row, OF_MATERIAL
    for path in ("pair", "motion", "piece"):
        for n, row in enumerate(getattr(scene, path)):
            yield f"{path}.{n}", row, KEYS[path]
    for n, motion_row in enumerate(scene.motion):
        if motion_row.drive:
            yield f"motion.{n}.drive", motion_row.drive, DRIVE
    yield "contact.cohesion", scene.contact.cohesion, KEYS["contact.cohesion"]
    yield "run", scene.run, KEYS["run"]
    weigh, feed = scene.weigh_bucket, scene.feed_bucket
    if weigh and feed:
        yield "drop", scene.drop, KEYS["drop"]
    cell = weigh and weigh.load_cell
    drives = {"feed_bucket.drive": feed and feed.drive, "weigh_bucket.drive": weigh and weigh.drive}
    below = {"feed_bucket": feed, "weigh_bucket": weigh, **drives, "weigh_bucket.load_cell": cell, "feeder": scene.feeder}
    for path, one in below.items():
        if one:
            yield path, one, KEYS[path]


def with_values(scene: Scene, built: Built, values: Values, seed: int = 0) -> tuple[System, State]:
    """System and first state of a scene with values in the place of its numbers. built: of the scene, self-contained, and the seed.

    Raises SceneError for a key that is none of ``keys_of``, a value of another form, and one that the scene has switched off.
    """
    _check(scene, built, values)
    given = scene
    for key, value in values.items():
        given = _set(given, key.split("."), _plain(value))
    dtype, system = built.system.dt.dtype, built.system
    lift = given.drop.height - scene.drop.height
    walls = _walls(scene, given, system.walls, lift)
    height = typed(_up(lift, [name in ("fb", buckets.FEEDER) for name in system.blocks]), dtype)
    system = system.replace(
        pieces=typed(piece_arrays(given, built.goods), dtype),
        materials=typed(materials_of(given), dtype),
        law=typed(law_of(given), dtype),
        walls=walls,
        gravity=typed(array(given.run.gravity), dtype),
        block_low=system.block_low + height,
        block_high=system.block_high + height,
    )
    start = _start(scene, given, built, lift, seed)
    state = built.state.replace(motion=jax.tree.map(jnp.asarray, motion_of_start(system, start, built.frames)), scratch=None)
    form = jax.eval_shape(partial(neighbours.rebuild, system), state).scratch  # what is the same for all pairs may not be any more
    return system, state.replace(scratch=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), form))


def _check(scene: Scene, built: Built, values: Values) -> None:
    known, materials = keys_of(scene), built.system.materials
    absent = {"friction_piece": materials.friction, "friction_wall": materials.friction, "friction": materials.friction}
    absent |= {"pull_off": materials.pull_off, "rolling_friction": materials.rolling}
    for key, value in values.items():
        if key not in known:
            raise SceneError(f"{key}: decides the program or its sizes, or is no key of the scene; {choices(key, list(known))}")
        if (found := jnp.shape(jnp.asarray(value, float))) != known[key]:
            raise SceneError(f"{key}: a value of the form {found}; allowed: {known[key]}")
        last = key.split(".")[-1]
        off = last in absent and absent[last] is None
        off = off or (last == "angular_velocity" and not built.system.has_rotation)
        if off or (last in SWITCHES and all(map(is_zero, np.ravel(_get(scene, key.split(".")))))):
            raise SceneError(f"{key}: the scene has 0, and its program nothing of it; allowed: a scene in which it is not 0")


def check_numbers(scene: Scene, built: Built, values: Values, seed: int = 0) -> None:
    """Raise SceneError for values that a scene would not take, or with which the time step of this one is not stable.

    Values that stand for any number while JAX traces pass: the scene's own are in their place. Arguments and further errors as
    ``with_values``.
    """
    _check(scene, built, values)
    numbers = {key: np.asarray(value, float).tolist() for key, value in values.items() if not isinstance(value, jax.core.Tracer)}
    if not numbers:
        return
    checked = build(scene.replace(numbers), seed).step
    if built.step.dt > checked.stable * (1 + 1e-6) and not scene.run.allow_unstable_step:
        said = ", ".join(f"{key} = {short(value)}" for key, value in numbers.items())
        raise SceneError(
            f"{said}: the scene's time step, dt = {built.step.dt:.4g} s, is not stable with it; allowed: a scene whose own numbers "
            f"or run.step make it at most {checked.stable:.4g} s, or run.allow_unstable_step = true"
        )


def _plain(value: Any) -> Any:
    """As a scene has it: an array as nested tuples of values."""
    value = jnp.asarray(value, float)
    return value if value.ndim == 0 else tuple(_plain(row) for row in value)


def _get(section: Any, keys: list[str]) -> Any:
    for key in keys:
        section = section[int(key)] if isinstance(section, tuple) else getattr(section, key)
    return section


def _set(section: Any, keys: list[str], value: Any) -> Any:
    """The section with another value, which nothing checks: it may stand for any number."""
    if not keys:
        return value
    below = _set(_get(section, keys[:1]), keys[1:], value)
    if isinstance(section, tuple):
        return tuple(below if n == int(keys[0]) else row for n, row in enumerate(section))
    return section.model_copy(update={keys[0]: below})


def _walls(scene: Scene, given: Scene, walls: Walls, lift: Any) -> Walls:
    """The walls with the motions, the drives and the load cell as given; what hangs over the weigh bucket is lifted (m)."""
    dtype = walls.centre.dtype
    _, motions, *_ = walls_of(given.model_copy(update={"drop": scene.drop}))
    moved, pivot = motion.motions_of(motions, walls.groups)
    cell = load_cell_of(given, walls.groups, np.asarray(walls.group))
    centre = walls.centre
    if not is_zero(lift) and scene.feed_bucket:
        parts = buckets.parts(scene.feed_bucket, "fb", 0.0)
        hung, hinged = {group for group, *_ in parts.panels} | {buckets.FEEDER}, {row.group for row in parts.motions}
        higher, turned = (_up(lift, [name in names for name in walls.groups]) for names in (hung, hinged))
        centre, pivot = centre + typed(higher, dtype)[:, np.asarray(walls.group)], pivot + turned
    given_too = {"pivot": pivot, "motions": moved, "load_cell": cell, "drive": drive_of(motions, walls.groups)}
    return walls.replace(centre=centre, **typed(given_too, dtype))


def _start(scene: Scene, given: Scene, built: Built, lift: Any, seed: int) -> Start:
    """Where the pieces begin: as listed, or where the scene's do, as far above the weigh bucket as what they lie in."""
    if scene.piece:
        return listed(given.piece)
    start = placed(scene, built.shapes, built.numbers, built.regions, np.random.default_rng(seed))
    assert scene.portion is not None  # as a Scene makes sure
    if is_zero(lift):
        return start
    own = 0 if scene.portion.region_low is None else built.numbers[0]  # which have a place of their own
    position = start.position + _up(lift, [n >= own for n in range(len(start.position))]).T
    return Start(position, start.orientation, start.velocity, start.spin)


def _up(way: Any, which: list[bool]) -> Any:
    """A way (m) along z of those for which it holds, [3, n]."""
    return array([[0.0] * len(which), [0.0] * len(which), [way if one else 0.0 for one in which]])
