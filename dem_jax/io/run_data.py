"""A run as a person reads it: numpy arrays by name."""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import lock_file
from dem_jax.io.datasets import FileName, flatten_tree, nest_paths, time_axis
from dem_jax.io.former_datasets import find_former_name
from dem_jax.io.header import RunHeader
from dem_jax.io.writer import Writer

STANDARD_GRAVITY = 9.81  # m/s2, as the paper; converts a force to kg in a scene without gravity


@dataclass(frozen=True, eq=False)
class Frames:
    """Stored poses; an ensemble has a leading run axis on all but time.

    time: [F] (s). position: [F, N, 3] (m) centres of mass. orientation: [F, N, 4] quaternions w x y
    z, body to world. velocity: [F, N, 3] (m/s). angular_velocity: [F, N, 3] (rad/s), world frame.
    """

    time: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


@dataclass(frozen=True, eq=False)
class Run:
    """A run, or an ensemble of K runs, whose series except time have a leading axis of length K.

    time: [T] (s) since the release of the portion. series: by the names of the quantities
    (dynamics.standard_quantities and those of the user); each is an attribute too: ``run.force`` is
    group -> [T, 3] (N), ``run.momentum`` is [T, 3] (kg m/s). Series that a run does not have are
    {}, or None for a quantity that is one array. pieces: stored poses or None. restart: path ->
    array, the state for a resume. settled: time (s) at which the run ended because all pieces were
    at rest (``run.until_settled``), else None. parameters: keys of the scene that differ between
    the runs of an ensemble -> [K, ..] values; {}: none. header: scene, seed, time step and other
    metadata; its fields are attributes of the run too.
    """

    header: RunHeader
    time: np.ndarray
    series: dict[str, Any]
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
    parameters = property(
        lambda self: {
            key: np.array(values) for key, values in self.info.get("parameters", {}).items()
        }
    )
    settled = property(lambda self: self.info.get("settled"))

    @property
    def piece_counts(self) -> np.ndarray:
        """Number of pieces of each run of an ensemble, [K], or of a single run, [1]."""
        counts = self.info.get("piece_counts", [self.header.piece_count])
        return np.broadcast_to(counts, (self.run_count or 1,))

    def __getattr__(self, name: str) -> Any:
        found = self.__dict__
        if name.startswith("_") or "series" not in found:  # while it is unpickled
            raise AttributeError(name)
        if name in found["series"]:
            return found["series"][name]
        known = {stored.name: stored for stored in self.header.stored_quantities}
        if name not in known:
            if now := find_former_name("Run", name):
                return getattr(self, now)
            raise AttributeError(f"the run has no {name!r}; it has: {', '.join(known)}")
        return None if known[name].labels is None else {}

    def save(self, path: FileName, overwrite: bool = False) -> None:
        """Write the run to an HDF5 file. Raises RecordError if it exists, unless overwrite, or
        cannot be written.
        """
        with lock_file(path), Writer.create(path, self.header, overwrite) as writer:
            frames = None if self.pieces is None else vars(self.pieces)
            writer.append(collect_series(self), frames, self.restart)

    def pif_kg(self, group: str, mean: bool = True) -> np.ndarray:
        """Product impact force over g, eq. 24, on a wall group: the force along gravity over its
        magnitude.

        Without gravity, the downward force over 9.81 m/s2.

        Args:
            group: name of the wall group.
            mean: means over the sample intervals instead of instantaneous values.

        Returns:
            [T] (kg).

        Raises:
            RecordError: the run does not have the group.
        """
        forces = self.mean_force if mean else self.force
        gravity = self._reference_gravity()
        return _find_group_force(forces, group).astype(np.float64) @ (gravity / (gravity @ gravity))

    def peak_kg(self, group: str) -> np.ndarray | None:
        """Largest ``pif_kg`` over all steps of each sample interval, on a wall group.

        Returns:
            [T] (kg), or None for a file of an older version without it.

        Raises:
            RecordError: the run does not have the group.
        """
        peaks = self.series.get("peak_force")
        return (
            None
            if peaks is None
            else _find_group_force(peaks, group).astype(np.float64)
            / np.linalg.norm(self._reference_gravity())
        )

    def _reference_gravity(self) -> np.ndarray:
        """Gravity of the scene, [3] (m/s2); without any, standard gravity, by which forces are
        expressed as weights."""
        gravity = np.asarray(self.header.gravity, np.float64)
        return gravity if gravity.any() else np.array([0.0, 0.0, -STANDARD_GRAVITY])

    def member(self, k: int) -> "Run":
        """Run k of an ensemble, as a single run. Raises RecordError if there is none."""
        if self.run_count is None:
            raise RecordError(f"run {k!r} was asked for, but this is a single run")
        if not 0 <= k < self.run_count:
            raise RecordError(
                f"run {k!r} is not in this ensemble; it has 0 to {self.run_count - 1}"
            )
        pieces = self.pieces
        if pieces is not None:
            own = slice(None, int(self.piece_counts[k]))
            pieces = Frames(
                pieces.time,
                **{n: a[k][..., own, :] for n, a in vars(pieces).items() if n != "time"},
            )
        seed = self.seed[k] if np.ndim(self.seed) else self.seed
        series = nest_paths({name: array[k] for name, array in flatten_tree(self.series).items()})
        return Run(
            replace(self.header, seed=seed, run_count=None, **self._member_header(k)),
            self.time,
            series,
            pieces,
        )

    def _member_header(self, k: int) -> dict[str, Any]:
        """The header fields of one run that differ from those of the ensemble."""
        values, info = self.info.get("parameters"), dict(self.info)
        if np.ndim(next(iter(info.get("piece_masses", ())), 0.0)):
            info["piece_masses"] = info["piece_masses"][k]
        if "moving" in info:
            info["moving"] = {block: counts[k] for block, counts in info["moving"].items()}
        if not values:
            return {"info": info}
        from dem_jax.scene import parse_scene
        from dem_jax.scene.material_properties import keep_modulus_ranges

        info = {
            name: said
            for name, said in info.items()
            if name not in ("parameters", "steps", "piece_counts")
        }
        whole = parse_scene(self.scene, "the ensemble's scene")
        scene = whole.replace(
            keep_modulus_ranges(whole, {key: each[k] for key, each in values.items()})
        )
        count = int(self.piece_counts[k])
        return {
            "scene": scene.to_toml(),
            "info": info,
            "dt": self.info["steps"][k],
            "piece_count": count,
        }


def _find_group_force(forces: dict[str, np.ndarray], group: str) -> np.ndarray:
    """The force on a wall group. Raises RecordError if there is none."""
    if group not in forces:
        raise RecordError(
            f"group = {group!r} is not in this run; it has: {', '.join(forces) or 'none'}"
        )
    return forces[group]


def collect_series(run: Run) -> dict[str, np.ndarray]:
    """path -> array of time and of all of a run's series."""
    return {"time": run.time} | flatten_tree(run.series)


def assemble_run(
    header: RunHeader,
    parts: dict[str, list[np.ndarray]],
    restart: dict[str, np.ndarray] | None = None,
) -> Any:
    """The run from path -> [array, ...], pieces along the time axis; None if there are no samples."""
    series = {
        name: np.concatenate(arrays, axis=time_axis(name, header)) for name, arrays in parts.items()
    }
    if "time" not in series:
        return None
    pieces = (
        Frames(**{f.name: series.pop(f"pieces/{f.name}") for f in fields(Frames)})
        if "pieces/time" in series
        else None
    )
    return Run(header, series.pop("time"), nest_paths(series), pieces, restart or {})
