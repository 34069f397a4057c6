"""What the 3-D view of a report plays: shapes, walls and stored poses as plain data, and the library that draws them."""

import base64
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import RecordError
from dem_jax.maths.pose import quaternion_of_matrix
from dem_jax.shapes import Shape, surface
from dem_jax.show.drawing import Solid, WallPose, bodies_of
from dem_jax.show.render import Camera, scene_of
from dem_jax.store.run import Run

MOST_BYTES = 5 * 2**20  # of the poses in a page, all views together
MOST_PLATES = 1000  # of walls that are drawn with their thickness and edges


def three() -> str:
    """three.js (MIT licence; THREE with TrackballControls), which trimesh ships within its own viewer.

    Raises RecordError for a trimesh whose viewer is another.
    """
    import trimesh
    from trimesh.viewer.notebook import scene_to_html

    page = scene_to_html(trimesh.Scene(trimesh.creation.box()))
    found = re.search(r"<script>(.*?)var camera,\s*controls,\s*scene,\s*renderer", page, re.DOTALL)
    if found is None or "TrackballControls" not in found[1]:
        allowed = "allowed: one with the viewer of trimesh 4.5 to 5.2"
        raise RecordError(f"trimesh {trimesh.__version__} has no three.js that a report can use; {allowed}")
    return found[1]


def view_of(run: Run, views: int = 1) -> dict[str, Any] | None:
    """The data of a single run's view, for JSON; None: the run has no frames. views: how many share the page.

    time: [F] (s); shapes and walls (one of each group): triangles; shape: of each of the N pieces; position [F, N, 3] (m)
    and orientation [F, N, 4] of pieces, wall_pose [F or 1, G, 7], position and quaternion: base64 of float32; box: low and
    high corner (m) of what is shown; fastest: (m/s). Raises SceneError.
    """
    frames = run.pieces
    if frames is None or not np.isfinite(frames.position).any():
        return None
    shapes, walls, wall_pose = bodies_of(run)
    scene = scene_of(frames, shapes, walls, wall_pose, Camera())
    count, pieces = frames.position.shape[:2]
    kept = slice(None, None, max(1, -(-count * pieces * 7 * 4 * 4 // 3 * views // MOST_BYTES)))
    distinct = list({id(shape): shape for shape in shapes}.values())
    place = {id(shape): k for k, shape in enumerate(distinct)}
    return {
        "time": frames.time[kept].tolist(),
        "shapes": [_shape(shape) for shape in distinct],
        "shape": [place[id(shape)] for shape in shapes],
        "position": _coded(frames.position[kept]),
        "orientation": _coded(frames.orientation[kept]),
        "walls": [_plates(plates, sum(map(len, walls.values())) <= MOST_PLATES) for plates in walls.values()],
        "wall_pose": _coded(_wall_poses(list(walls), wall_pose, frames.time[kept])),
        "box": scene.view.box.tolist(),
        "fastest": scene.fastest,
    }


def _wall_poses(groups: Sequence[str], wall_pose: WallPose, times: np.ndarray) -> np.ndarray:
    """Origin and quaternion of each group at each time, [F, G, 7]; [1, G, 7] if nothing moves."""
    each = [[wall_pose(float(t))[group] for group in groups] for t in times]
    poses = np.array([[np.r_[origin, quaternion_of_matrix(turn)] for turn, origin in row] for row in each])
    poses = poses.reshape(len(times), len(groups), 7)
    return poses[:1] if (poses == poses[:1]).all() else poses


def _shape(shape: Shape) -> dict[str, Any]:
    vertices, faces = surface(shape)
    return _mesh(vertices, faces) | {"smooth": shape.radius > 0.0}


def _plates(plates: Sequence[Solid], whole: bool) -> dict[str, Any]:
    """The panels of a group, as plates or as the surfaces that are touched."""
    vertices, faces, start = [], [], 0
    for points, loops in plates:
        vertices.append(points)
        faces += [tuple(start + v for v in loop) for loop in (loops if whole else loops[:1])]
        start += len(points)
    return _mesh(np.concatenate(vertices), faces) | {"edges": whole}


def _mesh(vertices: np.ndarray, faces: Sequence[Sequence[int]]) -> dict[str, Any]:
    """Triangles [.., 3, 3] (m) of convex faces."""
    corners = [(loop[0], loop[i], loop[i + 1]) for loop in faces for i in range(1, len(loop) - 1)]
    return {"triangles": _coded(vertices[np.array(corners, int)])}


def _coded(values: ArrayLike) -> str:
    """Base64 of little-endian float32."""
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode()
