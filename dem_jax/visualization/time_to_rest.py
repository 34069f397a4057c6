"""Times at which pieces came to rest in a block, and numbers of pieces that still moved at the end
of the run."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
from dem_jax.assembly.wall_panels import lay_out_walls
from dem_jax.errors import SceneError
from dem_jax.io.run_data import Run
from dem_jax.scene import Scene, parse_scene
from dem_jax.scene.material_properties import build_material_table
from dem_jax.types import SETTLED_SPEED

QUIET_TIME = 0.02  # s for which pieces must be slow to count as at rest, as run.settled_time
ROUNDING = 1e-6  # of the settled mass, in single precision
MASS_TOLERANCE = 1e-3  # of the lightest piece: masses that differ by less are the same


class RestState(NamedTuple):
    """Rest of each of K runs.

    duration: [K] (s) from the first force until the settled mass has its final value for good; nan
    where nothing landed or settled, and where something still moved when the run ended.
    moving_count: [K] number of pieces that were not at rest at the end: fast, or slow for less than
    the window.
    slow_count: [K] number of those that were slow at the end.
    window: (s) for which a piece must be slow to be at rest.
    observed_time: [K] (s) from the first force to the end of the run; nan where nothing landed.
    pieces: number of pieces of a run.
    """

    duration: np.ndarray
    moving_count: np.ndarray
    slow_count: np.ndarray
    window: float
    observed_time: np.ndarray
    pieces: int

    @property
    def is_complete(self) -> np.ndarray:
        """[K] whether all pieces were at rest at the end."""
        return self.moving_count == 0

    def describe(self) -> str:
        """Describe the pieces or runs that were not at rest at the end; empty: there are none."""
        if self.is_complete.all():
            return ""
        if len(self.moving_count) > 1:
            runs = int((~self.is_complete).sum())
            return f"{runs} of {len(self.moving_count)} runs ended before all pieces were at rest"
        plural = "s" if self.pieces != 1 else ""
        said = f"{self.moving_count[0]} of {self.pieces} piece{plural} not at rest at the end"
        if not self.slow_count[0]:
            return said
        return f"{said} ({self.slow_count[0]} slower than {SETTLED_SPEED:g} m/s there, but for less than {1e3 * self.window:.0f} ms)"

    def describe_bound(self) -> str:
        """Describe the time to rest of a single run where it is not known: a lower bound (ms), and
        the reason.
        """
        why = self.describe()
        return (
            f"> {1e3 * self.observed_time[0]:.4g} ms: {why}"
            if why and np.isfinite(self.observed_time[0])
            else why
        )


def find_rest(run: Run, group: str | None, block: str) -> RestState:
    """Find the rest of a run, or of each run of an ensemble, in a block.

    Args:
        run: a run or an ensemble.
        group: wall group whose first force begins the time; None: there is none, and no durations.
        block: name of the block.
    """
    mass = np.asarray(run.settled_mass[block], np.float64)
    mass = mass.reshape(-1, mass.shape[-1])
    window = _rest_window(run)
    slowed = _count_slow(run, mass, window)
    moving = np.minimum(_count_fast(run, block, mass[:, -1]) + slowed, run.piece_counts)
    none = np.full(len(mass), np.nan)
    observed, duration = none, none
    since = np.array([_final_value_start(row, run.time) for row in mass])
    if group is not None:
        force = np.asarray(run.mean_force[group])
        felt = np.any(force.reshape(len(mass), -1, 3) != 0, axis=-1)
        first = np.where(felt.any(axis=1), run.time[felt.argmax(axis=1)], np.nan)
        observed = run.time[-1] - first
        known = (mass[:, -1] > 0) & (moving == 0)
        duration = np.where(known, np.maximum(0.0, since - first), np.nan)
        duration = np.where(np.isnan(first), np.nan, duration)
    return RestState(duration, moving, slowed, window, observed, run.header.piece_count)


def _final_value_start(mass: np.ndarray, time: np.ndarray) -> float:
    """Time (s) from which on the settled mass [T] (kg) has its final value."""
    unsettled = np.flatnonzero(mass < mass[-1] * (1 - ROUNDING))
    return float(time[unsettled[-1] + 1] if len(unsettled) else time[0])


def _rest_window(run: Run) -> float:
    """Time (s) for which a piece must be slow to be at rest: longer than at the top of a bounce."""
    gravity = float(np.linalg.norm(run.header.gravity))
    return max(QUIET_TIME, 2 * SETTLED_SPEED / gravity) if gravity else QUIET_TIME


def _count_slow(run: Run, settled: np.ndarray, window: float) -> np.ndarray:
    """[K] least number of pieces that are slow at the end, but were not during the whole window
    before.

    settled: [K, T] (kg), the settled mass, which lacked these pieces at some time in the window.
    """
    last = settled[:, run.time > run.time[-1] - window - 1e-3 * run.sample]
    missing = settled[:, -1] - last.min(axis=-1)
    counts, masses_of_run = np.zeros(len(settled), int), _piece_masses(run)
    for k in np.flatnonzero(missing > ROUNDING * settled[:, -1]):
        own = masses_of_run(int(k))
        counts[k] = 1 if own is None else _fewest_pieces(own, missing[k])
    return counts


def _piece_masses(run: Run) -> Callable[[int], np.ndarray | None]:
    """Run k -> masses (kg) of its pieces, each scene read once; None where the scene of the file is
    of another version.
    """

    @cache
    def read_masses(text: str) -> np.ndarray | None:
        try:
            scene = parse_scene(text, "the file's scene")
        except SceneError:
            return None
        return compute_masses(build_piece_set(scene), build_material_table(scene))

    return lambda k: read_masses(run.member(k).scene if run.parameters else run.scene)


def _fewest_pieces(masses: np.ndarray, mass: float) -> int:
    """The least number of pieces of these masses (kg) that can make up a mass (kg)."""
    missing = mass - MASS_TOLERANCE * masses.min()
    if missing <= 0:
        return 0
    return int(np.searchsorted(np.cumsum(np.sort(masses)[::-1]), missing)) + 1


def _count_fast(run: Run, block: str, settled: np.ndarray) -> np.ndarray:
    """[K] pieces that are fast at the end, other than those in another block.

    The number comes from the run's own count or the last poses, otherwise from the mass that has
    not settled, if all pieces must settle in the block. settled: [K] (kg), at the end.
    """
    if block in run.info.get("moving", {}):
        return np.ravel(run.info["moving"][block])
    try:
        scene = parse_scene(run.scene, "the file's scene")
    except SceneError:  # of another version: nothing is known of its pieces
        return np.zeros(len(settled), int)
    final = _find_final_motion(run)
    if final is None:
        return _count_missing(run, scene, settled)
    position, speed = final
    moves = speed >= SETTLED_SPEED
    if len(run.settled_mass) > 1:
        for other in lay_out_walls(scene)[3]:
            if other.name != block:
                inside = (position >= np.array(other.low)) & (position <= np.array(other.high))
                moves &= ~inside.all(axis=-1)
    return moves.sum(axis=-1).reshape(len(settled))


def _find_final_motion(run: Run) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions [.., N, 3] (m) and speeds [.., N] (m/s) at the end, nan for pieces outside the
    scene; None: not stored.
    """
    frames = run.pieces
    if frames is None or len(frames.time) < 2:
        return None
    last = int(np.searchsorted(frames.time, run.time[-1] + run.sample, side="right")) - 1
    if last < 1 or run.time[-1] - frames.time[last] > 2 * (frames.time[1] - frames.time[0]):
        return None
    at_end = (np.take(array, last, axis=-3) for array in (frames.position, frames.velocity))
    position, velocity = at_end
    return position, np.linalg.norm(velocity, axis=-1)


def _count_missing(run: Run, scene: Scene, settled: np.ndarray) -> np.ndarray:
    """[K] least number of pieces that can make up the mass that has not settled; 0 if not all
    pieces must settle in one block.
    """
    if scene.feeder or scene.inlet or scene.outlet or scene.cycle:
        return np.zeros(len(settled), int)
    found, masses_of_run = [], _piece_masses(run)
    for k, mass in enumerate(settled):
        masses = masses_of_run(k)
        assert masses is not None, "the scene was read before"
        found.append(_fewest_pieces(masses, masses.sum() - mass))
    return np.array(found)
