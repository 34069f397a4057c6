"""An ensemble whose runs differ in more than their seed: keys of the scene with a value for each
run.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import assembly
from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.scene.former_keys import accept_keys
from dem_jax.scene.messages import shorten_value
from dem_jax.types import System

Values = Mapping[str, Any]  # dotted key of a scene -> a value for each run, or a distribution of
# scipy.stats
FIXED_SECTIONS, VARIABLE_RUN_KEY = (
    ("run", "name", "base"),
    "run.time_step",
)  # sections that are the same
# in the whole ensemble, except this key
FILE_KEYS = ("stl", "flap_stl", "table", "unit", "rotate_deg", "move")  # keys of a file and of how
# it is read


@dataclass(frozen=True)
class ParameterSweep:
    """Parameters and systems of K runs that differ."""

    parameters: dict[str, list[Any]]  # dotted key -> [K] values, plain
    built: tuple[assembly.AssembledSystem, ...]  # [K], the same for runs that differ in their seed
    # alone
    leaves: dict[int, np.ndarray]  # number of a leaf of System -> [K, ..], of those that are not
    # the same in all runs

    def scene_for_run(self, scene: Scene, run: int) -> Scene:
        """The scene of a run, from that of the ensemble."""
        return scene.replace(self.values_for_run(run))

    def values_for_run(self, run: int) -> dict[str, Any]:
        """key -> its value in a run."""
        return {key: values[run] for key, values in self.parameters.items()}

    def system_for_run(self, system: System, run: int) -> System:
        """The system of a run, from that of the first."""
        leaves, structure = jax.tree.flatten(system)
        return jax.tree.unflatten(
            structure,
            [self.leaves[k][run] if k in self.leaves else x for k, x in enumerate(leaves)],
        )

    def stack_system(self, system: System) -> System:
        """The systems of all runs as one tree, with a leading run axis on the leaves that differ."""
        leaves, structure = jax.tree.flatten(system)
        return jax.tree.unflatten(
            structure, [jnp.asarray(self.leaves.get(k, x)) for k, x in enumerate(leaves)]
        )

    def mark_leaves(self, system: System, differs: Any, same: Any) -> Any:
        """A tree like the system that marks the leaves that differ."""
        leaves, structure = jax.tree.flatten(system)
        return jax.tree.unflatten(
            structure, [differs if k in self.leaves else same for k, _ in enumerate(leaves)]
        )

    def select_runs(self, runs: slice) -> "ParameterSweep":
        """The sweep of some of the runs."""
        parameters = {key: values[runs] for key, values in self.parameters.items()}
        return replace(
            self,
            parameters=parameters,
            built=self.built[runs],
            leaves={k: x[runs] for k, x in self.leaves.items()},
        )


def draw_parameters(values: Values, runs: int | None, seed: int) -> dict[str, list[Any]]:
    """Draw a value of each key for each run.

    Args:
        values: key -> list of values, or a distribution with ``rvs``.
        runs: number of runs; None: as many as values are listed.
        seed: of the distributions.

    Raises:
        SceneError: the number of values is not that of the runs.
    """
    values = accept_keys(values)
    counts = {key: len(value) for key, value in values.items() if not hasattr(value, "rvs")}
    runs = runs if runs is not None else next(iter(counts.values()), 64)
    for key, count in counts.items():
        if count != runs:
            raise SceneError(
                f"parameters: {key} has {count} values; allowed: {runs}, one for each run"
            )
    random = np.random.default_rng(seed)
    return {
        key: _to_plain_lists(v.rvs(size=runs, random_state=random) if hasattr(v, "rvs") else v)
        for key, v in values.items()
    }


def _to_plain_lists(values: Any) -> list[Any]:
    """Values as plain numbers, texts and lists, as a file keeps them."""
    return [
        value.tolist() if isinstance(value, np.ndarray | np.generic | jax.Array) else value
        for value in values
    ]


def build_run_scenes(
    scene: Scene, parameters: dict[str, list[Any]] | None, runs: int
) -> list[Scene]:
    """The scene of each run, one object for runs with equal parameters. Raises SceneError."""
    if not parameters:
        return [scene] * runs
    _check_keys(parameters)
    found: dict[str, Scene] = {}
    rows = [{key: values[run] for key, values in parameters.items()} for run in range(runs)]
    names = [json.dumps(row) for row in rows]
    for name, row in zip(names, rows, strict=True):
        if name not in found:
            found[name] = scene.replace(row)
    return [found[name] for name in names]


def build_sweep(
    scene: Scene, built: Sequence[assembly.AssembledSystem], parameters: dict[str, list[Any]]
) -> tuple[ParameterSweep, System]:
    """The sweep of assembled runs and the system that they share: that of the first run, with the
    widest skin.

    Raises SceneError if they cannot be computed by one program.
    """
    first, own = built[0], program_signature(built[0])
    for run, other in enumerate(built):
        if other is not first and program_signature(other) != own:
            raise _make_program_error(scene, parameters, run, first, other)
    columns = zip(*(jax.tree.leaves(b.system) for b in built), strict=True)
    skin = np.max([b.system.skin for b in built])
    system = first.system.replace(skin=jnp.asarray(skin))
    is_skin = [leaf is system.skin for leaf in jax.tree.leaves(system)]
    leaves = {
        k: np.stack(column)
        for k, column in enumerate(columns)
        if not is_skin[k] and _has_differences(column)
    }
    return ParameterSweep(parameters, tuple(built), leaves), system


def _check_keys(keys: Iterable[str]) -> None:
    """Raise SceneError for a key that must be the same in all runs."""
    for key in keys:
        if key.partition(".")[0] in FIXED_SECTIONS and key != VARIABLE_RUN_KEY:
            raise SceneError(
                f"parameters: {key}: allowed: {VARIABLE_RUN_KEY}, and keys that are not of {', '.join(FIXED_SECTIONS)}"
            )
        if is_file_key(key):
            raise SceneError(
                f"parameters: {key}: allowed: keys that name no file; its contents are read once for all runs"
            )


def is_file_key(key: str) -> bool:
    """Whether a key names a file, or an option of reading it."""
    return key.rpartition(".")[2] in FILE_KEYS


def _has_differences(column: Sequence[Any]) -> bool:
    return any(x is not column[0] and not np.array_equal(x, column[0]) for x in column)


def _make_program_error(
    scene: Scene,
    parameters: dict[str, list[Any]],
    run: int,
    first: assembly.AssembledSystem,
    other: assembly.AssembledSystem,
) -> SceneError:
    """The error of a run that needs another program than the first."""
    said = ", ".join(f"{key} = {shorten_value(values[run])}" for key, values in parameters.items())
    why = (
        ", ".join(_list_differing_fields(first.system, other.system))
        or "the number or the shape of pieces and walls, or how often they come in"
    )
    return SceneError(
        f"{scene.name}: run {run} ({said}) needs another program than run 0, by {why}; allowed: runs of one program, "
        f"others as an ensemble of their own"
    )


def program_signature(built: assembly.AssembledSystem) -> Any:
    """Key that is equal for runs that one program can compute and one ensemble can hold."""
    leaves, structure = jax.tree.flatten((built.system, built.state))
    shapes = tuple((x.shape, x.dtype) for x in leaves)
    every = built.exchange_plan and built.exchange_plan.interval
    return structure, shapes, built.settling_steps // built.step.substeps, built.samples, every


def _list_differing_fields(one: System, other: System) -> list[str]:
    """Names of the static fields that differ, and of the parts that only one of both has."""
    found = []
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        same = (
            a == b
            if field.metadata.get("static")
            else str(jax.tree.structure(a)) == str(jax.tree.structure(b))
        )
        found += [] if same else [field.name]
    return found
