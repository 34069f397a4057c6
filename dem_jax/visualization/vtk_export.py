"""Export of stored poses for ParaView: one .vtp file per frame for the pieces and for the walls,
and a .pvd of each.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import lock_file, write_atomically
from dem_jax.io.run_data import Frames
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import Shape, surface_mesh
from dem_jax.visualization.scene_geometry import BodyMesh, WallPose

VTK_TYPES = {"f": "Float64", "i": "Int64"}


def export_vtk(
    frames: Frames,
    shapes: Sequence[Shape],
    folder: str | Path,
    walls: Mapping[str, Sequence[BodyMesh]] | None = None,
    wall_pose: WallPose | None = None,
) -> list[Path]:
    """Write pieces.pvd and walls.pvd, which ParaView opens as animations, and their frames into a
    folder.

    frames: io.run_data.Frames of a single run. shapes: a Shape for each of the N pieces. walls:
    group -> list of (vertices [V, 3] (m), faces) in the group's rest frame; wall_pose: t -> group
    -> (rotation [3, 3], origin [3] (m)), both or neither. Facets carry the piece's number, speed
    (m/s) and spin (rad/s); those of walls the group's number, in the order of walls. Returns the
    paths of the .pvd files. Raises RecordError if the folder cannot be written.
    """
    folder = Path(folder)
    solids = [surface_mesh(shape) for shape in shapes]
    groups = [group for group, plates in (walls or {}).items() for _ in plates]
    plates = [plate for plates in (walls or {}).values() for plate in plates]
    names: dict[str, list[str]] = {"pieces": [], "walls": []} if plates else {"pieces": []}
    with lock_file(folder):
        _prepare_folder(folder, names)
        for i, t in enumerate(frames.time):
            speed = np.linalg.norm(frames.velocity[i], axis=-1)
            spin = np.linalg.norm(frames.angular_velocity[i], axis=-1)
            here = np.flatnonzero(np.isfinite(frames.position[i]).all(axis=-1))  # without pieces
            # that wait for an inlet
            data = {"piece": here, "speed": speed[here], "spin": spin[here]}
            rotations = quaternion_to_matrix(frames.orientation[i, here])
            placed = _transform_bodies(
                [solids[n] for n in here], rotations, frames.position[i, here]
            )
            names["pieces"].append(_write_frame(folder, "pieces", i, placed, data))
            if plates:
                assert walls is not None and wall_pose is not None
                poses = wall_pose(float(t))
                placed = _transform_bodies(
                    plates, *zip(*(poses[group] for group in groups), strict=True)
                )
                number = {"group": np.array([list(walls).index(group) for group in groups])}
                names["walls"].append(_write_frame(folder, "walls", i, placed, number))
        return [
            _write_collection(folder / f"{kind}.pvd", frames.time, files)
            for kind, files in names.items()
        ]


def _prepare_folder(folder: Path, kinds: Iterable[str]) -> None:
    """Make the folder and remove the collections of an earlier export, so that a collection always
    lists all frames.
    """
    try:
        (folder / "frames").mkdir(parents=True, exist_ok=True)
        for kind in kinds:
            (folder / f"{kind}.pvd").unlink(missing_ok=True)
    except OSError as error:
        raise RecordError(f"{folder} cannot be written: {error.strerror or error}") from error


def _transform_bodies(
    solids: Sequence[BodyMesh], rotations: Iterable[np.ndarray], origins: Iterable[np.ndarray]
) -> list[BodyMesh]:
    """(vertices, faces) of each body, turned and moved."""
    bodies = zip(solids, rotations, origins, strict=True)
    return [
        (vertices @ np.asarray(turn).T + origin, faces)
        for (vertices, faces), turn, origin in bodies
    ]


def _write_frame(
    folder: Path, kind: str, i: int, bodies: Sequence[BodyMesh], data: Mapping[str, ArrayLike]
) -> str:
    """Write one frame; its name relative to the folder."""
    name = f"frames/{kind}_{i:05d}.vtp"
    write_atomically(folder / name, format_polydata(bodies, data).encode())
    return name


def format_polydata(bodies: Sequence[BodyMesh], data: Mapping[str, ArrayLike]) -> str:
    """VTK XML PolyData (text) of bodies, a list of (vertices [V, 3], faces); data: name -> a value
    per body.
    """
    counts = [len(vertices) for vertices, _ in bodies]
    starts = np.cumsum([0, *counts])
    loops = [
        np.asarray(loop) + start
        for (_, faces), start in zip(bodies, starts, strict=False)
        for loop in faces
    ]
    body_of_loop = np.repeat(np.arange(len(bodies)), [len(faces) for _, faces in bodies])
    cell_data = [
        _format_array(name, np.asarray(values)[body_of_loop]) for name, values in data.items()
    ]
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
            f'<PolyData><Piece NumberOfPoints="{starts[-1]}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0"',
            f' NumberOfPolys="{len(loops)}">',
            "<Points>",
            _format_array(
                "Points", np.concatenate([np.zeros((0, 3)), *(vertices for vertices, _ in bodies)])
            ),
            "</Points>",
            "<Polys>",
            _format_array("connectivity", np.concatenate([np.zeros(0, int), *loops])),
            _format_array("offsets", np.cumsum([len(loop) for loop in loops])),
            "</Polys>",
            "<CellData>",
            *cell_data,
            "</CellData>",
            "</Piece></PolyData></VTKFile>\n",
        ]
    )


def _format_array(name: str, array: ArrayLike) -> str:
    """A DataArray element: base64 of its length in bytes and its little-endian values."""
    array = np.asarray(array)
    array = np.ascontiguousarray(array, "<f8" if array.dtype.kind == "f" else "<i8")
    content = np.array(array.nbytes, "<u8").tobytes() + array.tobytes()
    components = array.shape[1] if array.ndim == 2 else 1
    head = f'type="{VTK_TYPES[array.dtype.kind]}" Name="{name}" NumberOfComponents="{components}" format="binary"'
    return f"<DataArray {head}>{base64.b64encode(content).decode()}</DataArray>"


def _write_collection(path: Path, times: np.ndarray, files: Sequence[str]) -> Path:
    entries = [
        f'<DataSet timestep="{float(t)!r}" part="0" file="{name}"/>'
        for t, name in zip(times, files, strict=True)
    ]
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="1.0" byte_order="LittleEndian"><Collection>'
    return write_atomically(path, "\n".join([head, *entries, "</Collection></VTKFile>\n"]).encode())
