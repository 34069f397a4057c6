"""From a scene to a system and its first state: shapes to tables, materials to stiffness, walls to panels, slots."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import shapes
from dem_jax.contact import forces, hulls, materials, springs
from dem_jax.maths import pose, rotation
from dem_jax.pairs import guard, neighbours, search
from dem_jax.scene import arrange, buckets
from dem_jax.shapes import meshes
from dem_jax.errors import SceneError
from dem_jax.scene import SHAPE_KEYS, PieceShape, Scene, Wall
from dem_jax.types import Law, Pieces, State, System, Walls, float_dtype

SKIN = 0.03  # of the width of the narrowest piece: see neighbours


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


@dataclass(frozen=True)
class Start:
    """Poses and velocities of the pieces at the start, in the user's body frames."""

    position: np.ndarray  # [N, 3] (m)
    orientation: np.ndarray  # [N, 4]
    velocity: np.ndarray  # [N, 3] (m/s)
    spin: np.ndarray  # [N, 3] (rad/s), world frame


@dataclass(frozen=True)
class Built:
    """A system with its first state, and what a host needs beside them."""

    system: System
    state: State
    step: TimeStep
    shapes: tuple  # Shape of each piece, scaled, body frame of the user
    frames: np.ndarray  # [N, 4]: principal frame to body frame, of each piece
    settling_steps: int  # steps before time zero
    samples: int  # to be run
    frame_every: int  # samples between stored frames; 0: none
    blocks: tuple  # names of the blocks
    regions: list  # boxes (low [3], high [3]) (m) in which pieces are scattered: of the feed bucket, of the feeder


def build(scene: Scene, seed: int = 0) -> Built:
    """Everything that a run of the scene needs. Raises SceneError."""
    dtype = float_dtype(scene.run.precision)
    made = _pieces_of(scene)
    panels, motions, joint, blocks, regions = _walls_of(scene)
    start = _placed(scene, made, regions, np.random.default_rng(seed))
    pieces = _piece_arrays(scene, made)
    step = choose_step(scene, made, pieces)
    settling = _settling_samples(scene) * step.substeps
    samples = max(1, round(scene.run.duration / scene.run.sample))
    frame_every = max(1, round(scene.run.frames / scene.run.sample)) if scene.run.frames else 0
    walls, plates, seams = _wall_arrays(panels, motions, joint, dtype)
    domain = _domain(scene, panels, start, made)
    polytopes = [i for i, m in enumerate(made) if m.radius == 0]
    table, shape_rows = _hull_table(made, plates, seams)
    system = System(
        pieces=_typed(
            dataclasses.replace(
                pieces,
                polytopes=np.array(polytopes, int),
                spheres=np.array([i for i in range(len(made)) if made[i].radius > 0], int),
            ),
            dtype,
        ),
        hulls=_typed(table, dtype) if table else None,
        shape=jnp.asarray(np.asarray(shape_rows, np.int32)),
        walls=walls,
        law=_typed(_law(scene), dtype),
        gravity=jnp.asarray(np.asarray(scene.run.gravity, dtype)),
        dt=jnp.asarray(np.asarray(step.dt, dtype)),
        substeps=jnp.asarray(np.asarray(step.substeps // step.parts, np.int32)),
        skin=jnp.asarray(np.asarray(SKIN * pieces.width.min(), dtype)),
        block_low=jnp.asarray(np.asarray(np.array([b.low for b in blocks]).reshape(-1, 3).T, dtype)),
        block_high=jnp.asarray(np.asarray(np.array([b.high for b in blocks]).reshape(-1, 3).T, dtype)),
        domain_low=jnp.asarray(np.asarray(domain[0], dtype)),
        domain_high=jnp.asarray(np.asarray(domain[1], dtype)),
        capacity=_capacity(made, polytopes, len(panels)),
        touching=min(12, len(made) - 1 + len(panels)),
        neighbours=scene.run.neighbours,
        row_capacity=_row_capacity(made, scene.run.neighbours),
        partition=_partition(made, scene.run.neighbours, domain),
        has_hulls=bool(polytopes),
        alike=_alike(made),
        escape_stops=scene.run.escape == "stop",
        has_friction=max(scene.material.friction_wall, scene.material.friction_piece) > 0,
        has_rotation=True,
        has_damping=scene.material.unloading_damping > 0,
        ledger=scene.run.energy,
        parts=step.parts,
        block_steps=_block_steps(scene),
        slot_block=0,
        runs=0,
    )
    only_spheres = not polytopes
    system = system.replace(has_rotation=not only_spheres or system.has_friction or bool(np.any(start.spin)))
    frames = np.array([m.principal for m in made])
    state = first_state(system, start, frames, -settling)
    names = tuple(b.name for b in blocks)
    return Built(system, state, step, tuple(made), frames, settling, samples, frame_every, names, regions)


def _alike(made):
    """System.alike."""
    of_kind = {"hulls": {id(m) for m in made if m.radius == 0}, "spheres": {id(m) for m in made if m.radius > 0}}
    return tuple(kind for kind, different in of_kind.items() if len(different) == 1)


def state_of_seed(scene: Scene, built: Built, seed: int) -> State:
    """The first state of the same scene with another seed, for the system that was built. Raises SceneError."""
    start = _placed(scene, built.shapes, built.regions, np.random.default_rng(seed))
    return started(built, start)


def started(built: Built, start: Start) -> State:
    """The first state with other poses and velocities."""
    return built.state.replace(**jax.tree.map(jnp.asarray, _motion(built.system, start, built.frames)))


def self_contained(scene: Scene) -> Scene:
    """The scene with the contents of the STL files that it names in their place. Raises SceneError."""
    rows = [_named(f"piece.{n}", _with_points, row, scene.folder) for n, row in enumerate(scene.piece)]
    portion = scene.portion and _named("portion", _with_points, scene.portion, scene.folder)
    walls = []
    for n, wall in enumerate(scene.wall):
        if wall.stl is None or wall.corners is not None:
            walls.append(wall)
            continue
        panels = [corners.tolist() for _, corners, _ in _named(f"wall.{n}", _panels_of, wall, scene.folder)]
        walls += [Wall(group=wall.group, thickness=wall.thickness, corners=_tuples(c)) for c in panels]
    return scene.model_copy(update={"piece": tuple(rows), "portion": portion, "wall": tuple(walls), "folder": "."})


def _with_points(row: PieceShape, folder):
    """The row of a hull with the corners of its STL; others as they are."""
    if row.shape != "hull" or row.stl is None or row.points is not None:
        return row
    corners = shapes.hull_of_stl(Path(folder) / row.stl, row.unit).vertices
    return row.model_copy(update={"stl": None, "unit": 1.0, "points": _tuples(corners.tolist())})


def _tuples(points):
    return tuple(tuple(p) for p in points)


def make_shape(row: PieceShape, folder=".") -> shapes.Shape:
    """The shape that a scene names, scaled. Raises SceneError."""
    given = {k for k in ("size", "chamfer", "radius", "height", "sides", "points", "stl") if getattr(row, k) is not None}
    stray = sorted(given - SHAPE_KEYS[row.shape])
    if stray:
        allowed = ", ".join(sorted(SHAPE_KEYS[row.shape]))
        raise SceneError(f"{stray[0]} = {getattr(row, stray[0])}: not a key of shape {row.shape!r}; allowed: {allowed}")
    if row.shape == "hull":
        if (row.points is None) == (row.stl is None):
            raise SceneError("shape 'hull': points, stl: exactly one of the two must be given")
        if row.stl is not None:
            return shapes.scaled(shapes.hull_of_stl(Path(folder) / row.stl, row.unit), row.scale_factor)
        return shapes.scaled(shapes.hull(np.array(row.points) * row.unit), row.scale_factor)
    required = {"sphere": ["radius"], "cuboid": ["size"], "prism": ["sides", "radius", "height"]}
    for key in required.get(row.shape, ["radius", "height"] if row.shape == "cylinder" else []):
        if getattr(row, key) is None:
            raise SceneError(f"{key}: missing; shape {row.shape!r} needs it")
    maker = getattr(shapes, row.shape.replace("-", "_"))
    return shapes.scaled(maker(**{k: getattr(row, k) for k in given}), row.scale_factor)


def _pieces_of(scene: Scene):
    """The shape of each piece; one object where pieces are alike."""
    if scene.piece:
        cache: dict = {}
        out = []
        for n, row in enumerate(scene.piece):
            key = row.model_dump_json(include=set(PieceShape.model_fields))
            if key not in cache:
                cache[key] = _named(f"piece.{n}", make_shape, row, scene.folder)
            out.append(cache[key])
        return out
    shape = _named("portion", make_shape, scene.portion, scene.folder)
    return [shape] * sum(_counts(scene, shape))


def _counts(scene: Scene, shape):
    """Pieces of the portion, and on the feeder."""
    number = scene.portion.count or arrange.count(scene.portion.target_weight, scene.material.density * shape.volume)
    return number, (scene.feeder.count or number) if scene.feeder else 0


def _named(key, function, *arguments):
    """The function's value; an error names the key of the section that it is about."""
    try:
        return function(*arguments)
    except SceneError as error:
        raise SceneError(f"{key}.{error}") from error


def _distinct(made):
    distinct = list({id(m): m for m in made}.values())
    place = {id(m): k for k, m in enumerate(distinct)}
    return distinct, [place[id(m)] for m in made]


def _placed(scene: Scene, made, regions, random) -> Start:
    if scene.piece:
        rows = scene.piece
        q = np.array([p.orientation for p in rows], float)
        size = np.linalg.norm(q, axis=1, keepdims=True)
        if (size < 1e-6).any():
            k = int(np.argmin(size))
            raise SceneError(f"piece.{k}.orientation = {rows[k].orientation}: allowed: a quaternion that is not zero")
        return Start(
            np.array([p.position for p in rows], float),
            q / size,
            np.array([p.velocity for p in rows], float),
            np.array([p.angular_velocity for p in rows], float),
        )
    portion = scene.portion
    low, high = portion.region_low, portion.region_high
    if low is None or high is None:
        if not regions:
            raise SceneError("portion: region_low, region_high: missing; a scene without a feed bucket needs both")
        low, high = regions[0]
    radius = max(m.bounding_radius for m in made)
    boxes = [(low, high), *regions[1:]]
    groups = zip(_counts(scene, made[0]), boxes, strict=False)
    placed = [arrange.scatter(number, radius, portion.spacing, *box, random) for number, box in groups]
    position, orientation = (np.concatenate(rows) for rows in zip(*placed, strict=True))
    rest = np.zeros_like(position)
    return Start(position, orientation, rest, rest)


def _settling_samples(scene: Scene) -> int:
    if scene.piece or scene.portion.arrangement == "scattered":
        return 0
    return max(1, round(scene.portion.settling_time / scene.run.sample))


def _walls_of(scene: Scene):
    """Panels (group, corners, thickness), motions by group, reported names, blocks, and the boxes (low, high) in which
    pieces start: of the feed bucket, of the feeder."""
    panels, motions, joint, blocks, regions = [], list(scene.motion), {}, list(scene.block), []
    for wall in scene.wall:
        panels += _panels_of(wall, scene.folder)
    found = []
    if scene.weigh_bucket:
        found.append(buckets.parts(scene.weigh_bucket, "wb", 0.0))
        blocks.append(found[-1].block)
    if scene.feed_bucket:
        found.append(buckets.parts(scene.feed_bucket, "fb", scene.drop.height if scene.weigh_bucket else 0.0))
        regions.append((found[-1].interior_low, found[-1].interior_high))
    for bucket in found:
        panels += bucket.panels
        motions += bucket.motions
        joint |= bucket.joint
    if scene.feeder:
        feeder = buckets.feeder_parts(scene.feeder, found[-1])
        panels += feeder.panels
        motions.append(feeder.motion)
        blocks.append(found[-1].block)
        regions.append((feeder.interior_low, feeder.interior_high))
    known = {group for group, _, _ in panels}
    by_group = {}
    for motion in motions:
        if motion.group not in known or motion.group in by_group:
            why = "has two motions" if motion.group in by_group else "no wall has this group"
            raise SceneError(f"motion.group = {motion.group!r}: {why}; allowed: one each for {', '.join(sorted(known))}")
        by_group[motion.group] = motion
    return panels, by_group, joint, blocks, regions


def _panels_of(wall, folder):
    if (wall.corners is None) == (wall.stl is None):
        raise SceneError(f"wall {wall.group!r}: corners, stl: exactly one of the two must be given")
    if wall.corners is not None:
        return [(wall.group, np.array(wall.corners, float), wall.thickness)]
    polygons = meshes.panels_of_stl(Path(folder) / wall.stl, wall.unit)
    return [(wall.group, polygon, wall.thickness) for polygon in polygons]


def _wall_arrays(panels, motions, joint, dtype) -> Walls:
    groups = list(dict.fromkeys(group for group, _, _ in panels))
    made = [_plate(corners, thickness, f"corners of wall group {group!r}") for group, corners, thickness in panels]
    reports = {}
    for i, group in enumerate(groups):
        reports.setdefault(joint.get(group, group), []).append(i)
    rows = [_motion_row(motions.get(group)) for group in groups]
    columns = lambda k, size: np.array([row[k] for row in rows], float).reshape(len(groups), size).T  # noqa: E731
    extent = [np.abs(shape.vertices).max(0) for shape, _, _ in made]
    seams, plane = _seams([(group, corners) for group, corners, _ in panels])
    walls = Walls(
        centre=np.array([c for _, c, _ in made], float).reshape(-1, 3).T,
        rotation=np.array([r for _, _, r in made], float).reshape(-1, 3, 3).transpose(1, 2, 0),
        half_extent=np.array(extent, float).reshape(-1, 3).T,
        group=np.array([groups.index(group) for group, _, _ in panels], int),
        plane=plane,
        pivot=columns(0, 3),
        axis=columns(1, 3),
        swing=columns(2, 1)[0],
        timing=columns(3, 5),
        stroke=columns(4, 3),
        shake=columns(5, 4),
        groups=tuple(groups),
        reports=tuple((name, tuple(members)) for name, members in reports.items()),
        moving=any(group in motions for group in groups),
    )
    if seams:  # scene to panel frame
        seams = [across @ turn for across, (_, _, turn) in zip(seams, made, strict=True)]
    return _typed(walls, dtype), [shape for shape, _, _ in made], seams


def _seams(panels):
    """For each panel (group, corners) the directions [m, 3] outward across edges where another panel of its group
    continues its plane, and the number [W] of that plane, -1 where none does; None, None if there are no seams at all.
    """
    across, planes, known = [np.zeros((0, 3)) for _ in panels], np.full(len(panels), -1), []
    for group in {group for group, _ in panels}:
        members = [i for i, (name, _) in enumerate(panels) if name == group]
        flags = meshes.seams([panels[i][1] for i in members])
        for i, flag in zip(members, flags, strict=True):
            if not any(flag):
                continue
            corners = panels[i][1]
            normal = shapes.loop_normal(corners)
            out = np.cross(np.roll(corners, -1, axis=0) - corners, normal)[flag]
            across[i] = out / np.linalg.norm(out, axis=1, keepdims=True)
            size = np.linalg.norm(np.ptp(corners, axis=0))
            found = [
                k
                for k, (name, point, other) in enumerate(known)
                if name == group and other @ normal > np.cos(1e-3) and abs((corners[0] - point) @ other) < 1e-3 * size
            ]
            planes[i] = found[0] if found else len(known)
            known += [] if found else [(group, corners[0], normal)]
    return (across, planes) if known else (None, None)


def _hull_table(made, plates, seams):
    """The table of hulls of pieces and panels (None if there are none), and the row of each body."""
    distinct, index = _distinct([shape for shape in made if shape.radius == 0])
    numbers = iter(index)
    rows = [next(numbers) if shape.radius == 0 else 0 for shape in made]
    rows += [len(distinct) + k for k in range(len(plates))]
    every = [*distinct, *plates]
    if seams:
        seams = [np.zeros((0, 3))] * len(distinct) + seams
    return (hulls.table(every, np.float64, seams) if every else None), np.array(rows, int)


def _plate(corners, thickness, name):
    """A panel as a shape about its own centre with the surface's normal along z, its centre and its rotation."""
    meshes.plate(corners, thickness, name)  # raises what is wrong with the corners as they were given
    plate = meshes.plate(meshes.without_collinear(corners), thickness, name)
    x = corners[1] - corners[0]
    z = np.cross(corners - corners[0], np.roll(corners, -1, axis=0) - corners[0]).sum(0)
    z /= np.linalg.norm(z)
    x = (x - (x @ z) * z) / np.linalg.norm(x - (x @ z) * z)
    turn = np.stack([x, np.cross(z, x), z], axis=1)  # panel frame -> scene
    local = plate.vertices @ turn
    shape = shapes.polytope(name, local, plate.faces)
    centre = turn @ (local.mean(0) - shape.vertices.mean(0))  # of mass: where polytope() puts the origin
    return dataclasses.replace(shape, principal=np.array([1.0, 0, 0, 0])), centre, turn


def _motion_row(motion):
    if motion is None:
        return (0, 0, 0), (1, 0, 0), (0,), (0, 1, 0, 1, 0), (0, 0, 0), (0, 0, 1, 1)
    axis = np.array(motion.axis)
    if not np.linalg.norm(axis) > 0:
        raise SceneError(f"motion.axis = {motion.axis}: allowed: a vector that is not zero")
    return (
        motion.pivot,
        axis / np.linalg.norm(axis),
        (np.radians(motion.swing_deg),),
        (motion.start, motion.opening, motion.dwell, motion.closing, motion.period),
        motion.stroke,
        (motion.frequency, motion.shake_start, motion.shake_end, motion.shake_ramp),
    )


def _piece_arrays(scene: Scene, made) -> Pieces:
    m = scene.material
    distinct, index = _distinct(made)
    each = lambda value: np.array([value(shape) for shape in distinct])[index]  # noqa: E731
    mass = m.density * each(lambda s: s.volume)
    size = each(lambda s: shapes.size_length(s, m.stiffness_size))
    own = materials.stiffness(m.youngs_modulus, size, m.softening)
    wall = materials.stiffness(m.wall_youngs_modulus, size, m.softening)
    none = np.zeros(0, int)
    return Pieces(
        mass=mass,
        inertia=mass * each(lambda s: s.gyration).T,
        load_stiffness=own,
        wall_stiffness=own * wall / (own + wall),
        radius=each(lambda s: s.radius),
        bounding_radius=each(lambda s: s.bounding_radius),
        width=each(_width),
        polytopes=none,
        spheres=none,
    )


def _width(shape):
    """Smallest width (m): twice the smallest distance of a face from the centre's opposite side."""
    if shape.radius > 0:
        return 2 * shape.radius
    heights = shape.vertices @ shape.normals.T
    return float((heights.max(0) - heights.min(0)).min())


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
    parts = -(-substeps // _block_steps(scene))
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


def _block_steps(scene: Scene) -> int:
    """Most steps between rebuilds: few distinct numbers, as they are part of what is compiled."""
    return guard.round_to(8, scene.run.rebuild_steps)


def _possible_contacts(made, pieces: Pieces):
    """Effective mass, K_nl and eccentricity of each kind of piece against a wall and against the kinds that move quickest
    on its contact, about the centre of mass and off it: of as many kinds as pieces, all pairs would be too many to list."""
    _, index = _distinct(made)
    _, first, number = np.unique(index, return_index=True, return_counts=True)
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


def _capacity(made, polytopes, panels):
    """Kinds of contact that the scene can have, with candidates and slots to begin with (grown when they overflow).

    What a settled heap was seen to need.
    """
    p, s = len(polytopes), len(made) - len(polytopes)
    walls = 4 * s ** (2 / 3) + 8 if panels else 0
    wanted = {"hulls": (9 * p, 3 * p + 5), "mixed": (8 * min(p, s) + 2 * walls, 4 * min(p, s) + walls), "spheres": (8 * s, 4 * s)}
    out = []
    for kind in neighbours.SOURCES:
        every = search.pair_count(kind, p, s, panels)
        if every:
            out.append((kind, *(guard.round_up(min(every, math.ceil(count))) for count in wanted[kind])))
    return tuple(out)


def _row_capacity(made, choice) -> int:
    """Pieces that three cells of their bounding diameter hold when densely packed, to begin with; 0 without cells."""
    if search.choice(choice, len(made)) != "cells":
        return 0
    cell, volume = _diameter_and_volume(made)
    return guard.round_up(int(np.ceil(3 * 0.65 * cell**3 / volume)))


def _partition(made, choice, domain):
    """Room for the list of jax-md to begin with, where the scene chooses it."""
    if search.choice(choice, len(made)) != "jax-md":
        return None
    search.jax_md()  # before anything is traced
    return search.first_partition(len(made), *_diameter_and_volume(made), domain[1] - domain[0])


def _diameter_and_volume(made):
    """Diameter of the largest bounding sphere (m) and volume of the smallest piece (m3)."""
    return 2 * max(shape.bounding_radius for shape in made), min(shape.volume for shape in made)


def _domain(scene: Scene, panels, start: Start, made):
    points = np.concatenate([start.position, *[corners for _, corners, _ in panels]])
    margin = 0.1 + 2 * max(m.bounding_radius for m in made)
    low, high = points.min(0) - margin, points.max(0) + margin
    if scene.run.domain_low is not None:
        low = np.array(scene.run.domain_low)
    if scene.run.domain_high is not None:
        high = np.array(scene.run.domain_high)
    if (low >= high).any():
        raise SceneError(f"run.domain_low = {tuple(low)}: allowed: below run.domain_high = {tuple(high)}")
    out = (start.position < low) | (start.position > high)
    if out.any():
        k = int(np.argmax(out.any(1)))
        raise SceneError(f"piece.{k}.position = {tuple(start.position[k])}: outside the domain {tuple(low)} to {tuple(high)}")
    return low, high


def _law(scene: Scene) -> Law:
    m = scene.material
    return Law(
        restitution=np.float64(m.restitution),
        separation=np.float64(m.separation),
        friction_piece=np.float64(m.friction_piece),
        friction_wall=np.float64(m.friction_wall),
        tangential=np.float64(m.tangential_stiffness),
        damping=np.float64(m.unloading_damping),
    )


def _typed(tree, dtype):
    """Float leaves to the dtype, int leaves to int32."""

    def leaf(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(np.int32 if x.dtype.kind == "i" else dtype))  # converted here: nothing to compile

    return jax.tree.map(leaf, tree)


def _motion(system: System, start: Start, frames) -> dict:
    """The fields of State that follow from poses and velocities in the user's body frames, in numpy; frames: Built.frames."""
    dtype = system.dt.dtype
    position = start.position.T.astype(np.float64)
    high = position.astype(dtype)
    q = np.stack(rotation.multiply(tuple(start.orientation.T), tuple(np.asarray(frames).T))).astype(dtype)
    inertia = np.asarray(system.pieces.inertia)
    momentum = rotation.angular_momentum(tuple(q), tuple(start.spin.T.astype(dtype)), tuple(inertia))
    return {
        "position": high,
        "position_rest": (position - high).astype(dtype),
        "orientation": q,
        "velocity": start.velocity.T.astype(dtype),
        "angular_momentum": np.stack(momentum),
    }


def first_state(system: System, start: Start, frames, step: int) -> State:
    """The state at a step, without any contact; start, frames: as of ``_motion``."""
    dtype = system.dt.dtype
    groups = len(system.walls.groups)
    zero = lambda *shape: np.zeros(shape, dtype)  # noqa: E731
    n = len(start.position)
    contacts = {
        kind: neighbours.empty_table(slots, dtype) for kind, _, slots in system.capacity
    }
    columns = 2 * sum(slots for *_, slots in system.capacity)  # of loads
    state = State(
        **_motion(system, start, frames),
        step=np.int32(step),
        velocity_rest=zero(3, n),
        force=zero(3, n),
        torque=zero(3, n),
        wall_force=zero(3, groups),
        wall_torque=zero(3, groups),
        contacts=contacts,
        slots=_unfilled_slots(system, contacts),
        filled={kind: np.int32(0) for kind in contacts},
        busiest=np.int32(0),
        walled=None,
        most_walled=None,
        incidence=np.full((system.touching, n), columns, np.int32),
        loads=zero(6, columns + 1),
        ledger=forces.empty_ledger(system, dtype),
        anchor=zero(7, n),
        since=np.int32(step),
        lead=zero(),
        guard=neighbours.empty_guard(system, dtype),
    )
    return jax.tree.map(jnp.asarray, state)  # made in numpy: each operation of jax.numpy would be compiled


def _unfilled_slots(system: System, contacts):
    """Slots of the right form, which the first rebuild fills."""
    find = lambda: {k: neighbours.constants(system, k, jnp.asarray(t.a), jnp.asarray(t.b)) for k, t in contacts.items()}  # noqa: E731
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(find))
