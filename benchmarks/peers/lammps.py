"""LAMMPS: spheres with a dashpot (``gran/hooke/history``) and the exact piece as a rounded
polyhedron.
"""

import itertools
import shutil
import subprocess

import numpy as np

from benchmarks.peers import packing as p
from benchmarks.peers.child import Child
from dem_jax.math.pose import quaternion_to_matrix

SKIN = 0.002  # m
ROUND = 1e-3  # m: diameter of the rounding; the corners are drawn in by half of it
DAMPING = 100.0  # 1/s, of the spheres' dashpot: no matter for the time that a step takes


def version():
    """That of the program, or None if it is not found."""
    if not shutil.which("lmp"):
        return None
    done = subprocess.run(
        ["lmp", "-h"], capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    line = next((x for x in done.stdout.splitlines() if "Simulator" in x), "")
    return line.rpartition("Simulator - ")[2] or "of unknown version"


def _head(style, newton):
    return [
        "units si",
        f"atom_style {style}",
        "boundary f f f",
        "comm_modify mode single vel yes",
        f"newton {newton}",
    ]


def _tail(box: p.Packing, wall):
    """Walls, gravity, output."""
    x, top = 0.5 * box.width, box.height + 0.1
    planes = {"xplane": (-x, x), "yplane": (-x, x), "zplane": (0.0, top)}
    return [
        f"neighbor {SKIN} bin",
        "neigh_modify delay 0 every 1 check yes",
        f"timestep {p.STEP}",
        *(f"fix {kind} all {wall} {kind} {low} {high}" for kind, (low, high) in planes.items()),
        f"fix weight all gravity {p.GRAVITY} vector 0 0 -1",
        "thermo 100000000",
        "thermo_modify lost error",
        "",
    ]


def _limits(box: p.Packing):
    """The lines of a data file with the ends of LAMMPS's own box."""
    x = 0.5 * box.width + 0.05
    return [f"{-x} {x} xlo xhi", f"{-x} {x} ylo yhi", f"{-0.05} {box.height + 0.2} zlo zhi"]


def _started(lines, folder):
    return Child(["stdbuf", "-oL", "lmp", "-log", "none"], "\n".join(lines), folder)


def spheres(path, folder):
    """Spheres at the poses of a packing."""
    box = p.load(path)
    (folder / "spheres.data").write_text(sphere_data(box, 1))
    law = f"{p.PAIR} {p.PAIR} {DAMPING} {0.5 * DAMPING}"
    wall = f"{p.WALL} {p.WALL} {DAMPING} {0.5 * DAMPING} {p.WALL_FRICTION} 1"
    return _started(
        [
            *_head("sphere", "off"),
            "read_data spheres.data",
            f"pair_style gran/hooke/history {law} {p.FRICTION} 1",
            "pair_coeff * *",
            "fix motion all nve/sphere",
            *_tail(box, f"wall/gran hooke/history {wall}"),
        ],
        folder,
    )


def bodies(path, folder):
    """Pieces at the poses of a packing."""
    box = p.load(path)
    (folder / "bodies.data").write_text(body_data(box))
    damping = "0.01 0.01"  # N s/m
    return _started(
        [
            *_head("body rounded/polyhedron 1 32", "on"),
            "read_data bodies.data",
            f"pair_style body/rounded/polyhedron {damping} {p.FRICTION} 1 {0.1 * ROUND}",
            f"pair_coeff * * {p.PAIR} 0",
            "fix motion all nve/body",
            *_tail(box, f"wall/body/polyhedron {p.WALL} {damping}"),
        ],
        folder,
    )


def faces(corners):
    """Edges [24, 2] and faces of at most four corners (the octagons in three parts) of the piece,
    as LAMMPS has them.
    """
    ring = sorted(
        range(len(corners)), key=lambda i: (corners[i, 2], np.arctan2(corners[i, 1], corners[i, 0]))
    )
    low, high = ring[:8], ring[8:]
    around = [(k, (k + 1) % 8) for k in range(8)]
    edges = [(level[a], level[b]) for level in (low, high) for a, b in around] + list(
        zip(low, high, strict=True)
    )
    sides = [(low[a], low[b], high[b], high[a]) for a, b in around]
    ends = [
        tuple(level[k] for k in part)
        for level in (low, high)
        for part in ((0, 1, 2, 3), (0, 3, 4, 7), (4, 5, 6, 7))
    ]
    return edges, sides + ends


def body_data(box: p.Packing) -> str:
    """A data file with the bodies of a packing."""
    local = p.vertices()
    local = local - np.sign(local) * 0.5 * ROUND
    edges, sides = faces(local)
    links = itertools.chain(edges, sides)
    tail = [f"{x}" for row in links for x in row] + [f"{ROUND}"]
    atoms, shapes = [], []
    for n, (x, turn) in enumerate(
        zip(box.position, quaternion_to_matrix(box.orientation), strict=True), 1
    ):
        atoms.append(f"{n} 1 1 {p.MASS} {x[0]:.9g} {x[1]:.9g} {x[2]:.9g}")
        inertia = turn @ np.diag(p.INERTIA) @ turn.T
        moments = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        values = [f"{v:.12g}" for v in (*moments, *(local @ turn.T).ravel())] + tail
        shapes += [f"{n} 3 {len(values)}", f"{len(local)} {len(edges)} {len(sides)}"]
        # it takes 32 lines at most
        shapes += [" ".join(values[k : k + 12]) for k in range(0, len(values), 12)]
    head = [
        "packed pieces",
        "",
        f"{box.count} atoms",
        f"{box.count} bodies",
        "1 atom types",
        *_limits(box),
    ]
    return "\n".join([*head, "", "Atoms", "", *atoms, "", "Bodies", "", *shapes, ""])


def sphere_data(box: p.Packing, types) -> str:
    """A data file with the spheres of a packing, for LIGGGHTS too; types: number of kinds of atoms
    that it makes room for.
    """
    head = ["packed spheres", "", f"{box.count} atoms", f"{types} atom types", *_limits(box)]
    rows = [
        f"{n} 1 {2 * p.RADIUS:.9g} {p.DENSITY} {x:.9g} {y:.9g} {z:.9g}"
        for n, (x, y, z) in enumerate(box.position, 1)
    ]
    return "\n".join([*head, "", "Atoms", "", *rows, ""])
