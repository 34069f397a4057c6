"""Export of a run as an animated 3-D model, glTF 2.0: a node for each piece and each group of
walls, their stored poses as animation.
"""

import base64
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import write_atomically
from dem_jax.io.run_data import Run
from dem_jax.visualization.run_figure import check_format
from dem_jax.visualization.web_viewer import BodyMotion, collect_motion

FLOAT, POSITIONS, ORIENTATIONS, SIZES = 5126, slice(0, 3), slice(3, 7), [7, 7, 7]
CHANNELS = (
    ("translation", POSITIONS, "VEC3", "LINEAR"),
    ("rotation", ORIENTATIONS, "VEC4", "LINEAR"),
    ("scale", SIZES, "VEC3", "STEP"),  # of pieces that are not there from beginning to end
)
PIECE, WALL = (0.93, 0.72, 0.53, 1.0), (0.62, 0.69, 0.76, 0.35)  # r, g, b, a
Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # quaternion x y z w: glTF has y up


def write_gltf(run: Run, path: str | Path) -> Path:
    """Write a single run as .glb, metres and seconds, y up. Returns the path.

    Raises RecordError for another format, a run without frames and a file that cannot be written,
    SceneError for a scene that cannot be read.
    """
    path = Path(path)
    check_format(path, (".glb",))
    found = collect_motion(run)
    if found is None:
        raise RecordError(
            f"{path} cannot be written: the run has no frames; set run.frame_interval to the time between them (s)"
        )
    return write_atomically(path, encode_glb(found))


def encode_glb(found: BodyMotion) -> bytes:
    """The model as GLB."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene, poses = trimesh.Scene(), _node_poses(found)
    for k, of in enumerate(found.shape):
        if f"shape {of}" in scene.geometry:
            scene.graph.update(frame_to=f"piece {k}", geometry=f"shape {of}")
        else:
            scene.add_geometry(
                _triangle_mesh(found.shapes[of][0], PIECE),
                node_name=f"piece {k}",
                geom_name=f"shape {of}",
            )
    for group, (triangles, _) in found.walls.items():
        scene.add_geometry(_triangle_mesh(triangles, WALL), node_name=group, geom_name=group)
    return bytes(
        export_glb(scene, tree_postprocessor=lambda tree: _add_animation(tree, found.time, poses))
    )


def _triangle_mesh(triangles: np.ndarray, colour: tuple[float, ...]) -> Any:
    """Triangles with flat faces, in metres."""
    import trimesh
    from trimesh.visual.material import PBRMaterial

    corners = np.asarray(triangles, np.float64).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    mode = "BLEND" if colour[3] < 1.0 else "OPAQUE"
    material = PBRMaterial(
        baseColorFactor=colour,
        metallicFactor=0.0,
        roughnessFactor=0.8,
        alphaMode=mode,
        doubleSided=True,
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh


def _node_poses(found: BodyMotion) -> dict[str, np.ndarray]:
    """Name of each node -> [F or 1, 8]: position (m), quaternion x y z w, size: 1, or 0 for an
    absent piece.
    """
    pieces = np.concatenate([found.position, np.roll(found.orientation, -1, axis=-1)], axis=-1)
    walls = np.concatenate(
        [found.wall_pose[..., :3], np.roll(found.wall_pose[..., 3:], -1, axis=-1)], axis=-1
    )
    named = {f"piece {k}": pieces[:, k] for k in range(pieces.shape[1])}
    named |= {group: walls[:, k] for k, group in enumerate(found.walls)}
    return {
        name: _fill_missing_poses(pose[:1] if (pose == pose[:1]).all() else pose)
        for name, pose in named.items()
    }


def _fill_missing_poses(pose: np.ndarray) -> np.ndarray:
    """Fill the poses (nan) of absent pieces with the last known pose and size 0."""
    there = np.isfinite(pose).all(axis=1)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(pose)), 0))
    known = np.nan_to_num(pose[latest])
    known[~there[latest], 6] = 1.0  # nothing known yet: a unit quaternion
    return np.c_[_continuous_rotations(known), there]


def _continuous_rotations(pose: np.ndarray) -> np.ndarray:
    """Poses with the sign of each quaternion chosen so that it is nearer to the one before; both
    signs are one rotation."""
    turn = pose[:, ORIENTATIONS]
    flips = np.cumprod(np.sign(np.r_[1.0, (turn[1:] * turn[:-1]).sum(axis=1)]) + 0.0)
    return np.concatenate(
        [pose[:, POSITIONS], turn * np.where(flips == 0.0, 1.0, flips)[:, None]], axis=1
    )


def _add_animation(tree: dict[str, Any], time: np.ndarray, poses: dict[str, np.ndarray]) -> None:
    """Put the poses into the tree of a glTF: the first as that of each node, all as an animation."""
    data, number = bytearray(), len(tree["buffers"])

    def add_accessor(values: np.ndarray, kind: str) -> int:
        values = np.ascontiguousarray(values, "<f4")
        tree["bufferViews"].append(
            {"buffer": number, "byteOffset": len(data), "byteLength": values.nbytes}
        )
        data.extend(values.tobytes())
        bounds = (
            {"min": [float(values.min())], "max": [float(values.max())]} if kind == "SCALAR" else {}
        )
        row = {
            "bufferView": len(tree["bufferViews"]) - 1,
            "componentType": FLOAT,
            "count": len(values),
            "type": kind,
        }
        tree["accessors"].append(row | bounds)
        return len(tree["accessors"]) - 1

    times = add_accessor(time, "SCALAR")
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for k, node in enumerate(tree["nodes"]):
        if node["name"] not in poses:
            continue
        pose = poses[node["name"]]
        node.pop("matrix", None)
        for what, columns, kind, between in CHANNELS if not pose[:, SIZES].all() else CHANNELS[:2]:
            node[what] = pose[0, columns].tolist()
            if len(pose) > 1:
                samplers.append(
                    {
                        "input": times,
                        "output": add_accessor(pose[:, columns], kind),
                        "interpolation": between,
                    }
                )
                channels.append({"sampler": len(samplers) - 1, "target": {"node": k, "path": what}})
    coded = base64.b64encode(data).decode()
    tree["buffers"].append(
        {"byteLength": len(data), "uri": f"data:application/octet-stream;base64,{coded}"}
    )
    scene = tree["scenes"][tree["scene"]]
    tree["nodes"].append({"name": "drop", "rotation": Z_UP, "children": scene["nodes"]})
    scene["nodes"] = [len(tree["nodes"]) - 1]
    if channels:
        tree["animations"] = [{"name": "drop", "samplers": samplers, "channels": channels}]
