"""Convex parts of a closed surface, by CoACD in a process of its own: within a time, with progress
on stderr.
"""

import json
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.hull_simplification import simplify_hull

if TYPE_CHECKING:
    import trimesh

LONGEST_TIME = 120.0  # s that a decomposition may take
CORNERS, FEWEST, MOST = 256, 16, 32  # of all parts together and of a part: compiling and every step
# take the longer, the more
FACETS_PER_PART = 40  # of the surface that is cut; one of more is thinned out first
COACD_OPTIONS = {  # a search of a third of its default length cuts as well (measured on knots and
    # kidneys) and takes seconds
    "preprocess_mode": "off",
    "mcts_iterations": 60,
    "mcts_nodes": 10,
    "resolution": 1000,
    "seed": 0,
}
SHOWN_AFTER = 2.0  # s, from which on progress is shown


def cut_into_convex_parts(
    mesh: "trimesh.Trimesh", concavity: float, most: int, corners: int | None, name: str
) -> tuple[np.ndarray, ...]:
    """Corners [P, 3] of each convex part in the units of the mesh, the same each time.

    A surface of many facets is thinned out first (quadric decimation), and parts of many corners
    are simplified.

    Args:
        mesh: closed, facets seen from outside.
        concavity: CoACD's threshold, as fraction of the size.
        most: largest number of parts.
        corners: largest number of corners of a part; None: CORNERS of all parts together, but
            FEWEST to MOST in each.
        name: of the file, for messages.

    Raises:
        SceneError: where CoACD is not installed, fails, or takes longer than LONGEST_TIME.
    """
    if any(not _is_installed(needed) for needed in ("coacd", "rtree", "fast_simplification")):
        raise SceneError(
            'shape = "decomposed" needs CoACD: pip install "product-impact[decompose]"; or list convex parts: shape = "compound"'
        )
    thin = _decimate_mesh(mesh, FACETS_PER_PART * most)
    size, middle = float(thin.extents.max()), thin.bounds.mean(axis=0)
    settings = {**COACD_OPTIONS, "threshold": concavity, "max_convex_hull": most}
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "mesh.npz", Path(folder) / "parts.npz"
        vertices = (np.asarray(thin.vertices) - middle) / size
        np.savez(
            source, vertices=vertices, faces=np.asarray(thin.faces), settings=json.dumps(settings)
        )
        _run_coacd(source, target, name)
        with np.load(target) as found:
            parts = [middle + size * found[f"part_{k}"] for k in range(len(found.files))]
    corners = corners or min(MOST, max(FEWEST, CORNERS // len(parts)))
    return tuple(
        part if len(part) <= corners else simplify_hull(part, corners).points for part in parts
    )


def _is_installed(module: str) -> bool:
    return sys.modules.get(module, True) is not None and find_spec(module) is not None


def _decimate_mesh(mesh: "trimesh.Trimesh", most: int) -> "trimesh.Trimesh":
    """The mesh with at most ``most`` facets, if it stays closed; else the mesh itself."""
    if len(mesh.faces) <= most:
        return mesh
    thin = mesh.simplify_quadric_decimation(face_count=most)
    return thin if thin.is_volume else mesh


def _run_coacd(source: Path, target: Path, name: str) -> None:
    """Let CoACD cut the source into the target. Raises SceneError if it fails, or takes longer than
    LONGEST_TIME.
    """
    command = [
        sys.executable,
        "-P",
        str(Path(__file__).with_name("coacd_process.py")),
        str(source),
        str(target),
    ]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        try:
            ended = _wait_for_process(process, name)
        finally:
            process.kill()
        assert process.stderr is not None
        said = process.stderr.read().decode(errors="replace").strip()
    if not ended:
        raise SceneError(
            f"stl = {name!r} was not cut into convex parts within {LONGEST_TIME:g} s; allowed: a coarser mesh, a larger concavity, or "
            'convex parts listed one by one: shape = "compound"'
        )
    if process.returncode or not target.is_file():
        last = (said.splitlines() or [f"exit code {process.returncode}"])[-1]
        raise SceneError(
            f"stl = {name!r} cannot be cut into convex parts: CoACD fails ({last}); allowed: another mesh"
        )


def _wait_for_process(process: "subprocess.Popen[bytes]", name: str) -> bool:
    """Whether a process ends within LONGEST_TIME, with its time on stderr."""
    from tqdm import tqdm

    words = f"cutting {Path(name).name} into convex parts: {{elapsed}}, at most {LONGEST_TIME:g} s; kept for the next time"
    start = time.monotonic()
    with tqdm(bar_format=words, file=sys.stderr, delay=SHOWN_AFTER, leave=False) as bar:
        while (past := time.monotonic() - start) < LONGEST_TIME:
            try:
                process.wait(0.1 if past < SHOWN_AFTER else 1.0)
                return True
            except subprocess.TimeoutExpired:
                if past > SHOWN_AFTER:
                    bar.refresh()
    return False
