"""The same scene turned, moved, mirrored or with its pieces in another order is the same motion."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly
from dem_jax.broad_phase import overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.scene import Scene

PIECES = (
    ((-0.02, 0.01, 0.030), (1.0, 0.3, 0.2, 0.1), (0.2, 0.1, -1.0), (5.0, -3.0, 2.0)),
    ((0.025, -0.012, 0.035), (1.0, -0.2, 0.1, 0.7), (0.9, 0.0, -1.0), (-4.0, 1.0, 3.0)),
    ((0.0, 0.02, 0.085), (0.3, 1.0, -0.5, 0.2), (-0.1, -0.1, -3.0), (0.0, 6.0, -2.0)),
    ((-0.01, -0.015, 0.14), (0.5, 0.1, 0.9, 0.2), (0.1, 0.1, -5.0), (2.0, 2.0, 2.0)),
)
FLOOR = np.array([(-0.2, -0.15, 0.0), (0.2, -0.15, 0.0), (0.2, 0.15, 0.0), (-0.2, 0.15, 0.0)])
SIDE = np.array([(0.06, 0.15, -0.02), (0.06, -0.15, -0.02), (0.06, -0.15, 0.2), (0.06, 0.15, 0.2)])
GRAVITY = np.array([0.0, 0.0, -9.81])
SAMPLES = 250  # of 0.1 ms: several collisions of pieces with each other and with both walls
SAME, MIRROR = np.eye(3), np.diag([1.0, -1.0, 1.0])


def scene(turn=SAME, shift=(0.0, 0.0, 0.0), order=range(4)):
    """The scene turned by a matrix (a reflection mirrors it) and shifted; pieces in an order."""
    hand = np.linalg.det(turn)
    rows = []
    for position, orientation, velocity, spin in (PIECES[k] for k in order):
        body = Rotation.from_quat(orientation, scalar_first=True).as_matrix()
        # a marshmallow is its own mirror image, so that a reflected one is a turned one
        turned = Rotation.from_matrix(turn @ body @ (np.eye(3) if hand > 0 else MIRROR)).as_quat(
            scalar_first=True
        )
        rows.append(
            {
                "position": (turn @ np.array(position) + shift).tolist(),
                "orientation": turned.tolist(),
                "velocity": (turn @ np.array(velocity)).tolist(),
                "angular_velocity": (hand * turn @ np.array(spin)).tolist(),
            }
        )
    walls = []
    for group, corners in (("floor", FLOOR), ("side", SIDE)):
        moved = corners @ turn.T + shift
        walls.append({"group": group, "corners": (moved if hand > 0 else moved[::-1]).tolist()})
    settings = {
        "precision": "f64",
        "sample_interval": 1e-4,
        "frame_interval": 0.0,
        "gravity": (turn @ GRAVITY).tolist(),
    }
    return Scene(piece=rows, wall=walls, run=settings)


def run(of):
    """The last state, the samples, and how often two pieces were seen in touch."""
    made = assembly.assemble_system(of, 0)
    system = made.system.replace(skin=made.system.skin * 0 + 0.01)
    state, samples, touches = made.state, [], 0
    for _ in range(SAMPLES // 10):
        state, recorded, _ = stepping.run_compiled_chunk(
            system, state, np.int32(10), np.int32(1), samples=1024, frames=0
        )
        samples.append(jax.tree.map(lambda x: np.asarray(x)[:10], recorded))
        table = jax.device_get(state.contacts["hulls"])
        touches += int(
            ((table.a >= 0) & (table.a < len(PIECES)) & (table.memory.law.force > 0)).sum()
        )
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    return jax.device_get(state), jax.tree.map(lambda *x: np.concatenate(x), *samples), touches


@pytest.fixture(scope="module")
def plain():
    state, recorded, touches = run(scene())
    peaks = np.abs(recorded.force).max((0, 1))
    assert peaks.min() > 1.0  # both walls are hit
    assert touches > 2
    return state, recorded, touches


# Contacts multiply rounding (1e-16 of 0.1 m) by K_nu and the collisions by some powers of ten: 1e-9
# within 25 ms.
TOLERANCE = 1e-8


def assert_same(plain, other, turn=SAME, shift=(0.0, 0.0, 0.0), order=(0, 1, 2, 3)):
    (state, recorded, touches), (moved, found, again) = plain, other
    assert again == touches
    size = np.abs(recorded.force).max()
    expected = np.einsum("ij,tjg->tig", turn, recorded.mean_force)
    assert np.abs(found.mean_force - expected).max() < TOLERANCE * size
    where = turn @ state.position[:, list(order)] + np.asarray(shift)[:, None]
    assert np.abs(moved.position - where).max() < TOLERANCE * 0.1
    kinetic = recorded.energy[:, 0]
    assert np.abs(found.energy[:, 0] - kinetic).max() < TOLERANCE * kinetic.max()


def test_turned(plain):
    turn = Rotation.from_euler("xyz", (0.7, -1.1, 2.0)).as_matrix()
    assert_same(plain, run(scene(turn=turn)), turn)


def test_moved(plain):
    shift = (0.31, -0.17, 0.23)
    assert_same(plain, run(scene(shift=shift)), shift=shift)


def test_mirrored(plain):
    assert_same(plain, run(scene(turn=MIRROR)), MIRROR)


def test_pieces_in_another_order(plain):
    """Which of two pieces is a and which is b changes with their numbers."""
    order = (3, 1, 0, 2)
    assert_same(plain, run(scene(order=order)), order=order)
