"""Runs and ensembles as HDF5 files: the interface of this package."""

from dem_jax.io.atomic_files import (
    FileName,
    Fingerprint,
    check_destination,
    check_writable,
    lock_file,
    read_fingerprint,
    resolve_destination,
    write_atomically,
    write_unchanged,
)
from dem_jax.io.datasets import flatten_tree
from dem_jax.io.header import RunHeader, StoredQuantity
from dem_jax.io.reader import load_restart, load_run
from dem_jax.io.run_data import Frames, Run, assemble_run, collect_series
from dem_jax.io.writer import Writer

__all__ = [
    "FileName",
    "Fingerprint",
    "Frames",
    "RunHeader",
    "Run",
    "StoredQuantity",
    "Writer",
    "assemble_run",
    "check_destination",
    "check_writable",
    "resolve_destination",
    "read_fingerprint",
    "flatten_tree",
    "load_restart",
    "load_run",
    "lock_file",
    "collect_series",
    "write_atomically",
    "write_unchanged",
]
