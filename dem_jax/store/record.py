"""Runs and ensembles as HDF5 files: written as a run goes, readable at every moment, loaded as numpy arrays.

A flush never changes the file in place: it copies the file, appends to the copy and renames it over the original. So
a process that is killed at any instant leaves the file of its last flush, in which the series and the restart state
belong to the same time, and any reader may open the file while the run goes on. The price is a copy per flush; flushes
are spaced such that it stays below 5 % of the time. (Compression would not pay: a growing chunk is written anew.)
"""

import json
import os
import shutil
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from dem_jax.errors import RecordError

STANDARD_GRAVITY = 9.81  # m/s2, as the paper; converts a force to kg in a scene without gravity

# Unit of each dataset, by the longest of these that its path starts with.
UNITS = {
    "time": "s",
    "force": "N",
    "mean_force": "N",
    "torque": "N m",
    "settled_mass": "kg",
    "energy": "J",
    "momentum": "kg m/s",
    "overlap": "1",
    "pieces/time": "s",
    "pieces/position": "m",
    "pieces/orientation": "1",
    "pieces/velocity": "m/s",
    "pieces/angular_velocity": "rad/s",
    "restart": "SI",
}

CHUNK = 1024  # samples per chunk: 8 KiB of a scalar series in double precision
PENDING_LIMIT = 256 * 2**20  # bytes of samples kept in memory before a flush is due whatever it costs


@dataclass(frozen=True)
class Header:
    """What a file says about its run, as attributes of its root.

    scene: TOML text. seed: one, or one per run of an ensemble. dt: (s) time step. precision: "f32" or "f64".
    version: of dem_jax. sample: (s) sample interval. gravity: [3] (m/s2). groups, blocks: names of the wall groups and
    of the blocks in which settled mass is measured. piece_count: pieces in a run. run_count: runs of an ensemble, None
    for a single run. info: further facts that JSON can hold (what limits dt, why the run stopped, ...).
    """

    scene: str
    seed: int | tuple[int, ...]
    dt: float
    precision: str
    version: str
    sample: float
    gravity: tuple[float, float, float]
    groups: tuple[str, ...]
    blocks: tuple[str, ...]
    piece_count: int
    run_count: int | None = None
    info: dict = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Frames:
    """Stored poses; an ensemble has a leading run axis on all but time.

    time: [F] (s). position: [F, N, 3] (m) centres of mass. orientation: [F, N, 4] quaternions w x y z, body to world.
    velocity: [F, N, 3] (m/s). angular_velocity: [F, N, 3] (rad/s), world frame.
    """

    time: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


@dataclass(frozen=True, eq=False)
class Run:
    """A run, or an ensemble of K runs: then every series but time has a leading axis of length K.

    time: [T] (s) since the release of the portion.
    force: group -> [T, 3] (N) of the pieces on that wall group, at that time; downward is negative z.
    mean_force: group -> [T, 3] (N) mean over the sample interval that ends at that time.
    torque: group -> [T, 3] (N m). settled_mass: block -> [T] (kg) of pieces inside it slower than 0.1 m/s.
    energy: kind -> [T] (J). overlap: [T] the largest overlap over the piece's size, or None. momentum: [T, 3] (kg m/s)
    of all pieces, or None.
    pieces: stored poses or None. restart: path -> array, all that is needed to go on.
    settled: time (s) at which the run ended because all was at rest (``run.until_settled``), None: it went on to its end.
    header: scene, seed, time step and the like; its fields are attributes of the run too.
    """

    header: Header
    time: np.ndarray
    force: dict[str, np.ndarray]
    mean_force: dict[str, np.ndarray]
    settled_mass: dict[str, np.ndarray]
    torque: dict[str, np.ndarray] = field(default_factory=dict)
    energy: dict[str, np.ndarray] = field(default_factory=dict)
    overlap: np.ndarray | None = None
    momentum: np.ndarray | None = None
    pieces: Frames | None = None
    restart: dict[str, np.ndarray] = field(default_factory=dict)

    scene = property(lambda self: self.header.scene)
    seed = property(lambda self: self.header.seed)
    dt = property(lambda self: self.header.dt)
    precision = property(lambda self: self.header.precision)
    version = property(lambda self: self.header.version)
    sample = property(lambda self: self.header.sample)
    run_count = property(lambda self: self.header.run_count)
    info = property(lambda self: self.header.info)
    settled = property(lambda self: self.info.get("settled"))

    def save(self, path, overwrite=False):
        """Write the run to an HDF5 file. Raises RecordError if it exists, unless overwrite, or cannot be written."""
        with Writer.create(path, self.header, overwrite) as writer:
            frames = None if self.pieces is None else vars(self.pieces)
            writer.append(_series_of(self), frames, self.restart)

    def pif_kg(self, group, mean=True):
        """Product impact force over g, eq. 24: [T] (kg), on a wall group: sample means or instants.

        The force along gravity is taken, over its magnitude; without gravity, downward and 9.81 m/s2.
        Raises RecordError for a group that the run does not have.
        """
        forces = self.mean_force if mean else self.force
        if group not in forces:
            raise RecordError(f"group = {group!r} is not in this run; it has: {', '.join(forces) or 'none'}")
        gravity = np.asarray(self.header.gravity, np.float64)
        if not gravity.any():
            gravity = np.array([0.0, 0.0, -STANDARD_GRAVITY])
        return forces[group].astype(np.float64) @ (gravity / (gravity @ gravity))

    def member(self, k):
        """Run k of an ensemble, as a single run. Raises RecordError if there is none."""
        if self.run_count is None:
            raise RecordError(f"run {k!r} was asked for, but this is a single run")
        if not 0 <= k < self.run_count:
            raise RecordError(f"run {k!r} is not in this ensemble; it has 0 to {self.run_count - 1}")
        pieces = self.pieces
        if pieces is not None:
            pieces = Frames(pieces.time, **{n: a[k] for n, a in vars(pieces).items() if n != "time"})
        seed = self.seed[k] if np.ndim(self.seed) else self.seed
        series = _nested({n: a if n == "time" else a[k] for n, a in _series_of(self).items()})
        return Run(header=replace(self.header, seed=seed, run_count=None), pieces=pieces, **series)


SERIES_GROUPS = ("force", "mean_force", "settled_mass", "torque", "energy")
SERIES = ("time", "overlap", "momentum")


def load_run(path):
    """The run or ensemble in an HDF5 file.

    Raises RecordError for a file that is missing, not HDF5, cut short or damaged, or that lacks what a run must have.
    """
    with _reading(path) as file:
        header = _read_header(file, path)
        if "time" not in file:
            raise RecordError(f"{path} holds no samples: its run stopped before the first flush")
        _require(file, header, path)
        series = {n: file[n][()] for n in SERIES if n in file}
        series |= {g: {n: d[()] for n, d in file[g].items()} if g in file else {} for g in SERIES_GROUPS}
        pieces = Frames(**{f.name: file[f"pieces/{f.name}"][()] for f in fields(Frames)}) if "pieces" in file else None
        restart = flat({name: item[()] for name, item in _datasets(file.get("restart", {}))})
    run = Run(header=header, pieces=pieces, restart=restart, **series)
    _check_lengths(run, path)
    return run


def load_restart(path):
    """What is needed to go on with a file: header, restart state (path -> array), samples and frames in the file.

    Raises RecordError as `load_run`; a file without samples is fine, one without a restart state is not.
    """
    with _reading(path) as file:
        header = _read_header(file, path)
        restart = flat({name: item[()] for name, item in _datasets(file.get("restart", {}))})
        counts = [len(file[name]) if name in file else 0 for name in ("time", "pieces/time")]
    if not restart:
        raise RecordError(f"{path} holds no state to go on from: its run stopped before the first flush")
    return header, restart, *counts


def check_target(path, overwrite=False):
    """Raise RecordError if a file cannot be written, or exists and is not to be overwritten."""
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise RecordError(f"{path} cannot be written: there is no folder {str(path.parent)!r}")
    if path.exists() and not (overwrite and path.is_file()):
        raise RecordError(f"{path} exists; give another name, or overwrite = true to replace it")
    if path.exists():
        _check_writable(path)


def assembled(header, parts, restart=None):
    """The run of series path -> [array, ...], in pieces along the time axis; None if there are no samples."""
    series = {name: np.concatenate(arrays, axis=_time_axis(name, header)) for name, arrays in parts.items()}
    if "time" not in series:
        return None
    poses = {f.name: series.pop(f"pieces/{f.name}", None) for f in fields(Frames)}
    pieces = None if poses["time"] is None else Frames(**poses)
    groups = {group: {} for group in SERIES_GROUPS} | _nested(series)
    return Run(header=header, pieces=pieces, restart=restart or {}, **groups)


class Writer:
    """Appends a run's samples to its file. Made by `create` or `resume`; a `with` block flushes and closes it.

    What `append` gets is kept in memory until a flush: when `interval` (s) and 20 times its cost have passed since the
    last one, at `flush()`, and at the end. With interval = 0 each append is flushed.
    """

    def __init__(self, path, header, exists, interval):
        self._path, self._header, self._exists, self._interval = Path(path), header, exists, interval
        self._names = None  # of the series, once known
        self._restart, self._info = {}, {}
        self._pending, self._last, self._cost = {}, time.monotonic(), 0.0

    @classmethod
    def create(cls, path, header, overwrite=False, interval=1.0):
        """Start a file. One that exists is kept until the first flush, and only replaced if overwrite.

        Raises RecordError if it exists and overwrite is not set, or if it cannot be written.
        """
        check_target(path, overwrite)
        writer = cls(path, header, False, interval)
        if not Path(path).exists():
            writer._commit()
        return writer

    @classmethod
    def resume(cls, path, interval=1.0, scene=None):
        """Go on with a file, from the state of `load_restart(path)`; scene: TOML text, to replace the file's.

        Raises RecordError as `load_run`.
        """
        with _reading(path) as file:
            header, names = _read_header(file, path), {name for name, _ in _datasets(file)}
        header = replace(header, scene=scene or header.scene)
        writer = cls(path, header, True, interval)
        writer._names = {n for n in names if not n.startswith("restart/")} or None
        return writer

    def append(self, samples, frames=None, restart=None, info=None):
        """Add samples, poses and the state they lead to; all of one call reach the file together or not at all.

        samples: name -> array, or group -> {name -> array}, such as {"time": [t], "force": {"plate": [t, 3]}}; of an
        ensemble [K, t, ...], but time [t]. frames: the fields of Frames -> arrays. restart: path -> array, replaces the
        one before. info: added to the header's. Raises ValueError for names that differ from the first append's, or
        lengths that differ from time's.
        """
        series = {name: np.asarray(a) for name, a in flat(samples).items()}
        self._check(series, "time")
        poses = {f"pieces/{name}": np.asarray(a) for name, a in (frames or {}).items()}
        self._check(poses, "pieces/time")
        for name, array in (series | poses).items():
            self._pending.setdefault(name, []).append(array)
        self._names = (self._names or set()) | set(self._pending)
        if restart:
            self._restart = {name: np.asarray(a) for name, a in flat(restart).items()}
        self._info |= info or {}
        if self._is_due():
            self.flush()

    def write_restart(self, arrays):
        """Replace the restart state only: path -> array."""
        self.append({}, restart=arrays)

    def flush(self):
        """Bring all that was appended into the file. Raises RecordError if that fails; the file is then as before."""
        if not (self._pending or self._restart or self._info):
            return
        start = time.monotonic()
        self._commit()
        self._header = replace(self._header, info=self._header.info | self._info)
        self._pending, self._restart, self._info = {}, {}, {}
        self._last = time.monotonic()
        self._cost = self._last - start

    def close(self):
        """Flush."""
        self.flush()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _is_due(self):
        waited = time.monotonic() - self._last
        pending = sum(a.nbytes for arrays in self._pending.values() for a in arrays)
        return self._interval == 0 or waited >= max(self._interval, 20.0 * self._cost) or pending > PENDING_LIMIT

    def _check(self, arrays, clock):
        if not arrays:
            return
        known = {n for n in self._names or () if n.startswith("pieces/") == (clock == "pieces/time")}
        for name in arrays:
            _units(name)
        if known and known != set(arrays):
            raise ValueError(f"series {sorted(known ^ set(arrays))} must be in every append or in none")
        if clock not in arrays:
            raise ValueError(f"series {sorted(arrays)} need {clock}")
        count = len(arrays[clock])
        for name, array in arrays.items():
            axis = _time_axis(name, self._header)
            if array.ndim <= axis or array.shape[axis] != count or (axis and len(array) != self._header.run_count):
                raise ValueError(f"{name} of form {array.shape} does not fit {count} times of {clock}")

    def _commit(self):
        import h5py

        part = self._path.with_name(self._path.name + ".part")
        try:
            if self._exists:
                shutil.copyfile(self._path, part)
            with h5py.File(part, "r+" if self._exists else "w") as file:
                self._write(file)
            os.replace(part, self._path)
        except OSError as error:
            part.unlink(missing_ok=True)
            reason = error.strerror or str(error).splitlines()[0]
            raise RecordError(f"{self._path} cannot be written: {reason}") from error
        self._exists = True

    def _write(self, file):
        if not self._exists:
            _write_header(file, self._header)
        elif file.attrs["scene"] != self._header.scene:
            file.attrs["scene"] = self._header.scene
        if self._info:
            file.attrs["info"] = json.dumps(self._header.info | self._info)
        for name, arrays in self._pending.items():
            axis = _time_axis(name, self._header)
            _extend(file, name, np.concatenate(arrays, axis=axis), axis)
        if self._restart:
            _replace_group(file, "restart", self._restart)


# --- datasets ---


def _time_axis(name, header):
    return 0 if header.run_count is None or name in ("time", "pieces/time") else 1


def _units(name):
    keys = [key for key in UNITS if f"{name}/".startswith(f"{key}/")]
    if not keys:
        raise ValueError(f"series {name!r} is unknown; allowed: {', '.join(UNITS)}")
    return UNITS[max(keys, key=len)]


def _extend(file, name, array, axis):
    """Append to a dataset along an axis; it is made where it does not exist."""
    if name not in file:
        dtype = np.float64 if name in ("time", "pieces/time") else array.dtype
        shape = tuple(0 if i == axis else n for i, n in enumerate(array.shape))
        rows = max(1, min(CHUNK, 8192 // int(np.prod(array.shape[axis + 1 :], dtype=int) or 1)))
        chunks = tuple(min(n, 16) if i < axis else rows if i == axis else max(n, 1) for i, n in enumerate(array.shape))
        limits = tuple(None if i == axis else n for i, n in enumerate(array.shape))
        file.create_dataset(name, shape, dtype, chunks=chunks, maxshape=limits).attrs["units"] = _units(name)
    dataset = file[name]
    start = dataset.shape[axis]
    dataset.resize(start + array.shape[axis], axis=axis)
    dataset[(slice(None),) * axis + (slice(start, None),)] = array


def _replace_group(file, group, arrays):
    """Make a group hold just these arrays; those of the same form are overwritten, so that the file does not grow."""
    old = dict(_datasets(file.get(group, {})))
    for name in old.keys() - arrays.keys():
        del file[f"{group}/{name}"]
    for name, array in arrays.items():
        if name in old and (old[name].shape, old[name].dtype) == (array.shape, array.dtype):
            old[name][...] = array
            continue
        if name in old:
            del file[f"{group}/{name}"]
        file.create_dataset(f"{group}/{name}", data=array).attrs["units"] = _units(group)


def _datasets(group, prefix=""):
    """(path, dataset) of all datasets under a group."""
    for name, item in group.items():
        if hasattr(item, "items"):
            yield from _datasets(item, f"{prefix}{name}/")
        else:
            yield prefix + name, item


def flat(tree, prefix=""):
    """path -> array of nested dicts."""
    out = {}
    for name, item in tree.items():
        out |= flat(item, f"{prefix}{name}/") if isinstance(item, dict) else {prefix + name: item}
    return out


def _nested(flat):
    """group -> {name -> array} of the paths that have a group."""
    tree = {}
    for path, item in flat.items():
        group, _, name = path.partition("/")
        if name:
            tree.setdefault(group, {})[name] = item
        else:
            tree[group] = item
    return tree


def _series_of(run):
    """path -> array of all of a run's series."""
    series = {name: getattr(run, name) for name in SERIES} | {group: getattr(run, group) for group in SERIES_GROUPS}
    return flat({name: item for name, item in series.items() if item is not None})


# --- header and checks ---


def _write_header(file, header):
    for name, value in asdict(header).items():
        if name == "info":
            file.attrs[name] = json.dumps(value)
        elif name in ("groups", "blocks"):
            file.attrs.create(name, list(value), dtype=_text_type())
        elif value is not None:
            file.attrs[name] = value


def _text_type():
    import h5py

    return h5py.string_dtype()


def _read_header(file, path):
    values = {}
    for f in fields(Header):
        if f.name in file.attrs:
            values[f.name] = file.attrs[f.name]
        elif f.name not in ("run_count", "info"):
            raise RecordError(f"{path} is no run of dem_jax: it lacks the attribute {f.name!r}")
    for name in ("groups", "blocks", "gravity", "seed"):
        values[name] = tuple(values[name].tolist()) if np.ndim(values[name]) else values[name].item()
    for name in ("dt", "sample", "piece_count", "run_count"):
        if name in values:
            values[name] = values[name].item()
    values["info"] = json.loads(values.get("info", "{}"))
    return Header(**values)


def _require(file, header, path):
    needed = [f"{kind}/{group}" for group in header.groups for kind in ("force", "mean_force")]
    needed += [f"settled_mass/{block}" for block in header.blocks]
    if "pieces" in file:
        needed += [f"pieces/{f.name}" for f in fields(Frames)]
    missing = [name for name in needed if name not in file]
    if missing:
        raise RecordError(f"{path} lacks the dataset {missing[0]!r}")


def _check_lengths(run, path):
    for name, array in _series_of(run).items():
        axis = _time_axis(name, run.header)
        if array.ndim <= axis or array.shape[axis] != len(run.time):
            raise RecordError(f"{path} is damaged: {name!r} of form {array.shape} does not fit {len(run.time)} times")


def _check_writable(path):
    if not (os.access(path, os.W_OK) and os.access(path.absolute().parent, os.W_OK)):
        raise RecordError(f"{path} cannot be written: Permission denied")


@contextmanager
def _reading(path):
    """The open HDF5 file; whatever HDF5 finds wrong with it is one clear line."""
    import h5py

    if not Path(path).is_file():
        raise RecordError(f"{path}: there is no such file")
    if not h5py.is_hdf5(path):
        raise RecordError(f"{path} is not an HDF5 file (or its beginning is lost)")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except RecordError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, AttributeError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordError(f"{path} is damaged or cut short: {reason}") from error
