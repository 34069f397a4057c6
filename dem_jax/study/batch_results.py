"""Results of a batch: computed here, by a worker or in a shard by one and the same function."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dem_jax import process
from dem_jax.io.run_files import Run
from dem_jax.study import batches
from dem_jax.study.config import Study
from dem_jax.study.outputs import (
    evaluate_outputs,
    evaluate_portions,
    extract_traces,
    select_drop_outputs,
)
from dem_jax.study.results_file import DONE, LOST, StudyResults


@dataclass(frozen=True)
class BatchResults:
    """Results of a batch of drops."""

    members: tuple[int, ...]  # drops that are done
    failed: tuple[batches.FailedDrops, ...] = ()
    outputs: dict[str, tuple[tuple[int, ...], np.ndarray]] = field(default_factory=dict)  # name ->
    # members and their values
    time: np.ndarray | None = None  # [T] (s) of traces
    force: dict[int, np.ndarray] = field(default_factory=dict)  # member -> [T] (kg)
    compile_time: float = 0.0  # s, of all that it took
    notes: tuple[str, ...] = ()  # of its runs


def compute_batch(
    study: Study, kept: Path | None, progress: bool, batch: batches.Batch
) -> BatchResults:
    """Compute a batch.

    Args:
        study: the study that it is of.
        kept: file of the batch while it is computed, if that takes long; None: it is not kept.
        progress: whether to show a bar for such a batch.
        batch: the drops.

    Returns:
        Its results. Drops that cannot be computed are in ``failed``.
    """
    names = study.outputs
    outputs = {
        name: (batch.members, values)
        for name, values in evaluate_portions(batches.portion_masses(batch), names).items()
    }
    if not select_drop_outputs(names):
        return BatchResults(batch.members, (), outputs)
    run, members, failed = batches.run_batch(batch, study, kept, progress)
    if run is None:
        return BatchResults(members, tuple(failed), outputs)
    outputs |= {name: (members, values) for name, values in evaluate_outputs(run, names).items()}
    traces = _extract_forces(run) if study.traces else ()
    return BatchResults(
        members,
        tuple(failed),
        outputs,
        run.time if study.traces else None,
        dict(zip(members, traces, strict=bool(study.traces))),
        float(run.info.get("compile_time", 0.0)),
        tuple(run.info.get("notes", ())),
    )


def _extract_forces(run: Run) -> np.ndarray:
    """The traces that are kept of an ensemble, [K, T] (kg), in single precision."""
    return extract_traces(run).force.astype(np.float32)


def enter_results(results: StudyResults, found: BatchResults) -> None:
    """Enter the results of a batch into those of its study, whatever the order of the batches."""
    with process.defer_signals():  # the file says of all of it that it is done, or of nothing
        for name, (of, values) in found.outputs.items():
            results.outputs[name][list(of)] = values
        results.extend_time(found.time)
        results.force |= found.force
        results.state[list(found.members)] = DONE
        results.add_notes(found.notes)
        enter_failed(results, found.failed)


def enter_failed(results: StudyResults, failed: tuple[batches.FailedDrops, ...]) -> None:
    """Enter drops that cannot be computed."""
    for lost in failed:
        results.failure_reasons |= dict.fromkeys(lost.members, lost.reason)
        results.state[list(lost.members)] = LOST
