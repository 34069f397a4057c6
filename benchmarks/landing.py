"""Spheres that land, by ourselves and in LIGGGHTS, an oracle that nobody here wrote: ``python -m
benchmarks.landing``.

Both have the same law, stiffnesses, step and start (``edinburgh/stiffness`` without adhesion is
Walton and Braun's spring, its tangential history the Coulomb-limited one), in double precision, and
are compared step by step, without what we add where the force has corners. Exits with 1 if they
part by more than is allowed; without LIGGGHTS there is nothing to compare with, and no table.
"""

import argparse
import re
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.box import open_box
from benchmarks.peers.liggghts import setting, version, walls
from benchmarks.peers.packing import GRAVITY
from dem_jax import assembly, load_scene, simulate, xla_flags
from dem_jax.assembly.contact_law import build_contact_law
from dem_jax.assembly.time_step import list_possible_contacts
from dem_jax.contact_laws import ContactKinematics, Response
from dem_jax.contact_laws.walton_braun import WaltonBraun, WaltonBraunHistory, WaltonBraunPair
from dem_jax.types import pytree

RADIUS, DENSITY = 0.01, 300.0  # m, kg/m3
STEP, EVERY = 4e-6, 5  # s; steps between two that are compared
SEPARATION = 1e-6  # lambda: LIGGGHTS's unloading line goes down to nothing
TANGENTIAL = 1.0  # K_t / K_n, as LIGGGHTS has it (and we, unless told otherwise)
WORDS = ["liggghts", "-log", "none"]


@pytree
class Uncorrected(WaltonBraun):
    """Eqs 1-4 at steps alone."""

    def force(
        self, pair: WaltonBraunPair, history: WaltonBraunHistory, contact: ContactKinematics
    ) -> Response:
        """As of a step that is too coarse for more."""
        return super().force(pair, history, contact._replace(resolved=0.0))


@dataclass(frozen=True)
class Landing:
    """Spheres above the floor of an open box, which fall and land."""

    position: np.ndarray  # [N, 3] (m)
    velocity: np.ndarray  # [N, 3] (m/s)
    half_width: float  # m, of the box
    height: float  # m, of the box
    restitution: float
    friction: float = 0.0
    duration: float = 0.01  # s


@dataclass(frozen=True)
class Trace:
    """What both are asked for, after each EVERY steps."""

    floor: np.ndarray  # [T] (N): force on the floor, downwards
    position: np.ndarray  # [N, 3] (m), at the end
    velocity: np.ndarray  # [N, 3] (m/s), at the end


@dataclass(frozen=True)
class Apart:
    """How far the two are from each other."""

    whole: float  # largest difference of the force on the floor, over the largest force
    early: float  # until a time
    impulse: float  # of the force, relative
    rms_places: float  # m, at the end


def single(restitution: float, sideways: float = 0.0, friction: float = 0.0) -> Landing:
    """One sphere that reaches the floor at 1 m/s."""
    return Landing(
        np.array([[0.0, 0.0, RADIUS + 1e-3]]),
        np.array([[sideways, 0.0, -1.0]]),
        0.1,
        0.2,
        restitution,
        friction,
    )


def pair(restitution: float, friction: float = 0.0) -> Landing:
    """One sphere that falls, off the centre, onto one that lies a little above the floor."""
    position = np.array([[0.0, 0.0, RADIUS + 1e-4], [0.4 * RADIUS, 0.0, 3 * RADIUS]])
    return Landing(
        position, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), 0.1, 0.2, restitution, friction
    )


def drop(side: int, restitution: float, friction: float, duration: float) -> Landing:
    """side ** 3 spheres of a loose lattice, a little out of place, that fall by 5 cm into a box."""
    pitch, random = 2.3 * RADIUS, np.random.default_rng(0)
    index = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    half, jitter = 0.5 * side * pitch, random.uniform(-1, 1, (side**3, 3)) * 0.14 * RADIUS
    position = (index + 0.5) * pitch - [half, half, -0.05] + jitter
    return Landing(
        position,
        np.zeros((side**3, 3)),
        half,
        0.05 + 3 * side * pitch,
        restitution,
        friction,
        duration,
    )


def ours(landing: Landing) -> tuple[Trace, tuple[float, float]]:
    """Ourselves in double precision, and the stiffnesses (N/m) against a wall and between pieces."""
    corners = open_box(landing.half_width, landing.half_width, landing.height)
    rows = zip(landing.position.tolist(), landing.velocity.tolist(), strict=True)
    scene = load_scene("plate-drop").replace(
        name="landing",
        piece=[
            {"shape": "sphere", "radius": RADIUS, "position": tuple(x), "velocity": tuple(v)}
            for x, v in rows
        ],
        wall=[
            {"group": "floor" if n == 0 else "sides", "corners": c, "thickness": 0.02}
            for n, c in enumerate(corners)
        ],
        region=[],
        material={"density": DENSITY, "restitution": landing.restitution}
        | {"friction_wall": landing.friction, "friction_piece": landing.friction}
        | {"separation_slope_ratio": SEPARATION, "tangential_stiffness_ratio": TANGENTIAL},
        run={
            "precision": "f64",
            "time_step": STEP,
            "sample_interval": EVERY * STEP,
            "duration": landing.duration,
            "frame_interval": landing.duration,
        }
        | {"gravity": (0.0, 0.0, -GRAVITY), "domain_high": (1.0, 1.0, 1.0)},
    )
    law = Uncorrected(**vars(build_contact_law(scene)))
    built = assembly.assemble_system(scene, law=law)
    found = list_possible_contacts(
        built.system.law, built.system.materials, built.shapes, built.system.pieces
    )
    stiffness = [float(np.ravel(one.pair.stiffness)[0]) for one in found]
    run = simulate(scene, law=law)
    last = run.pieces
    return Trace(-run.force["floor"][:, 2], last.position[-1], last.velocity[-1]), (
        stiffness[0],
        stiffness[-1],
    )


def liggghts(landing: Landing, stiffness: tuple[float, float], folder: Path) -> Trace:
    """LIGGGHTS, with stiffnesses (N/m) against a wall and between pieces."""
    steps = EVERY * round(landing.duration / (EVERY * STEP))
    x, z = landing.half_width, landing.height
    atoms = []
    for n, (at, v) in enumerate(
        zip(landing.position.tolist(), landing.velocity.tolist(), strict=True), 1
    ):
        atoms.append("create_atoms 1 single {} {} {} units box".format(*at))
        atoms.append(
            f"set atom {n} diameter {2 * RADIUS} density {DENSITY} "
            + "vx {} vy {} vz {}".format(*v)
        )
    domain = (
        f"region box block {-x - 0.02} {x + 0.02} {-x - 0.02} {x + 0.02} -0.02 {z + 0.02} units box"
    )
    lines = [
        *setting(
            stiffness[::-1],
            landing.restitution,
            2 * (landing.friction,),
            [domain, "create_box 2 box"],
        ),
        f"timestep {STEP}",
        *walls(x, "store_force yes "),
        *atoms,
        "fix motion all nve/sphere",
        "compute floor all reduce sum f_force_zplane0[3]",
        f"dump last all custom {steps} last.txt id x y z vx vy vz",
        'dump_modify last format "%d %.15g %.15g %.15g %.15g %.15g %.15g"',
        f"thermo {EVERY}",
        "thermo_style custom step c_floor",
        "thermo_modify lost error norm no format float %.15g",
        f"run {steps}",
        "",
    ]
    (folder / "script").write_text("\n".join(lines))
    done = subprocess.run(
        [*WORDS, "-in", "script"], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode or "ERROR" in done.stdout:
        raise RuntimeError("\n".join(done.stdout.splitlines()[-20:]) + done.stderr)
    table = re.search(r"^ *Step .*\n((?: *\d.*\n)+)Loop time", done.stdout, re.MULTILINE)
    assert table, done.stdout
    rows = np.array([line.split() for line in table[1].splitlines()], float)
    last = (folder / "last.txt").read_text().rpartition("ITEM: ATOMS")[2].splitlines()[1:]
    atoms_at_end = np.array(sorted([float(w) for w in line.split()] for line in last))
    return Trace(rows[1:, 1], atoms_at_end[:, 1:4], atoms_at_end[:, 4:7])


def apart(landing: Landing, folder: Path, until: float) -> Apart:
    """Both, compared; until: (s) up to where collisions have not amplified what rounding leaves."""
    one, stiffness = ours(landing)
    two = liggghts(landing, stiffness, folder)
    difference, largest = np.abs(one.floor - two.floor), two.floor.max()
    early = difference[: round(until / (EVERY * STEP))].max()
    places = np.sqrt(np.mean(np.sum((one.position - two.position) ** 2, axis=1)))
    impulse = abs(one.floor.sum() / two.floor.sum() - 1)
    return Apart(
        float(difference.max() / largest), float(early / largest), float(impulse), float(places)
    )


CASES = {  # name -> landing, until when the traces are compared (s), and the difference allowed
    # until then
    "a sphere on the floor, restitution 0.1": (single(0.1), 0.01, 1e-5),
    "a sphere on the floor, restitution 0.5": (single(0.5), 0.01, 1e-5),
    "a sphere on the floor, restitution 1": (single(1.0), 0.01, 1e-5),
    "a sphere on the floor at an angle, friction 0.3": (single(0.5, 0.5, 0.3), 0.01, 1e-5),
    "a sphere on another, on the floor": (pair(0.5), 0.01, 1e-4),
    "a sphere on another, on the floor, friction 0.4": (pair(0.3, 0.4), 0.01, 5e-4),
    "64 spheres, restitution 0.5, no friction": (drop(4, 0.5, 0.0, 0.3), 0.12, 1e-2),
    "64 spheres, restitution 0.5, friction 0.3": (drop(4, 0.5, 0.3, 0.3), 0.12, 1e-2),
    "64 spheres, restitution 0.1, friction 0.3": (drop(4, 0.1, 0.3, 0.3), 0.12, 1e-2),
}
IMPULSE = 0.01  # allowed, of all


def main(argv: Sequence[str] | None = None) -> int:
    """Compare all cases, write the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.landing", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="single contacts only")
    options = parser.parse_args(argv)
    name = version()
    if name is None:
        print("LIGGGHTS is not found: `liggghts` is to be on the PATH (a package of Debian)")
        return 0
    xla_flags.set_loop_flags()
    rows, good = [], True
    for words, (landing, until, allowed) in CASES.items():
        if options.quick and len(landing.position) > 2:
            continue
        with tempfile.TemporaryDirectory() as folder:
            found = apart(landing, Path(folder), until)
        good &= found.early <= allowed and found.impulse <= IMPULSE
        numbers = (found.early, allowed, found.whole, found.impulse, 1e3 * found.rms_places)
        rows.append([words, f"{landing.duration:g}", f"{until:g}", *(f"{x:.2g}" for x in numbers)])
        print(*rows[-1], sep=" | ", flush=True)
    head = [
        "case",
        "lasts (s)",
        "until (s)",
        "apart until then",
        "allowed",
        "in all",
        "impulse",
        "places at the end (mm, rms)",
    ]
    text = f"""# Beside LIGGGHTS {name}

{report.environment()}

Spheres of radius {1e3 * RADIUS:g} mm that land in an open box, by ourselves and with LIGGGHTS's `edinburgh/stiffness` and
tangential history: the same stiffnesses, a step of {1e6 * STEP:g} us, double precision. The largest difference of the force on the
floor, over the largest force; of drops until collisions have amplified what little the integrators differ by, and in all.

{report.table(head, rows)}
"""
    report.write("landing", text, options.quick)
    return int(not good)


if __name__ == "__main__":
    raise SystemExit(main())
