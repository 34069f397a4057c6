"""MuJoCo: the exact piece as a mesh, rigid contact, Newton's solver, steps of 1 ms.

``python -m benchmarks.peers.mujoco FILE`` serves a packing: run so in the interpreter that has the
package.
"""

import subprocess
import sys

from benchmarks.peers import packing as p
from benchmarks.peers.child import Child, serve

STEP = 1e-3  # s: as its contact is rigid, it takes much longer steps


def version(python):
    """That of the package in an interpreter, or None."""
    words = [python, "-c", "import mujoco; print(mujoco.__version__)"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


def model(box: p.Packing) -> str:
    """The scene in MuJoCo's own XML."""
    points = " ".join(f"{x:.9g}" for x in p.vertices().ravel())
    x = 0.5 * box.width
    planes = (
        (0, 0, 0, 0, 0, 1),
        (-x, 0, 0, 1, 0, 0),
        (x, 0, 0, -1, 0, 0),
        (0, -x, 0, 0, 1, 0),
        (0, x, 0, 0, -1, 0),
    )
    walls = [
        f'<geom type="plane" size="0 0 1" pos="{a} {b} {c}" zaxis="{u} {v} {w}" friction="{p.WALL_FRICTION}" priority="1"/>'
        for a, b, c, u, v, w in planes
    ]
    words = lambda row: " ".join(f"{value:.9g}" for value in row)
    moments = words(p.INERTIA)
    bodies = [
        f'<body pos="{words(position)}" quat="{words(turn)}"><freejoint/><inertial pos="0 0 0" mass="{p.MASS}" '
        f'diaginertia="{moments}"/><geom type="mesh" mesh="piece"/></body>'
        for position, turn in zip(box.position, box.orientation, strict=True)
    ]
    return f"""<mujoco>
<option timestep="{STEP}" solver="Newton" gravity="0 0 {-p.GRAVITY}"/>
<default><geom friction="{p.FRICTION}"/></default>
<asset><mesh name="piece" vertex="{points}"/></asset>
<worldbody>{"".join(walls)}{"".join(bodies)}</worldbody>
</mujoco>"""


def meshes(path, _, python):
    """A child that serves a packing."""
    return Child([python, "-m", "benchmarks.peers.mujoco", str(path)])


if __name__ == "__main__":
    import mujoco

    made = mujoco.MjModel.from_xml_string(model(p.load(sys.argv[1])))
    data = mujoco.MjData(made)
    serve(lambda steps: mujoco.mj_step(made, data, steps))
