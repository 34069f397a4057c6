"""Directions of edges, parallel ones once."""

import numpy as np

from dem_jax.math.loops import cross_product

FEW_EDGES = 256  # which one group takes: scipy, which finds groups, takes half a second to load


def find_edge_directions(vectors: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [D, 3] of edges [E, 3] (m) and the index [E] of each edge's.

    Edges whose shorter one leaves the other's direction by less than tolerance (m) are parallel:
    the longest edge left, whose direction is the most exact, takes its own with it.
    """
    lengths = np.linalg.norm(vectors, axis=1)
    units = vectors / lengths[:, None]
    high = np.argmax(np.abs(units) > 0.5, axis=1)
    units = units * np.sign(np.take_along_axis(units, high[:, None], axis=1)) + 0.0
    is_small = len(vectors) <= FEW_EDGES
    near = (
        np.zeros(len(vectors), int) if is_small else _group_directions(units, tolerance / lengths)
    )
    seed_of = np.empty(len(vectors), int)
    left = np.argsort(-lengths, kind="stable")
    rank = np.argsort(left)
    while len(left):  # once for each direction of the group that has most
        _, firsts, group = np.unique(near[left], return_index=True, return_inverse=True)
        seeds = left[firsts[group]]
        same = np.linalg.norm(cross_product(vectors[left], units[seeds]), axis=1) < tolerance
        same[firsts] = True
        seed_of[left[same]] = seeds[same]
        left = left[~same]
    order, of_edge = np.unique(rank[seed_of], return_inverse=True)
    return units[np.argsort(rank)[order]], of_edge


def _group_directions(units: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Labels [E] such that directions [E, 3], either way, that part by less than the larger of
    their angles [E] (rad) have the same one: those in cells that touch, and those near a direction
    whose angle is wider than a cell.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    count, width = len(units), 2.0 * float(np.median(angles))
    both = np.concatenate([units, -units])
    used, cell = np.unique(np.floor(both / width), axis=0, return_inverse=True)
    touching = cKDTree(used).query_pairs(1.5, p=np.inf, output_type="ndarray")
    wide = np.flatnonzero(angles > 0.5 * width)
    around = cKDTree(both).query_ball_point(units[wide], 2.0 * np.minimum(angles[wide], 1.0))
    of_wide = np.repeat(wide, [len(found) for found in around])
    rows = np.concatenate([np.tile(np.arange(count), 2), count + touching[:, 0], of_wide])
    columns = np.concatenate(
        [
            count + cell.ravel(),
            count + touching[:, 1],
            np.concatenate([*around, []]).astype(int) % count,
        ]
    )
    nodes = count + len(used)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(nodes, nodes))
    return connected_components(graph, directed=False)[1][:count]
