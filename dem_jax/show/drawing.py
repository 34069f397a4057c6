"""Shapes, walls and wall poses of a stored run, from the scene in its file, for pictures and exports."""

from collections.abc import Callable
from functools import cache

import jax
import numpy as np

from dem_jax import build
from dem_jax.contact import motion
from dem_jax.scene import Scene, parse
from dem_jax.shapes import Shape, meshes
from dem_jax.store.run import Run
from dem_jax.types import Walls

Solid = tuple[np.ndarray, tuple[tuple[int, ...], ...]]  # vertices [V, 3] (m), faces
Poses = dict[str, tuple[np.ndarray, np.ndarray]]  # group -> (rotation [3, 3], origin [3] (m))
WallPose = Callable[[float], Poses]  # of a time (s)


def bodies_of(run: Run) -> tuple[list[Shape], dict[str, list[Solid]], WallPose]:
    """The arguments of render.render and vtk.export_vtk for a single run: shapes, walls, wall_pose.

    shapes: a Shape per piece. walls: group -> [(vertices [V, 3] (m), faces)] in the scene's rest pose, the first face
    being the touched surface. wall_pose: t (s) -> group -> (rotation [3, 3], origin [3] (m)). Raises SceneError.
    """
    scene = parse(run.scene, "the file's scene")
    return build.pieces.pieces_of(scene), *walls_of_scene(scene)


def walls_of_scene(scene: Scene) -> tuple[dict[str, list[Solid]], WallPose]:
    """Walls and wall_pose of a scene whose STL files are read, as in ``bodies_of``. Raises SceneError."""
    panels, motions, joint, *_ = build.walls.walls_of(scene)
    with jax.enable_x64(True):
        walls = build.walls.wall_arrays(scene, panels, motions, joint, np.float64)[0]
    solids: dict[str, list[Solid]] = {group: [] for group in walls.groups}
    for group, corners, thickness in panels:
        plate = meshes.plate(corners, thickness)
        solids[group].append((plate.vertices, plate.faces))
    return solids, _pose_function(walls)


def _pose_function(walls: Walls) -> WallPose:
    """t (s) -> group -> (rotation [3, 3], origin [3] (m)) from the rest pose."""
    still = {group: (np.eye(3), np.zeros(3)) for group in walls.groups}
    if not walls.moving:
        return lambda t: still
    program = jax.jit(lambda walls, t: motion.frames(walls, t, t)[:2])
    rest = np.asarray(walls.pivot)

    @cache
    def pose(t: float) -> Poses:
        with jax.enable_x64(True):
            turn, pivot = jax.device_get(program(walls, np.float64(t)))
        turns, pivots = np.moveaxis(np.array(turn), -1, 0), np.array(pivot).T
        origins = pivots - np.einsum("gij,gj->gi", turns, rest.T)
        return {group: (turns[i], origins[i]) for i, group in enumerate(walls.groups)}

    return pose
