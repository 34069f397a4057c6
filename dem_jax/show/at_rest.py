"""When the pieces came to rest in a block, and how many of them still moved when the run ended."""

from typing import NamedTuple

import numpy as np

from dem_jax.build.pieces import goods_of, masses_of
from dem_jax.build.walls import walls_of
from dem_jax.errors import SceneError
from dem_jax.scene import Scene, parse
from dem_jax.scene.materials import material_table
from dem_jax.store.run import Run
from dem_jax.types import SETTLED_SPEED

FLIGHT = 0.1  # of its fall: by how much the velocity of a piece in flight may change otherwise
MASS_TOLERANCE = 1e-3  # of the lightest piece: masses that differ by less are the same


class Rest(NamedTuple):
    """How each of K runs came to rest.

    duration: [K] (s) from the first force until the settled mass has its final value for good; nan
        where nothing landed or settled, and where something still moved when the run ended.
    moving: [K] number of pieces that were not at rest at the end.
    observed: [K] (s) from the first force to the end of the run; nan where nothing landed.
    pieces: number of pieces of a run.
    """

    duration: np.ndarray
    moving: np.ndarray
    observed: np.ndarray
    pieces: int

    @property
    def is_complete(self) -> np.ndarray:
        """[K] whether all pieces were at rest at the end."""
        return self.moving == 0

    def describe(self) -> str:
        """What was not at rest at the end, in words; empty: nothing."""
        if self.is_complete.all():
            return ""
        if len(self.moving) > 1:
            runs = int((~self.is_complete).sum())
            return f"{runs} of {len(self.moving)} runs ended before all pieces were at rest"
        plural = "s" if self.pieces != 1 else ""
        return f"{self.moving[0]} of {self.pieces} piece{plural} not at rest at the end"

    def describe_bound(self) -> str:
        """Of a single run, what stands for the time to rest where it is not known: at least how long (ms), and why."""
        why = self.describe()
        return (
            f"> {1e3 * self.observed[0]:.4g} ms: {why}"
            if why and np.isfinite(self.observed[0])
            else why
        )


def find_rest(run: Run, group: str | None, block: str) -> Rest:
    """How the runs of a run or an ensemble came to rest in a block.

    Args:
        run: a run or an ensemble.
        group: wall group whose first force begins the time; None: there is none, and no durations.
        block: name of the block.
    """
    mass = np.asarray(run.settled_mass[block], np.float64)
    mass = mass.reshape(-1, mass.shape[-1])
    moving = _count_moving(run, block, mass[:, -1])
    none = np.full(len(mass), np.nan)
    observed, duration = none, none
    since = np.array([_start_of_final_value(row, run.time) for row in mass])
    if group is not None:
        force = np.asarray(run.mean_force[group])
        felt = np.any(force.reshape(len(mass), -1, 3) != 0, axis=-1)
        first = np.where(felt.any(axis=1), run.time[felt.argmax(axis=1)], np.nan)
        observed = run.time[-1] - first
        known = (mass[:, -1] > 0) & (moving == 0)
        duration = np.where(known, np.maximum(0.0, since - first), np.nan)
        duration = np.where(np.isnan(first), np.nan, duration)
    return Rest(duration, moving, observed, run.header.piece_count)


def _start_of_final_value(mass: np.ndarray, time: np.ndarray) -> float:
    """Time (s) from which on the settled mass [T] (kg) has its final value."""
    unsettled = np.flatnonzero(mass < mass[-1] * (1 - 1e-6))
    return float(time[unsettled[-1] + 1] if len(unsettled) else time[0])


def _count_moving(run: Run, block: str, settled: np.ndarray) -> np.ndarray:
    """[K] pieces that are not at rest at the end, other than those in another block.

    As the run counted them, or by the last poses; else by the mass that has not settled, where all
    pieces are to settle in the block. settled: [K] (kg), at the end.
    """
    at_top = np.atleast_2d(_rises_or_falls(run)).sum(axis=-1)
    if block in run.info.get("moving", {}):
        return np.ravel(run.info["moving"][block]) + at_top
    try:
        scene = parse(run.scene, "the file's scene")
    except SceneError:  # of another version: nothing is known of its pieces
        return at_top + np.zeros(len(settled), int)
    final = _find_final_motion(run)
    if final is None:
        return _count_missing(run, scene, settled)
    position, speed = final
    moves = speed >= SETTLED_SPEED
    if len(run.settled_mass) > 1:
        for other in walls_of(scene)[3]:
            if other.name != block:
                inside = (position >= np.array(other.low)) & (position <= np.array(other.high))
                moves &= ~inside.all(axis=-1)
    return moves.sum(axis=-1).reshape(len(settled)) + at_top


def _rises_or_falls(run: Run) -> np.ndarray:
    """[.., N] whether a piece is at the top of a bounce at the end, by the stored poses.

    It is slow there, but was not before in the same flight: since then its velocity changed by gravity alone.
    """
    frames, gravity = run.pieces, np.asarray(run.header.gravity)
    still = np.zeros(1, bool)
    if frames is None or not gravity.any() or len(frames.time) < 2:
        return still
    span = 2 * SETTLED_SPEED / np.linalg.norm(gravity)
    velocity = np.asarray(frames.velocity, np.float64)
    slow = np.linalg.norm(np.take(velocity, -1, axis=-3), axis=-1) < SETTLED_SPEED
    flies, was_fast = slow, np.zeros_like(slow)
    for k in range(len(frames.time) - 1, 0, -1):
        if frames.time[k] > run.time[-1] + run.sample or frames.time[-1] < run.time[-1] - span:
            return still
        fall = gravity * (frames.time[k] - frames.time[k - 1])
        change = np.take(velocity, k, axis=-3) - np.take(velocity, k - 1, axis=-3)
        flies = flies & (np.linalg.norm(change - fall, axis=-1) < FLIGHT * np.linalg.norm(fall))
        was_fast = was_fast | (
            flies & (np.linalg.norm(np.take(velocity, k - 1, axis=-3), axis=-1) >= SETTLED_SPEED)
        )
        if run.time[-1] - frames.time[k - 1] > span:
            break
    return was_fast


def _find_final_motion(run: Run) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions [.., N, 3] (m) and speeds [.., N] (m/s) at the end, of pieces outside the scene nan; None: not stored."""
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
    """[K] fewest pieces that the mass that has not settled can be of; 0 where not all pieces are to settle in one block."""
    if scene.feeder or scene.inlet or scene.outlet or scene.cycle:
        return np.zeros(len(settled), int)
    found = []
    for k, mass in enumerate(settled):
        own = parse(run.member(k).scene, "the file's scene") if run.parameters else scene
        pieces = np.sort(masses_of(goods_of(own), material_table(own)))[::-1]
        missing = pieces.sum() - mass - MASS_TOLERANCE * pieces[-1]
        found.append(int(np.searchsorted(np.cumsum(pieces), missing)) + 1 if missing > 0 else 0)
    return np.array(found)
