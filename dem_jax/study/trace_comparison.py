"""The Product Model beside the drops of a study, and distances between traces."""

import numpy as np

from dem_jax.study.results_file import DONE, StudyResults

MOST_PAIRS = 500  # of traces that are compared


def align_traces(results: StudyResults, which: np.ndarray) -> np.ndarray:
    """Traces [K, T'] (kg) of some drops [M] bool, each from its first force on, over ``span``;
    those without force are left out.
    """
    members = [
        k for k in np.flatnonzero(which & (results.state == DONE)).tolist() if k in results.force
    ]
    return _cut_before_first_force(results, [results.force[k] for k in members])


def simulate_model_traces(results: StudyResults, seed: int = 0) -> np.ndarray:
    """Traces of the Product Model, one for each finished drop, aligned in the same way, [K, T']
    (kg).
    """
    import product_model

    table, time = results.study.model, results.time
    assert table is not None and time is not None  # as who asks makes sure
    scene = results.study.base_scene()
    portion = scene.portion
    pieces = int(_piece_count(results))
    weight = (
        np.nanmedian(results.outputs["settled"]) / 1e3 / pieces
        if "settled" in results.outputs
        else None
    )
    inputs = product_model.Parameters(
        h_mean=table.height, gamma_low=table.gamma_low, gamma_high=table.gamma_high, dt_impact=table.impact_time,
        m_piece=weight or (portion.target_weight or 0.05) / pieces if portion else 0.005, pieces=pieces,
        sample=scene.run.sample_interval, duration=float(len(time) * scene.run.sample_interval),
    )  # fmt: skip
    runs = int((results.state == DONE).sum())
    return _cut_before_first_force(results, list(product_model.ensemble(inputs, seed, runs).pif_kg))


def rmse_to_model(results: StudyResults) -> np.ndarray:
    """RMSE of each drop against one trace of the Product Model (g)."""
    dem, own = (
        align_traces(results, np.ones(len(results.state), bool)),
        simulate_model_traces(results),
    )
    return np.concatenate(
        [trace_distances(a[None], b[None]) for a, b in zip(dem, own, strict=False)] or [np.zeros(0)]
    )


def rmse_to_point(results: StudyResults, which: np.ndarray, other: np.ndarray) -> np.ndarray:
    """RMSE of the drops of a point [M] bool against those of another point with the same seeds (g),
    from its first force on.
    """
    pairs = zip(np.flatnonzero(which).tolist(), np.flatnonzero(other).tolist(), strict=True)
    both = [
        (results.force[i], results.force[j])
        for i, j in pairs
        if i in results.force and j in results.force
    ]
    return np.array(
        [
            1e3 * np.sqrt(np.mean((a[n] - b[n]) ** 2))
            for a, b in both
            for n in [_common_samples(results, b, a)]
        ]
    )


def _common_samples(results: StudyResults, *rows: np.ndarray) -> slice:
    """Samples from the first force of the first trace on, over ``span``."""
    assert results.time is not None
    first, length = int(np.argmax(rows[0] > 0)), min(map(len, rows))
    sample = float(results.time[1] - results.time[0])
    return slice(
        first,
        length
        if results.study.span is None
        else min(length, first + round(results.study.span / sample)),
    )


def _piece_count(results: StudyResults) -> float:
    if "pieces" in results.outputs:
        return float(np.nanmedian(results.outputs["pieces"]))
    from dem_jax.assembly.piece_arrays import build_piece_set

    return float(len(build_piece_set(results.study.base_scene()).shapes))


def _cut_before_first_force(results: StudyResults, rows: list[np.ndarray]) -> np.ndarray:
    assert results.time is not None
    rows = [row for row in rows if (row > 0).any()]
    starts = [int(np.argmax(row > 0)) for row in rows]
    sample = float(results.time[1] - results.time[0])
    length = min([len(row) - k for row, k in zip(rows, starts, strict=True)], default=0)
    if results.study.span is not None:
        length = min(length, round(results.study.span / sample))
    return np.array([row[k : k + length] for row, k in zip(rows, starts, strict=True)]).reshape(
        len(rows), length
    )


def trace_distances(a: np.ndarray, b: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    """Root mean square differences (g) of pairs of traces (kg), between a and b or within a; at
    most MOST_PAIRS.
    """
    pairs = [
        (i, j)
        for i in range(len(a))
        for j in range(len(a if b is None else b))
        if b is not None or i < j
    ]
    if len(pairs) > MOST_PAIRS:
        random = np.random.default_rng(seed)
        pairs = [pairs[k] for k in random.choice(len(pairs), MOST_PAIRS, replace=False)]
    other = a if b is None else b
    length = min(a.shape[1], other.shape[1]) if len(a) and len(other) else 0
    return np.array(
        [1e3 * np.sqrt(np.mean((a[i, :length] - other[j, :length]) ** 2)) for i, j in pairs]
    )
