"""LIGGGHTS: spheres and clumps of eight spheres with the hysteretic spring ``edinburgh/stiffness``."""

import itertools
import shutil
import subprocess

from benchmarks.peers import packing as p
from benchmarks.peers.child import Child
from benchmarks.peers.lammps import sphere_data

MODEL = "model edinburgh/stiffness tangential history"
OPTIONS = "fixKc on limitForce on"  # with no adhesion: loading K, unloading K / eps2, never
# attractive
CLUMP = [
    (x, y, 0.0, 0.008)
    for x, y in itertools.product((-0.0195, -0.0065, 0.0065, 0.0195), (-0.0035, 0.0035))
]
SKIN = 0.002  # m; 1 and 4 mm cost the same within 10 %


def version():
    """That of the program, or None if it is not found."""
    if not shutil.which("liggghts"):
        return None
    words = ["liggghts", "-log", "none"]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    return done.stdout.partition("LIGGGHTS-PUBLIC ")[2].split(",")[0] or "of unknown version"


def setting(loading, restitution, friction, domain):
    """Units, domain, contact law, gravity. loading: stiffness (N/m), friction: both between pieces
    and on a wall; domain: the lines that make LIGGGHTS's own box.
    """
    pairs = lambda a, b: f"peratomtypepair 2 {a} {b} {b} {b}"
    properties = {
        "LoadingStiffness": pairs(*loading),
        "UnloadingStiffness": pairs(restitution**-2, restitution**-2),  # relative to that of
        # loading
        "coefficientAdhesionStiffness": pairs(0, 0),
        "coefficientRestitution": pairs(1, 1),  # of the dashpot: none
        "coefficientFriction": pairs(*friction),
        "pullOffForce": pairs(0, 0),
        "surfaceEnergy": pairs(0, 0),
        "overlapExponent": "scalar 1",
        "adhesionExponent": "scalar 1",
    }
    return [
        "atom_style granular",
        "atom_modify map array",
        "boundary f f f",
        "newton off",
        "communicate single vel yes",
        "units si",
        *domain,
        f"neighbor {SKIN} bin",
        "neigh_modify delay 0",
        *(
            f"fix p{n} all property/global {name} {value}"
            for n, (name, value) in enumerate(properties.items())
        ),
        f"pair_style gran {MODEL} {OPTIONS}",
        "pair_coeff * *",
        f"fix weight all gravity {p.GRAVITY} vector 0 0 -1",
    ]


def walls(half_width, options=""):
    """Floor and sides of the open box; half_width: (m)."""
    planes = {
        "zplane": (0.0,),
        "xplane": (-half_width, half_width),
        "yplane": (-half_width, half_width),
    }
    return [
        f"fix {kind}{n} all wall/gran {MODEL} primitive type 2 {kind} {place} {options}{OPTIONS}"
        for kind, places in planes.items()
        for n, place in enumerate(places)
    ]


def _head(box: p.Packing, domain):
    """Box, walls, contact law, gravity; domain: as of ``setting``."""
    lines = setting((p.PAIR, p.WALL), p.RESTITUTION, (p.FRICTION, p.WALL_FRICTION), domain)
    return [*lines, f"timestep {p.STEP}", *walls(0.5 * box.width)]


def _tail():
    return [
        "thermo_style custom step atoms ke",
        "thermo 100000000",
        "thermo_modify lost error norm no flush yes",
    ]


def _started(lines, folder):
    command = ["stdbuf", "-oL", "liggghts", "-log", "none"]
    return Child(command, "\n".join([*lines, *_tail(), ""]), folder)


def spheres(path, folder):
    """Spheres at the poses of a packing."""
    box = p.load(path)
    (folder / "spheres.data").write_text(sphere_data(box, 2))
    return _started([*_head(box, ["read_data spheres.data"]), "fix motion all nve/sphere"], folder)


def clumps(path, folder):
    """Clumps scattered in the box, as LIGGGHTS places them itself: they are still to settle."""
    box = p.load(path)
    # A sixth of the space filled: so much its random insertion reaches. The column stands a little
    # off the walls.
    x, height = 0.5 * box.width - 0.002, 6 * box.count * p.MASS / p.DENSITY / box.width**2 + 0.06
    (folder / "clump.txt").write_text("".join(f"{x} {y} {z} {r}\n" for x, y, z, r in CLUMP))
    inertia = f"{p.INERTIA[0]} 0 0 {p.INERTIA[1]} 0 {p.INERTIA[2]}"
    ends = f"{-x - 0.05} {x + 0.05}"
    domain = [f"region box block {ends} {ends} -0.05 {height + 0.1} units box", "create_box 2 box"]
    lines = _head(box, domain) + [
        "fix motion all multisphere",
        "fix shape all particletemplate/multisphere 15485863 atom_type 1 density constant 300 nspheres 8 ntry 200000 "
        f"spheres file clump.txt scale 1 mass {p.MASS} inertia_tensor {inertia} use_density type 1",
        "fix mix all particledistribution/discrete 15485867 1 shape 1.0",
        f"region fill block {-x} {x} {-x} {x} 0 {height} units box",
        "fix insertion all insert/pack seed 32452843 distributiontemplate mix vel constant 0 0 0 insert_every once "
        f"overlapcheck yes all_in yes orientation random particles_in_region {box.count} ntry_mc 10000 region fill",
    ]
    child = _started(lines, folder)
    child.run(1)
    return child
