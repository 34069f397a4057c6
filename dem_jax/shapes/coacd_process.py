"""CoACD in a process of its own, which can be ended: ``python coacd_process.py MESH.npz
PARTS.npz``. Imports nothing of dem_jax.
"""

import json
import sys

import coacd
import numpy as np


def main(source: str, target: str) -> None:
    """Read vertices, faces and settings, write the corners of each convex part."""
    with np.load(source) as given:
        mesh = coacd.Mesh(given["vertices"], given["faces"])
        settings = json.loads(str(given["settings"]))
    coacd.set_log_level("error")
    parts = coacd.run_coacd(mesh, **settings)
    corners = {
        f"part_{k}": np.asarray(vertices, np.float64) for k, (vertices, _) in enumerate(parts)
    }
    np.savez(target, **corners)  # type: ignore[arg-type]  # numpy's own names are not among the keys


if __name__ == "__main__":
    main(*sys.argv[1:])
