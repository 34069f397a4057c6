"""What a trial of the stress campaign is, and the invariants that it is held against.

A trial is a scene, and what may come of it: a run whose series are finite, whose energy does not
grow, whose momentum balances and whose pieces stay out of each other; or, where the scene asks for
what cannot be, one line that says so.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dem_jax import SceneError, SimulationError, ensemble, simulate
from dem_jax.io.run_files import Run, collect_series
from dem_jax.scene import Scene

GROWTH = 0.01  # of the largest energy that a run had: more from nothing is a fault
DEEP = 0.5  # of a piece's width: deeper overlaps are one line, of the guard
BALANCE = {"f32": 3e-4, "f64": 1e-9}  # of the momentum that went through the walls


@dataclass(frozen=True)
class Trial:
    """A scene, and how it is looked at."""

    name: str
    scene: Callable[[], Scene]
    refused: bool = False  # one line is what is right
    runs: int = 0  # of an ensemble; 0: a single run
    growth: float = GROWTH  # what of the energy may come from nothing: near the largest step, what
    # is warned of
    figure: Callable[[Run], dict[str, float]] | None = None  # what else is told
    check: Callable[[Run], str | None] | None = None  # what else is wrong


@dataclass(frozen=True)
class Outcome:
    """What came of a trial."""

    trial: Trial
    ended: str  # "run", "one line"
    faults: tuple[str, ...]
    figures: dict[str, float]
    words: str = ""


def tried(trial: Trial) -> Outcome:
    """Run a trial. Other errors than those of a scene or a run are faults as well."""
    try:
        scene = trial.scene()
        run = ensemble(scene, runs=trial.runs) if trial.runs else simulate(scene)
    except (SceneError, SimulationError) as error:
        lines = str(error).splitlines()
        faults = () if trial.refused else (f"refused: {lines[0]}",)
        return Outcome(
            trial,
            "one line",
            faults + (("more than one line",) if len(lines) > 1 else ()),
            {},
            lines[0],
        )
    except Exception as error:
        return Outcome(trial, "traceback", (f"{type(error).__name__}: {str(error)[:200]}",), {})
    faults, figures = looked_at(run, scene, trial)
    return Outcome(trial, "run", (*faults, *(("accepted",) if trial.refused else ())), figures)


def looked_at(run: Run, scene: Scene, trial: Trial) -> tuple[tuple[str, ...], dict[str, float]]:
    """Faults and figures of a run or an ensemble."""
    bad = [name for name, array in collect_series(run).items() if not np.isfinite(array).all()]
    if bad:
        return (f"not finite: {', '.join(bad)}",), {}
    figures = {
        "energy": energy_growth(run),
        "momentum": momentum_error(run, scene),
        "overlap": float(np.max(run.max_relative_overlap)),
    }
    figures |= trial.figure(run) if trial.figure else {}
    faults = []
    if figures["energy"] > trial.growth:
        faults.append(f"energy from nothing: {figures['energy']:.2g}")
    if figures["momentum"] > BALANCE[scene.run.precision]:
        faults.append(f"momentum off by {figures['momentum']:.2g}")
    if figures["overlap"] > DEEP:
        faults.append(f"overlap {figures['overlap']:.2g} of the width")
    if trial.check and (wrong := trial.check(run)):
        faults.append(wrong)
    return tuple(faults), figures


def energy_growth(run: Run) -> float:
    """What energy came from nothing, of the largest kinetic, elastic and dissipated energy that
    there was: how far motion, place and springs hold more than they did at any time before, with
    what walls did since.
    """
    e = {name: np.asarray(array, float) for name, array in run.energy.items()}
    held = e["kinetic"] + e["potential"] + e["elastic"] - e["wall_work"]
    scale = np.max(e["kinetic"] + e["elastic"] + np.abs(e["dissipated"]), axis=-1)
    rise = np.max(held - np.minimum.accumulate(held, axis=-1), axis=-1)
    return float(np.max(rise / np.maximum(scale, 1e-300)))


def momentum_error(run: Run, scene: Scene) -> float:
    """How far the change of momentum in each sample is from what gravity and walls gave, of all
    that went through walls.
    """
    if run.run_count is not None:
        return max(momentum_error(run.member(k), scene) for k in range(run.run_count))
    force = sum(np.asarray(f, float) for f in run.mean_force.values()) * scene.run.sample_interval
    momentum = np.asarray(run.momentum, float)
    change, gravity = (
        np.diff(momentum, axis=0),
        np.asarray(scene.run.gravity, float) * scene.run.sample_interval,
    )
    mass = 0.0
    if gravity.any():  # of all pieces: from samples without any force
        flight = np.abs(force[1:]).sum(-1) == 0
        if not flight.any():
            return 0.0
        mass = float(np.median(change[flight] @ gravity) / (gravity @ gravity))
    off = np.abs(change - (mass * gravity - force[1:])).max()
    through = np.abs(np.cumsum(force, axis=0)).max() + np.abs(momentum).max()
    return float(off / max(through, 1e-300))
