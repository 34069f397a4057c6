"""The load cell of a scale behind a force that is known: a mass on a spring and a damper on a base
that may shake.

    (m + p) (x'' + a) + c x' + k x = F,    reading = (k x + c x') / g

m is the mass of the empty bucket, p the product that lies in it, a the acceleration of the base, F
the force of the product. The scheme is that of ``dem_jax.dynamics.load_cell_oscillator``: velocity
Verlet with the damper in the kick, exact in momentum and of second order.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from dem_jax.errors import RecordError
from dem_jax.io.run_data import STANDARD_GRAVITY
from dem_jax.scene import LoadCell, load_section

SECTION = "weigh_bucket.load_cell"
STEPS_PER_PERIOD = 150  # of the cell: its frequency is then (2 pi / 150)^2 / 24 = 7e-5 too high


class Cell(NamedTuple):
    """A load cell; each value a number or [K], one for each run.

    mass: (kg) without product. stiffness: (N/m). damping: (N s/m).
    """

    mass: np.ndarray | float
    stiffness: np.ndarray | float
    damping: np.ndarray | float

    @property
    def frequency(self) -> np.ndarray:
        """Natural frequency (Hz) of the mass without product."""
        return np.sqrt(np.asarray(self.stiffness) / self.mass) / (2 * np.pi)

    @property
    def decay(self) -> np.ndarray:
        """Rate (1/s) at which the ringing of the mass without product decays."""
        return np.asarray(self.damping) / (2 * np.asarray(self.mass))

    @property
    def damping_ratio(self) -> np.ndarray:
        """Damping ratio: the damping over the critical damping of the mass without product."""
        return self.decay / (2 * np.pi * self.frequency)


def read_cell_file(path: str) -> LoadCell:
    """The section of a load cell: "typical", a file of calibrate cell (.json), or a TOML file of
    its keys.

    Raises SceneError, and RecordError for a file that is not one of calibrate cell.
    """
    if path == "typical":
        return LoadCell()
    if not path.lower().endswith(".json"):
        return load_section(path, LoadCell, SECTION)
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: cannot be read ({error})") from None
    rows = found.get("parameters", {}) if isinstance(found, dict) else {}
    values = {}
    for name in ("mass", "natural_frequency", "damping_ratio"):
        row = rows.get(name) if isinstance(rows, dict) else None
        if not isinstance(row, dict) or not isinstance(row.get("value"), int | float):
            raise RecordError(f"{path}: {name} is missing; allowed: a file of calibrate cell")
        values[name] = row["value"]
    try:
        return LoadCell(**values)
    except ValidationError as error:
        first = error.errors()[0]
        raise RecordError(f"{path}: {first['loc'][0]} = {first['input']}: {first['msg']}") from None


def build_cell(section: LoadCell) -> Cell:
    """The cell of a scene's section."""
    return Cell(section.mass, section.spring_stiffness(), section.damping_constant())


def simulate_cell(
    weight: np.ndarray,
    rate: float,
    cell: Cell,
    load: np.ndarray | float = 0.0,
    gravity: float = STANDARD_GRAVITY,
) -> np.ndarray:
    """The signal of a cell at rest at first, under a force on a held bucket.

    Args:
        weight: [.., n] (kg) the force over g, means over intervals of 1 / rate.
        rate: samples per second.
        cell: the load cell.
        load: [.., n] or a number (kg): product that lies in the bucket and moves with it.
        gravity: (m/s2) that converts forces to kg.

    Returns:
        [.., n] (kg): means of the signal over the same intervals.
    """
    values = np.asarray(weight, np.float64)
    parts = count_substeps(cell, rate)
    rows = np.repeat(values.reshape(-1, values.shape[-1]), parts, axis=-1) * gravity
    edges = np.pad(rows, [(0, 0), (1, 1)], mode="edge")
    force = 0.5 * (edges[:, 1:] + edges[:, :-1])
    force[:, 0] = 0.5 * rows[:, 0]
    mass = _load_at_edges(load, values.shape, parts)
    signal = integrate_cell(cell, force, mass, 1 / (rate * parts))
    return (interval_means(signal, parts) / gravity).reshape(values.shape)


def integrate_cell(
    cell: Cell, push: np.ndarray, load: np.ndarray | float, step: float
) -> np.ndarray:
    """Force of spring and damper (N) at the edges of n steps, [K, n + 1], of a cell at rest at
    first.

    Args:
        cell: the load cell.
        push: [K, n + 1] (N) at the edges; force of the product minus (m + p) a.
        load: [K, n + 1] or a number (kg), product that moves with the bucket.
        step: (s).
    """
    column = lambda x: (
        np.broadcast_to(np.reshape(np.asarray(x, np.float64), (-1, 1)), (len(push), 1)).T
    )
    mass = (column(cell.mass) + (np.asarray(load).T if np.ndim(load) else load)) + np.zeros(
        push.T.shape
    )
    spring, damper = column(cell.stiffness)[0], column(cell.damping)[0]
    lag = 0.25 * step * damper / mass
    keep, gain = (1 - lag) / (1 + lag), 0.5 * step / mass / (1 + lag)
    twice, both = keep**2, (keep + 1) * gain
    pushes = np.ascontiguousarray(push.T)
    x, v = np.zeros(len(push)), np.zeros(len(push))
    deflection, before, net = np.empty_like(pushes), np.empty_like(pushes), np.empty_like(pushes)
    for i in range(len(pushes)):
        deflection[i], before[i] = x, v
        pull = net[i] = pushes[i] - spring * x
        v = twice[i] * v + both[i] * pull
        x = x + step * v
    velocity = keep * before + gain * net
    return (spring * deflection + damper * velocity).T


def count_substeps(cell: Cell | None, rate: float, highest: float = 0.0) -> int:
    """Number of integration steps in an interval of 1 / rate.

    cell: load cell, or None; highest: (Hz) highest frequency of its excitation.
    """
    own = 0.0 if cell is None else STEPS_PER_PERIOD * float(np.max(cell.frequency))
    return max(1, int(np.ceil(max(own, 40.0 * highest) / rate)))


def interval_means(edges: np.ndarray, parts: int) -> np.ndarray:
    """Means over intervals of ``parts`` steps, [.., n], of values at the edges of the steps, [.., n
    parts + 1].
    """
    middle = 0.5 * (edges[..., 1:] + edges[..., :-1])
    return middle.reshape(*middle.shape[:-1], -1, parts).mean(axis=-1)


def _load_at_edges(
    load: np.ndarray | float, shape: tuple[int, ...], parts: int
) -> np.ndarray | float:
    """Product at the edges of the steps, [K, n parts + 1], or the number that it is."""
    if np.ndim(load) == 0:
        return float(load)
    rows = np.repeat(np.broadcast_to(load, shape).reshape(-1, shape[-1]), parts, axis=-1)
    return np.concatenate([rows[:, :1], rows], axis=-1)
