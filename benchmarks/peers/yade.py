"""YADE: the exact piece as one of its polyhedra, force by the volume of the overlap.

YADE runs this file itself (``yade -n -x yade.py PACKING``).
"""

import shutil
import subprocess
import sys


def version():
    """That of the program, or None if it is not found."""
    if not shutil.which("yade"):
        return None
    done = subprocess.run(["yade", "--version"], capture_output=True, text=True, check=False)
    return done.stdout.strip().removeprefix("Yade version: ").split()[0]


def polyhedra(path, _):
    """A child that serves a packing."""
    from benchmarks.peers.child import Child

    return Child(["yade", "-n", "-x", "-j1", __file__, str(path)])


def build(box, p):
    """Bodies, walls and engines of a packing in YADE's own scene."""
    from math import atan

    from yade import Vector3, polyhedra_utils, utils
    from yade.wrapper import (
        Bo1_Polyhedra_Aabb,
        Bo1_Wall_Aabb,
        ForceResetter,
        Ig2_Polyhedra_Polyhedra_PolyhedraGeom,
        Ig2_Wall_Polyhedra_PolyhedraGeom,
        InsertionSortCollider,
        InteractionLoop,
        Ip2_PolyhedraMat_PolyhedraMat_PolyhedraPhys,
        Law2_PolyhedraGeom_PolyhedraPhys_Volumetric,
        NewtonIntegrator,
        Omega,
        PolyhedraMat,
    )

    from dem_jax.math.pose import quaternion_to_matrix

    scene = Omega()
    # Force = young * volume of the overlap: as stiff as ours for two faces of 10 cm2.
    material = PolyhedraMat(
        density=p.DENSITY, young=p.PAIR / 1e-3, poisson=0.2, frictionAngle=atan(p.FRICTION)
    )
    half = 0.5 * box.width
    for axis, place, sense in (
        (2, 0.0, 1),
        (0, -half, 1),
        (0, half, -1),
        (1, -half, 1),
        (1, half, -1),
    ):
        scene.bodies.append(utils.wall(place, axis=axis, sense=sense, material=material))
    corners = p.vertices() if box.corners is None else box.corners
    for position, turn in zip(box.position, quaternion_to_matrix(box.orientation)):  # noqa: B905  (YADE's own, older Python)
        points = [Vector3(*map(float, v)) for v in corners @ turn.T + position]
        scene.bodies.append(polyhedra_utils.polyhedra(material, v=points))
    scene.engines = [
        ForceResetter(),
        InsertionSortCollider([Bo1_Polyhedra_Aabb(), Bo1_Wall_Aabb()]),
        InteractionLoop(
            [Ig2_Wall_Polyhedra_PolyhedraGeom(), Ig2_Polyhedra_Polyhedra_PolyhedraGeom()],
            [Ip2_PolyhedraMat_PolyhedraMat_PolyhedraPhys()],
            [Law2_PolyhedraGeom_PolyhedraPhys_Volumetric()],
        ),
        NewtonIntegrator(damping=0.2, gravity=(0, 0, -p.GRAVITY)),
    ]
    scene.dt = p.STEP
    return scene


if __name__ == "__main__":
    sys.path.insert(0, __file__.rpartition("/benchmarks/")[0] or ".")
    from benchmarks.peers import child, packing

    made = build(packing.load(sys.argv[-1]), packing)
    child.serve(lambda steps: made.run(steps, True))
