"""What the peers are told of the box, and the words in which they are told."""

import sys
from collections import Counter
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from benchmarks.peers import __main__ as peers
from benchmarks.peers import lammps, liggghts, mujoco, packing
from benchmarks.peers.child import Child, Stopped
from dem_jax.math.pose import quaternion_to_matrix

ECHO = "from benchmarks.peers.child import serve; serve(lambda steps: sum(range(20000 * steps)))"

TOLD = "print(open(input().split()[1]).read());" + ECHO  # reads the script that it is to include,
# and answers at length


@pytest.fixture
def box():
    shape, width = "chamfered-cuboid", packing.width_of("chamfered-cuboid", 8)
    return packing.Packing(
        shape, width, *packing.lattice(shape, 8, width, np.random.default_rng(0))
    )


def test_the_piece_is_the_marshmallow():
    corners = packing.vertices()
    assert corners.shape == (16, 3)
    assert ConvexHull(corners).volume == pytest.approx(19440e-9, rel=1e-12)
    assert packing.MASS == pytest.approx(packing.DENSITY * 19440e-9, rel=1e-12)
    assert 4 / 3 * np.pi * packing.RADIUS**3 == pytest.approx(19440e-9, rel=1e-12)
    assert 2 * np.linalg.norm(corners, axis=1).max() == pytest.approx(
        packing.BOUNDING["chamfered-cuboid"], abs=5e-6
    )


def test_loose_pieces_are_in_the_box_and_apart(box):
    turned = (
        np.einsum("nij,vj->nvi", quaternion_to_matrix(box.orientation), packing.vertices())
        + box.position[:, None]
    )
    assert np.abs(turned[..., :2]).max() < 0.5 * box.width
    assert turned[..., 2].min() > 0
    np.testing.assert_allclose(np.linalg.norm(box.orientation, axis=1), 1, rtol=1e-12)
    low, high = turned.min(axis=1), turned.max(axis=1)
    apart = ((low[:, None] > high[None]) | (high[:, None] < low[None])).any(axis=-1)
    assert (apart | np.eye(box.count, dtype=bool)).all()  # axis-aligned boxes: enough for these


def test_faces_for_lammps_close_the_piece():
    corners = packing.vertices()
    edges, sides = lammps.faces(corners)
    assert len(edges) == 24 and len(set(map(frozenset, edges))) == 24
    around = Counter(frozenset((side[k], side[k - 1])) for side in sides for k in range(4))
    assert set(around.values()) == {2}  # each edge, those within an octagon too, between two faces
    assert set(map(frozenset, edges)) <= set(around)
    for side in sides:
        assert np.linalg.matrix_rank(corners[list(side)] - corners[side[0]], tol=1e-9) == 2


def test_lammps_data_has_as_many_numbers_as_it_says(box):
    lines = lammps.body_data(box).split("Bodies\n\n")[1].split()
    number, integers, doubles = int(lines[0]), int(lines[1]), int(lines[2])
    assert (number, integers) == (1, 3)
    assert len(lines) == box.count * (3 + integers + doubles)


def test_mujoco_model_has_all_pieces(box):
    world = ElementTree.fromstring(mujoco.model(box)).find("worldbody")
    assert len(world.findall("body")) == box.count and len(world.findall("geom")) == 5


def test_clump_fills_the_length_width_and_height_of_the_piece():
    clump = np.array(liggghts.CLUMP)
    reach = (np.abs(clump[:, :3]) + clump[:, 3:]).max(axis=0)
    np.testing.assert_allclose(reach, np.abs(packing.vertices()).max(axis=0), rtol=1e-12)


def test_a_child_runs_when_told_and_says_why_it_stopped(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", ":".join(sys.path))
    with Child([sys.executable, "-c", ECHO]) as child:
        child.run(1)
        wall, busy = child.run(200)
        assert 0 < busy <= 1.1 * wall  # one thread; the two clocks are not read at the same instant
    with Child([sys.executable, "-c", TOLD], "x\n" * 100_000, tmp_path) as child:  # longer than a
        # pipe holds
        child.run(1)
    with Child([sys.executable, "-c", "raise RuntimeError('no walls')"]) as child:
        with pytest.raises(Stopped, match="RuntimeError: no walls"):
            child.run(1)


def test_what_is_not_installed_is_named_and_left_out(monkeypatch):
    monkeypatch.setenv("PATH", "")
    rows, notes = peers.peers(sys.executable)
    assert "LIGGGHTS: not installed, left out" in notes and "YADE: not installed, left out" in notes
    assert {row.name for row in rows} <= {"ours", "MuJoCo"}


def test_tables_show_times_ratios_and_why_there_is_none():
    rows = [row for row in peers.peers(sys.executable)[0] if row.name == "ours"]
    other = peers.Peer("other", "all", peers.SPHERE, (8,), None, 10, 2e-6)
    mine = peers.Timed([2e-6, 4e-6], [2e-6, 4e-6], 5.0, 3000)
    theirs = peers.Timed([1e-6, 1e-6], [1e-6, 2e-6], 0.5, 3)
    found = {(peers.PIECE, 8): {"ours": mine}, (peers.SPHERE, 8): {"ours": mine, "other": theirs}}
    found |= {(peers.SPHERE, 64): {"ours": mine, "other": "stopped: no room"}}
    text = peers.tables([*rows, other], found)
    assert "| other | all | 1 (1 to 1) | stopped: no room |" in text
    assert "| other | 0.375 (0.25 to 0.5) |  |" in text  # each round by itself
    assert "| other | 0.5 |  |" in text  # 1 us for a step of 2 us
    assert "other at N = 8 (3 of 10 steps)" in peers.unsettled([*rows, other], found)


def test_slow_programs_run_with_many_pieces_only_if_asked(monkeypatch):
    for program in (peers.liggghts, peers.lammps, peers.yade):
        monkeypatch.setattr(program, "version", lambda: "1")
    monkeypatch.setattr(peers.mujoco, "version", lambda python: "1")
    largest = lambda patient: {
        (p.name, p.shape): max(p.sizes) for p in peers.peers(sys.executable, patient)[0]
    }
    usual, patient = largest(False), largest(True)
    slow = {(name, peers.PIECE) for name in ("YADE", "LAMMPS bodies", "MuJoCo")}
    assert {row for row in usual if usual[row] < patient[row]} == slow
    assert usual["ours", peers.PIECE] == usual["LIGGGHTS clumps", peers.PIECE] == 1000
    assert {usual[name, peers.SPHERE] for name in ("ours", "LIGGGHTS", "LAMMPS")} == {8000}


@pytest.mark.parametrize("shape, count", [("chamfered-cuboid", 1000), ("sphere", 8000)])
def test_many_loose_pieces_are_in_the_box_and_apart(shape, count):
    width = packing.width_of(shape, count)
    position, _ = packing.lattice(shape, count, width, np.random.default_rng(0))
    if shape == "sphere":
        assert (
            np.abs(position[:, :2]).max() + packing.RADIUS < 0.5 * width
            and position[:, 2].min() > packing.RADIUS
        )
        near = cKDTree(position).query(position, k=2)[0][:, 1]
        assert near.min() > 2 * packing.RADIUS
    else:  # turning about any axis, a piece stays in its column
        assert np.abs(position[:, :2]).max() + 0.5 * packing.BOUNDING[shape] < 0.5 * width + 1e-9
