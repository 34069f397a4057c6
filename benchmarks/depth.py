"""Error of depth and normal of polytopes against hull arithmetic: ``python -m benchmarks.depth``
(``--quick``: fewer).

Random pairs of random hulls of 4 to 128 corners and of bodies with parallel faces and edges, from
deep in each other to apart, some with faces and edges exactly parallel, some touching. The
reference is the hull of all differences of their corners (the Minkowski difference), by Qhull: two
bodies that overlap are as deep in each other as the origin is in it, and two that do not are as far
apart as the origin is from it.
"""

import argparse
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from benchmarks import report
from dem_jax import shapes
from dem_jax.assembly import hull_table
from dem_jax.narrow_phase import collision_primitives, contact_geometry
from dem_jax.xla_flags import supported_options

PAIRS = 10_000
BATCH = 250  # one compiled program
CORNERS = (4, 5, 6, 8, 10, 12, 16, 16, 24, 24, 32, 48, 64, 96, 128)
DTYPES = np.float32, np.float64
HEAD = ["precision", "pairs", "overlapping", "depth: largest", "median", "along the normal", "gap"]
SAID = """Errors relative to a size of 30 mm: of the depth of those that overlap; how deep these still are after b has gone along
the normal by the depth and the 2 % by which a face is preferred (negative: apart); by how much the gap of the others is found too
wide, or an overlap where there is none."""
DEPTHS = -0.1, 0.3  # of a size, along a random direction


class Pairs(NamedTuple):
    """Poses of pairs of shapes, b as seen from a."""

    a: np.ndarray  # [P] of the shapes
    b: np.ndarray
    turn: Rotation  # [P]: from b's frame to a's
    offset: np.ndarray  # [P, 3] (m)


def bodies() -> list[shapes.Shape]:
    """Random hulls of CORNERS on ellipsoids, and bodies with parallel faces and edges, all of about
    30 mm.
    """
    random, made = np.random.default_rng(0), []
    for count in CORNERS:
        points = random.normal(size=(count, 3))
        points *= 0.015 / np.linalg.norm(points, axis=1, keepdims=True)
        made.append(shapes.convex_hull(points * random.uniform(0.6, 1.4, 3)))
    return [
        *made,
        shapes.chamfered_cuboid((0.03, 0.02, 0.012), 0.003),
        shapes.prism(5, 0.014, 0.03),
    ]


def in_principal_frame(shape: shapes.Shape) -> np.ndarray:
    """Corners [V, 3] (m) in the frame of the tables."""
    return shape.vertices @ Rotation.from_quat(shape.principal, scalar_first=True).as_matrix()


def random_pairs(
    count: int, corners: list[np.ndarray], normals: list[np.ndarray], seed: int = 0
) -> Pairs:
    """Pairs of bodies of corners [V, 3] and face normals [F, 3]: of four one has parallel faces,
    one parallel edges, one a body that touches to rounding along a random direction.
    """
    random = np.random.default_rng(seed)
    a, b = random.integers(len(corners), size=(2, count))
    turn = Rotation.from_quat(random.normal(size=(count, 4)))
    along = random.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    deep = random.uniform(*DEPTHS, count) * 0.015
    turns = turn.as_quat()
    for k in range(count):
        kind = k % 4
        if kind == 0:  # a face of one on a face of the other, turned about their normal
            n, m = (random.choice(normals[i[k]]) for i in (a, b))
            spin = Rotation.from_rotvec(random.uniform(0, 6.3) * n)
            turns[k] = (spin * Rotation.align_vectors([-n], [m])[0]).as_quat()
            along[k] = n
        elif kind == 1:  # an edge of one parallel to one of the other
            e, f = (
                np.diff(random.choice(corners[i[k]], 2, replace=False), axis=0)[0] for i in (a, b)
            )
            e, f = e / np.linalg.norm(e), f / np.linalg.norm(f)
            spin = Rotation.from_rotvec(random.uniform(0, 6.3) * e)
            turns[k] = (spin * Rotation.align_vectors([e], [f])[0]).as_quat()
        elif kind == 2:
            deep[k] = 0.0
    turn = Rotation.from_quat(turns)
    reach = [
        (corners[a[k]] @ along[k]).max() - (turn[k].apply(corners[b[k]]) @ along[k]).min()
        for k in range(count)
    ]
    return Pairs(a, b, turn, (np.array(reach) - deep)[:, None] * along)


def reference(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Depth (m) of two bodies from the differences b - a [., 3] of their corners, of separated ones
    minus the distance, and the unit normal [3], from a to b.
    """
    found = ConvexHull(points)
    normals, heights = found.equations[:, :3], found.equations[:, 3]
    k = np.argmax(heights)  # of the facet nearest to the origin inside
    if heights[k] <= 0:
        return -heights[k], -normals[k]
    # least distance programming (Lawson and Hanson): the point x of least norm with normals x <=
    # -heights
    system = np.vstack([-normals.T, heights])
    residual = system @ nnls(system, np.array([0, 0, 0, 1.0]))[0] - np.array([0, 0, 0, 1.0])
    x = -residual[:3] / residual[3]
    return -float(np.linalg.norm(x)), x / np.linalg.norm(x)


@partial(jax.jit, compiler_options=supported_options("cpu"))
def _contact(table, a, b, turn, offset):
    return contact_geometry.polytope_contact(
        table,
        (a, b),
        collision_primitives.RelativePose(tuple(tuple(row) for row in turn), tuple(offset)),
    )._replace(moments=None)


def computed(made: list[shapes.Shape], pairs: Pairs, dtype) -> tuple[np.ndarray, np.ndarray]:
    """Depth [P] (m) and normal [P, 3] of pairs by the narrow phase, in a's frame. Needs
    jax_enable_x64 for float64.
    """
    table = hull_table.build_hull_table(made, dtype)
    table = table.replace(row=table.row.astype(np.int32))
    turn = pairs.turn.as_matrix().transpose(1, 2, 0).astype(dtype)
    offset = pairs.offset.T.astype(dtype)
    depth, normal = [], []
    for start in range(0, len(pairs.a), BATCH):
        rows = np.minimum(np.arange(start, start + BATCH), len(pairs.a) - 1)
        a, b = (i[rows].astype(np.int32) for i in (pairs.a, pairs.b))
        found = _contact(table, a, b, turn[..., rows], offset[..., rows])
        depth.append(np.asarray(found.depth, float))
        normal.append(np.stack(found.normal, axis=-1).astype(float))
    return np.concatenate(depth)[: len(pairs.a)], np.concatenate(normal)[: len(pairs.a)]


class Errors(NamedTuple):
    """Of pairs, relative to the size of 30 mm."""

    touching: int  # pairs that overlap
    depth: np.ndarray  # of those
    left: np.ndarray  # how deep they still are after b has gone by the depth, and what a face is
    # preferred by, along the normal
    apart: np.ndarray  # of the others: by how much the gap exceeds the true distance, or is none


def errors(count: int, dtypes, seed: int = 0) -> list[Errors]:
    """Errors of so many random pairs in each precision. Needs jax_enable_x64 for float64."""
    made = bodies()
    corners = [in_principal_frame(shape) for shape in made]
    turns = [Rotation.from_quat(shape.principal, scalar_first=True).as_matrix() for shape in made]
    pairs = random_pairs(
        count,
        corners,
        [shape.normals @ turn for shape, turn in zip(made, turns, strict=True)],
        seed,
    )
    both = [(corners[a], turn.apply(corners[b]) + x) for a, b, turn, x in zip(*pairs, strict=True)]
    true = np.array(
        [reference((second[None] - first[:, None]).reshape(-1, 3))[0] for first, second in both]
    )
    inside, size, out = true > 0, 0.03, []
    for dtype in dtypes:
        depth, normal = computed(made, pairs, dtype)
        overlap = np.array(
            [
                (first @ n).max() - (second @ n).min()
                for (first, second), n in zip(both, normal, strict=True)
            ]
        )
        left = (overlap - depth / (1 - collision_primitives.FACE_PREFERENCE))[inside]
        beyond = np.maximum(depth, true - depth)[~inside]
        out.append(
            Errors(
                int(inside.sum()), *(x / size for x in (np.abs(depth - true)[inside], left, beyond))
            )
        )
    return out


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="400 pairs")
    options = parser.parse_args(argv)
    count, rows = (400 if options.quick else PAIRS), []
    with jax.enable_x64(True):
        for dtype, found in zip(DTYPES, errors(count, DTYPES), strict=True):
            figures = found.depth.max(), np.median(found.depth), found.left.max(), found.apart.max()
            rows.append(
                [dtype.__name__, f"{count}", f"{found.touching}", *(f"{x:.1e}" for x in figures)]
            )
    table = report.table(HEAD, rows)
    about = __doc__.split("\n", 2)[2].strip()
    report.write(
        "depth",
        f"# Depth and normal of random hulls\n\n{about}\n\n{SAID}\n\n{table}\n",
        options.quick,
    )


if __name__ == "__main__":
    main()
