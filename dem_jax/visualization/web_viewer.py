"""Data of the 3-D view of a report: shapes, walls and stored poses as plain data, and the library
that draws them.
"""

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import RecordError
from dem_jax.io.run_data import Run
from dem_jax.math.pose import matrix_to_quaternion
from dem_jax.scene import Scene
from dem_jax.shapes import surface_mesh
from dem_jax.visualization import webpage
from dem_jax.visualization.rendering import Camera, build_render_scene
from dem_jax.visualization.scene_geometry import BodyMesh, WallPose, load_bodies, walls_of_scene

MOST_BYTES = 5 * 2**20  # of the poses in a page, all views together
MOST_PLATES = 1000  # of walls that are drawn with their thickness and edges
SLOWER = (1, 2, 5, 10, 20, 50, 100, 200)  # than real time: choices of the player
# of a page that loads nothing
POLICY = "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def load_three_js() -> str:
    """three.js (MIT licence; THREE with TrackballControls), which trimesh ships within its own
    viewer.

    Raises RecordError for a trimesh whose viewer is another.
    """
    package = find_spec("trimesh")  # importing it takes longer than all else on the page
    assert package is not None and package.origin is not None
    packed = Path(package.origin).parent / "resources" / "templates" / "viewer.zip"
    try:
        with ZipFile(packed) as files:
            page = files.read("viewer.html.template").decode()
    except (OSError, KeyError, BadZipFile):
        page = ""
    found = re.search(r"<script>(.*?)var camera,\s*controls,\s*scene,\s*renderer", page, re.DOTALL)
    if found is None or "TrackballControls" not in found[1]:
        allowed = "allowed: one with the viewer of trimesh 4.5 to 5.2"
        raise RecordError(f"trimesh has no three.js that a report can use ({packed}); {allowed}")
    return found[1]


@dataclass(frozen=True)
class BodyMotion:
    """The moving bodies of a single run, at F stored instants: N pieces of a few shapes, G groups
    of walls.

    time: [F] (s). shapes: triangles [.., 3, 3] (m) of each, in its body frame, and whether it is
    round. shape: [N], that of each piece. position: [F, N, 3] (m). orientation: [F, N, 4]. walls:
    group -> triangles (m) in the rest frame, and whether they are plates with edges. wall_pose: [F
    or 1, G, 7], position (m) and quaternion. box: [2, 3] (m), shown. fastest: (m/s).
    """

    time: np.ndarray
    shapes: list[tuple[np.ndarray, bool]]
    shape: list[int]
    position: np.ndarray
    orientation: np.ndarray
    walls: dict[str, tuple[np.ndarray, bool]]
    wall_pose: np.ndarray
    box: np.ndarray
    fastest: float


def collect_motion(run: Run, most_bytes: float = np.inf) -> BodyMotion | None:
    """The moving bodies of a run; None: the run has no frames.

    most_bytes: limit for positions and orientations in base64; instants are left out where there
    would be more. Raises SceneError.
    """
    frames = run.pieces
    if frames is None or not np.isfinite(frames.position).any():
        return None
    shapes, walls, wall_pose = load_bodies(run)
    scene = build_render_scene(frames, shapes, walls, wall_pose, Camera())
    count, pieces = frames.position.shape[:2]
    kept = slice(None, None, max(1, int(np.ceil(count * pieces * 7 * 4 * 4 // 3 / most_bytes))))
    distinct = list({id(shape): shape for shape in shapes}.values())
    place = {id(shape): k for k, shape in enumerate(distinct)}
    whole = sum(map(len, walls.values())) <= MOST_PLATES
    return BodyMotion(
        time=frames.time[kept],
        shapes=[
            (_triangulate_faces(*surface_mesh(shape)), shape.radius > 0.0) for shape in distinct
        ],
        shape=[place[id(shape)] for shape in shapes],
        position=frames.position[kept],
        orientation=frames.orientation[kept],
        walls={group: (_plate_triangles(plates, whole), whole) for group, plates in walls.items()},
        wall_pose=_sample_wall_poses(list(walls), wall_pose, frames.time[kept]),
        box=scene.view.box,
        fastest=scene.fastest,
    )


def build_view_data(run: Run, views: int = 1) -> dict[str, Any] | None:
    """The data of a single run's view, for JSON; None: the run has no frames. views: number of
    views on the page.

    As ``BodyMotion``, arrays as base64 of float32. Raises SceneError.
    """
    found = collect_motion(run, MOST_BYTES / views)
    if found is None:
        return None
    return {
        "time": found.time.tolist(),
        "shapes": [
            {"triangles": _encode_base64(triangles), "smooth": smooth}
            for triangles, smooth in found.shapes
        ],
        "shape": found.shape,
        "position": _encode_base64(found.position),
        "orientation": _encode_base64(found.orientation),
        "walls": [
            {"triangles": _encode_base64(triangles), "edges": edges}
            for triangles, edges in found.walls.values()
        ],
        "wall_pose": _encode_base64(found.wall_pose),
        "box": found.box.tolist(),
        "fastest": found.fastest,
    }


def view_walls(scene: Scene, times: np.ndarray, level: np.ndarray | None = None) -> dict[str, Any]:
    """The data of a view of the walls of a scene without pieces, for JSON.

    Args:
        scene: with its STL files read.
        times: [F] (s) instants of the moving walls.
        level: triangles [.., 3, 3] (m) of a surface that is drawn in the buckets.

    Raises:
        SceneError: a wall cannot be read.
    """
    walls, wall_pose = walls_of_scene(scene)
    points = np.concatenate([corners for plates in walls.values() for corners, _ in plates])
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    surfaces = [] if level is None else [level]
    whole = sum(map(len, walls.values())) <= MOST_PLATES
    return {
        "time": times.tolist(),
        "shapes": [{"triangles": _encode_base64(each), "smooth": False} for each in surfaces],
        "shape": list(range(len(surfaces))),
        "position": _encode_base64(np.zeros((len(times), 3 * len(surfaces)))),
        "orientation": _encode_base64(still if surfaces else np.zeros((len(times), 0))),
        "walls": [
            {"triangles": _encode_base64(_plate_triangles(plates, whole)), "edges": whole}
            for plates in walls.values()
        ],
        "groups": list(walls),
        "wall_pose": _encode_base64(_sample_wall_poses(list(walls), wall_pose, times)),
        "box": [points.min(axis=0).tolist(), points.max(axis=0).tolist()],
        "fastest": 0.0,
    }


def write_controls(names: Sequence[str]) -> str:
    """The canvas of the player and its controls as HTML. names: of the views to choose from."""
    runs = "".join(f'<option value="{k}">{escape(name)}</option>' for k, name in enumerate(names))
    paces = "".join(
        f'<option value="{n}">{"real time" if n == 1 else f"{n} times slower"}</option>'
        for n in SLOWER
    )
    return f"""<div class="view"><canvas id="drop"></canvas><div class="controls">
<button id="play">Play</button><input type="range" id="time" min="0" value="0" step="1" aria-label="instant">
<output id="shown"></output><select id="pace" aria-label="pace">{paces}</select>
<select id="run" aria-label="run"{"" if len(names) > 1 else " hidden"}>{runs}</select><button id="again">Reset view</button>
</div></div>"""


def write_player(title: str, view: dict[str, Any] | None, more: str = "") -> str:
    """A self-contained page of the player alone, as HTML text.

    Args:
        title: of the page.
        view: of ``build_view_data`` or ``view_walls``; None: a script puts one there.
        more: script that runs after the player's.
    """
    fields = {
        "view": write_controls([title]),
        "views": json.dumps([{"name": title, "view": view}] if view else []).replace(
            "<", "\\u003c"
        ),
        "three": load_three_js(),
        "script": webpage.read_page_part("report.js"),
        "more": more,
    }
    policy = POLICY if view else f"{POLICY}; connect-src 'self'"
    return webpage.fill_page(title, policy, "player.html", **fields)


def _sample_wall_poses(groups: Sequence[str], wall_pose: WallPose, times: np.ndarray) -> np.ndarray:
    """Origin and quaternion of each group at each time, [F, G, 7]; [1, G, 7] if nothing moves."""
    each = wall_pose(times)
    rows = [np.concatenate([each[g][1], matrix_to_quaternion(each[g][0])], -1) for g in groups]
    poses = np.stack(rows, 1) if rows else np.zeros((len(times), 0, 7))
    return poses[:1] if (poses == poses[:1]).all() else poses


def _plate_triangles(plates: Sequence[BodyMesh], whole: bool) -> np.ndarray:
    """Triangles of the panels of a group, as plates or as the surfaces that are touched."""
    return np.concatenate(
        [_triangulate_faces(points, loops if whole else loops[:1]) for points, loops in plates]
    )


def _triangulate_faces(vertices: np.ndarray, faces: Sequence[Sequence[int]]) -> np.ndarray:
    """[.., 3, 3] (m) of convex faces."""
    corners = [(loop[0], loop[i], loop[i + 1]) for loop in faces for i in range(1, len(loop) - 1)]
    return vertices[np.array(corners, int)]


def _encode_base64(values: ArrayLike) -> str:
    """Base64 of little-endian float32."""
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode()
