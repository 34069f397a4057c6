"""Runs and ensembles as HDF5 files: what the other rooms use of this one."""

from dem_jax.store.datasets import flat
from dem_jax.store.header import Header, Stored
from dem_jax.store.output import FileName, Fingerprint, check_target, check_writable, destination, fingerprint, locked, write_whole
from dem_jax.store.reader import load_restart, load_run
from dem_jax.store.run import Frames, Run, assembled, series_of
from dem_jax.store.writer import Writer

__all__ = [
    "FileName",
    "Fingerprint",
    "Frames",
    "Header",
    "Run",
    "Stored",
    "Writer",
    "assembled",
    "check_target",
    "check_writable",
    "destination",
    "fingerprint",
    "flat",
    "load_restart",
    "load_run",
    "locked",
    "series_of",
    "write_whole",
]
