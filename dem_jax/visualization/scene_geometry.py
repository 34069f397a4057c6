"""Shapes, walls and wall poses of a stored run, from the scene in its file, for pictures and
exports.
"""

from collections.abc import Callable
from functools import cache

import jax
import numpy as np

from dem_jax import assembly
from dem_jax.io.run_data import Run
from dem_jax.scene import Scene, parse_scene
from dem_jax.shapes import Shape, wall_meshes
from dem_jax.types import Walls
from dem_jax.walls import motion

BodyMesh = tuple[np.ndarray, tuple[tuple[int, ...], ...]]  # vertices [V, 3] (m), faces
GroupPoses = dict[str, tuple[np.ndarray, np.ndarray]]  # group -> (rotation [3, 3], origin [3] (m))
WallPose = Callable[[float], GroupPoses]  # of a time (s)


def load_bodies(run: Run) -> tuple[list[Shape], dict[str, list[BodyMesh]], WallPose]:
    """The arguments of rendering.render_frames and vtk_export.export_vtk for a single run: shapes,
    walls, wall_pose.

    shapes: a Shape per piece. walls: group -> [(vertices [V, 3] (m), faces)] in the scene's rest
    pose, the first face being the touched surface. wall_pose: t (s) -> group -> (rotation [3, 3],
    origin [3] (m)). Raises SceneError.
    """
    scene = parse_scene(run.scene, "the file's scene")
    return assembly.piece_arrays.make_piece_shapes(scene), *walls_of_scene(scene)


def walls_of_scene(scene: Scene) -> tuple[dict[str, list[BodyMesh]], WallPose]:
    """Walls and wall_pose of a scene whose STL files are read, as in ``load_bodies``. Raises
    SceneError.
    """
    panels, motions, joint, *_ = assembly.wall_panels.lay_out_walls(scene)
    with jax.enable_x64(True):
        walls = assembly.wall_panels.build_walls(scene, panels, motions, joint, np.float64)[0]
    solids: dict[str, list[BodyMesh]] = {group: [] for group in walls.groups}
    for group, corners, thickness in panels:
        plate = wall_meshes.build_plate(corners, thickness)
        solids[group].append((plate.vertices, plate.faces))
    return solids, _build_pose_function(walls)


def _build_pose_function(walls: Walls) -> WallPose:
    """t (s) -> group -> (rotation [3, 3], origin [3] (m)) from the rest pose."""
    still = {group: (np.eye(3), np.zeros(3)) for group in walls.groups}
    if not walls.has_motion:
        return lambda t: still
    program = jax.jit(lambda walls, t: motion.compose_group_poses(walls, t, t)[:2])
    rest = np.asarray(walls.pivot)

    @cache
    def pose_at(t: float) -> GroupPoses:
        with jax.enable_x64(True):
            turn, pivot = jax.device_get(program(walls, np.float64(t)))
        turns, pivots = np.moveaxis(np.array(turn), -1, 0), np.array(pivot).T
        origins = pivots - np.einsum("gij,gj->gi", turns, rest.T)
        return {group: (turns[i], origins[i]) for i, group in enumerate(walls.groups)}

    return pose_at
