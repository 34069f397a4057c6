"""What an ensemble consists of, before it is set up: its scene, and seed and parameters of each run."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.runner.job_setup import validate_seed
from dem_jax.runner.parameter_sweep import draw_parameters
from dem_jax.runner.uncertain_draws import draw_uncertain_numbers
from dem_jax.scene import Scene, load_scene

MOST_RUNS = 10**6  # of an ensemble: more need too much memory for their setup


@dataclass(frozen=True, eq=False)
class EnsemblePlan:
    """The K runs of an ensemble. Plans of one digest are equal."""

    scene: Scene
    seeds: tuple[int, ...]  # [K]
    parameters: dict[str, list[Any]] | None  # key -> [K] values

    @cached_property
    def digest(self) -> str:
        """Digits that differ if anything of the plan does."""
        told = [self.scene.to_toml(), self.seeds, self.parameters]
        return sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, EnsemblePlan) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def plan_ensemble(
    scene: Scene | Any,
    runs: int | None = None,
    seed: int | Sequence[int] = 0,
    parameters: Mapping[str, Any] | None = None,
    uncertain: bool = False,
) -> EnsemblePlan:
    """The runs of an ensemble. Arguments and errors as ``interface.ensemble``."""
    if runs is not None and not 1 <= runs <= MOST_RUNS:
        raise SceneError(f"runs = {runs}: allowed: a whole number from 1 to {MOST_RUNS}")
    listed = np.ndim(seed) > 0
    given = [validate_seed(one) for one in (np.asarray(seed).ravel() if listed else [seed])]
    first = given[0] if given else 0
    values = draw_parameters(parameters or {}, np.size(seed) if listed else runs, first)
    count = (
        len(next(iter(values.values())))
        if values
        else np.size(seed)
        if listed
        else 64
        if runs is None
        else int(runs)
    )
    if not count or (listed and runs not in (None, count)):
        raise SceneError(
            f"seed: {np.size(seed)} of them; allowed: one, or one for each of {runs or 'at least one'} run(s)"
        )
    seeds = tuple(given) if listed else tuple(range(first, first + count))
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    if uncertain:
        scene, values = draw_uncertain_numbers(scene, count, first, values)
    return EnsemblePlan(scene, seeds, values or None)
