"""Shapes, walls and wall poses of a stored run, from the scene in its file, for pictures and
exports.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dem_jax import assembly
from dem_jax.io.run_data import Run
from dem_jax.scene import Scene, parse_scene
from dem_jax.shapes import Shape, wall_meshes
from dem_jax.types import Walls
from dem_jax.walls import motion

BodyMesh = tuple[np.ndarray, tuple[tuple[int, ...], ...]]  # vertices [V, 3] (m), faces
GroupPoses = dict[str, tuple[np.ndarray, np.ndarray]]  # group -> (rotation [.., 3, 3], origin
# [.., 3] (m))
WallPose = Callable[[ArrayLike], GroupPoses]  # of times [..] (s)
TIMES_AT_ONCE = 64  # at which poses are computed: one program serves for any number


def load_bodies(run: Run) -> tuple[list[Shape], dict[str, list[BodyMesh]], WallPose]:
    """The arguments of rendering.render_frames and vtk_export.export_vtk for a single run: shapes,
    walls, wall_pose.

    shapes: a Shape per piece. walls: group -> [(vertices [V, 3] (m), faces)] in the scene's rest
    pose, the first face being the touched surface. wall_pose: times [..] (s) -> group -> (rotation
    [.., 3, 3], origin [.., 3] (m)). Raises SceneError.
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
    """Times [..] (s) -> group -> (rotation [.., 3, 3], origin [.., 3] (m)) from the rest pose."""
    groups, rest = walls.groups, np.asarray(walls.pivot)

    def pose_at(times: ArrayLike) -> GroupPoses:
        asked = np.asarray(times, np.float64)
        if walls.has_motion:
            turns, pivots = _compose_poses(walls, asked.ravel())
            origins = pivots - np.einsum("tijg,jg->tig", turns, rest)
        else:
            turns = np.broadcast_to(np.eye(3)[:, :, None], (asked.size, 3, 3, len(groups)))
            origins = np.zeros((asked.size, 3, len(groups)))
        return {
            group: (
                turns[..., g].reshape(*asked.shape, 3, 3),
                origins[..., g].reshape(*asked.shape, 3),
            )
            for g, group in enumerate(groups)
        }

    return pose_at


def _compose_poses(walls: Walls, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [T, 3, 3, G] and pivots [T, 3, G] (m) of the groups at times [T] (s)."""
    blocks = np.array_split(times, range(TIMES_AT_ONCE, len(times), TIMES_AT_ONCE))
    full = [np.pad(block, (0, TIMES_AT_ONCE - len(block)), mode="edge") for block in blocks]
    with jax.enable_x64(True):
        found = jax.device_get([_compose_block(walls, block) for block in full])
    turns, pivots = (np.concatenate(each)[: len(times)] for each in zip(*found, strict=True))
    return turns, pivots


@jax.jit
def _compose_block(walls: Walls, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    poses = jax.vmap(lambda t: motion.compose_group_poses(walls, t, t)[:2])(times)
    turns, pivots = (jnp.moveaxis(jnp.array(each), -2, 0) for each in poses)
    return turns, pivots
