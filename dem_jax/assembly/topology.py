"""Separation of a scene into topology and parameters, and assembly of the system and first state as
a function of both.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jax.extend.core import Var

from dem_jax.assembly.arrays import Layout, find_arrays
from dem_jax.assembly.contact_law import build_materials
from dem_jax.assembly.dtype_cast import put_array
from dem_jax.assembly.initial_conditions import (
    InitialConditions,
    build_initial_motion,
    read_listed_pieces,
)
from dem_jax.assembly.parameters import (
    Parameters,
    find_parameters,
    find_unset_parameters,
    insert_values,
    is_left_out,
)
from dem_jax.assembly.system import AssembledSystem
from dem_jax.assembly.wall_panels import lay_out_walls
from dem_jax.broad_phase import neighbour_list, overflow_recovery
from dem_jax.dynamics.quantity import Quantity, validate_quantities, with_fixed_rows
from dem_jax.errors import SceneError
from dem_jax.scene import Scene
from dem_jax.scene.array_namespace import as_float_array
from dem_jax.scene.messages import suggest_choices
from dem_jax.types import PAIR_PROPERTIES, Materials, State, System

POSES = {"portion.position": "position", "portion.orientation": "orientation"}  # initial poses of a
# portion as parameters fields of a System that depend on parameters
FIELDS = ("pieces", "materials", "law", "walls", "gravity", "block_low", "block_high")


@dataclass(frozen=True, eq=False)
class Topology:
    """Everything in a scene except the numerical inputs of a compiled program: shapes, counts,
    groups, kinds, capacities, time step.

    Two topologies are equal, and have the same hash, if they share a compiled program; a topology
    can be a static argument of ``jax.jit``.
    """

    scene: Scene  # without the values of its parameters
    layout: Layout
    start: InitialConditions  # of pieces whose poses are not parameters
    system: System  # without FIELDS
    state: State  # without motion; scratch has the forms of its arrays
    frames: np.ndarray  # [N, 4]: principal frame to body frame, of each piece
    materials: Materials  # forms of the arrays
    shapes: Mapping[str, tuple[int, ...]]  # shapes of the values of all parameters
    unset: frozenset[str]  # optional parameters, which default to other parameters
    settling_steps: int  # time steps before time zero
    steps_per_sample: int  # time steps per sample interval of the scene
    samples: int  # sample intervals from time zero to the end of the scene's run

    @property
    def steps(self) -> int:
        """Time steps to the end of the scene's run, settling included."""
        return self.settling_steps + self.samples * self.steps_per_sample

    @property
    def dt(self) -> float:
        """Time step (s)."""
        return float(self.system.dt)

    @cached_property
    def _identity(self) -> Any:
        leaves, structure = jax.tree.flatten(
            (self.system, self.state.step, self.layout.walls, self.layout.law, self.frames)
        )
        arrays = tuple(
            (np.shape(leaf), str(np.asarray(leaf).dtype), np.asarray(leaf).tobytes())
            for leaf in leaves
        )
        forms = jax.tree.flatten((self.state.replace(step=None), self.materials))
        counts = self.settling_steps, self.steps_per_sample, self.samples
        return (
            repr(self.scene),
            structure,
            arrays,
            (tuple(map(_form_of, forms[0])), forms[1]),
            tuple(self.shapes.items()),
            counts,
        )

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Topology) and self._identity == other._identity)

    def __hash__(self) -> int:
        return hash(self._identity)


def split_scene(
    scene: Scene, built: AssembledSystem, quantities: Iterable[Quantity] = ()
) -> tuple[Topology, dict[str, np.ndarray]]:
    """Topology and parameters of a self-contained, assembled scene.

    Args:
        scene: with the contents of all its files.
        built: the assembled scene.
        quantities: sampled in addition to those of the system.

    Raises:
        SceneError: pieces enter or leave.
        ValueError: two quantities have the same name.
    """
    if built.exchange_plan is not None:
        raise SceneError(
            "[inlet], [outlet]: pieces that come and go have no derivatives, and the host moves them"
            " between steps; allowed: a scene without them"
        )
    values = find_parameters(scene)
    if not scene.piece:
        values |= {
            key: np.asarray(getattr(built.start, field), float) for key, field in POSES.items()
        }
    unset = dict.fromkeys(find_unset_parameters(scene), np.zeros(()))
    built = replace(built, system=_prepare_system(built, quantities))
    topology = _outline(scene, built, values, unset)
    fill = partial(_fill_arrays, topology)
    used = _find_used(fill, values)
    also = [key for key in _find_used(fill, values | unset) if key in unset] if unset else []
    own = {key: value for key, value in values.items() if key in used}
    blank = insert_values(scene, {key: None for key in own if key not in POSES})
    shapes = {key: np.shape(value) for key, value in (own | dict.fromkeys(also, 0.0)).items()}
    topology = replace(topology, scene=blank, shapes=shapes, unset=frozenset(also))
    form = jax.eval_shape(
        lambda values: neighbour_list.rebuild_neighbour_list(*_fill_arrays(topology, values)), own
    ).scratch
    return replace(topology, state=topology.state.replace(scratch=form)), own


def assemble(topology: Topology, parameters: Parameters) -> tuple[System, State]:
    """Assemble the system and first state of a topology from values of its parameters. Pure; the
    values may be traced.

    Args:
        topology: of a scene.
        parameters: a value for each parameter of the topology.

    Returns:
        The system, which a run does not change, and the state at the first time step.

    Raises:
        SceneError: a parameter is missing, unknown, or has another shape.
    """
    check_parameters(topology, parameters)
    for key in topology.shapes.keys() - topology.unset - parameters.keys():
        raise SceneError(
            f"{key}: missing; allowed: all parameters that dem_jax.model returns, with other values"
        )
    system, state = _fill_arrays(topology, parameters)
    scratch = jax.tree.map(lambda form: np.zeros(form.shape, form.dtype), topology.state.scratch)
    # a rebuild is due
    scratch = scratch.replace(rebuild_step=topology.state.step - system.block_steps)
    return system, state.replace(scratch=jax.tree.map(put_array, scratch))


def check_parameters(topology: Topology, parameters: Parameters) -> None:
    """Raise SceneError for unknown keys and for values of another shape."""
    for key, value in parameters.items():
        if key not in topology.shapes:
            raise _not_a_parameter(topology, key)
        if (found := np.shape(value)) != topology.shapes[key]:
            raise SceneError(f"{key}: a value of the form {found}; allowed: {topology.shapes[key]}")


def _not_a_parameter(topology: Topology, key: str) -> SceneError:
    if is_left_out(topology.scene, key):
        return SceneError(
            f"{key}: the scene has 0, and its program nothing of it; allowed: a scene in which it is not 0"
        )
    return SceneError(
        f"{key}: decides the program or its sizes, or is no key of the scene; {suggest_choices(key, list(topology.shapes))}"
    )


def _outline(
    scene: Scene, built: AssembledSystem, values: Parameters, unset: Parameters
) -> Topology:
    """The topology of a scene and its values, before its parameters are determined."""
    of_scene = {key: value for key, value in {**values, **unset}.items() if key not in POSES}
    materials = jax.eval_shape(
        lambda values: build_materials(insert_values(scene, values)), of_scene
    )
    absent = [name for name in PAIR_PROPERTIES if getattr(built.system.materials, name) is None]
    return Topology(
        scene=scene,
        layout=built.layout,
        start=built.start,
        system=built.system.replace(**dict.fromkeys(FIELDS)),
        state=built.state.replace(motion=None, scratch=None),
        frames=built.frames,
        materials=materials.replace(**dict.fromkeys(absent)),
        shapes={key: np.shape(value) for key, value in {**values, **unset}.items()},
        unset=frozenset(unset),
        settling_steps=built.settling_steps,
        steps_per_sample=built.step.substeps,
        samples=built.samples,
    )


def _prepare_system(built: AssembledSystem, quantities: Iterable[Quantity]) -> System:
    """The system for a compiled loop of steps: rebuilds occur only after whole sample intervals,
    and rows of quantities have fixed names.
    """
    system = overflow_recovery.with_all_pairs(built.system)
    part = built.step.substeps // built.step.parts
    block = max(1, system.block_steps // part) if built.step.parts == 1 else 1
    sampled = validate_quantities((*system.quantities, *quantities))
    fixed = tuple(with_fixed_rows(quantity, system) for quantity in sampled)
    return system.replace(block_steps=block * part, quantities=fixed)


def _fill_arrays(topology: Topology, parameters: Parameters) -> tuple[System, State]:
    """System and first state, with the scratch arrays of the topology."""
    scene = insert_values(
        topology.scene, {key: value for key, value in parameters.items() if key not in POSES}
    )
    start = topology.start
    if scene.piece:
        start = read_listed_pieces(scene.piece)
    else:
        start = replace(
            start,
            **{
                field: as_float_array(parameters[key])
                for key, field in POSES.items()
                if key in parameters
            },
        )
    drop = scene.drop.model_copy(update={"height": topology.layout.drop_height})
    motions = lay_out_walls(scene.model_copy(update={"drop": drop}))[1]
    arrays = find_arrays(scene, topology.layout, motions, start, form=topology.materials)
    system = topology.system.replace(**arrays.system_fields())
    start = arrays.start
    if not system.has_rotation:
        start = replace(start, spin=np.zeros(start.spin.shape))
    motion = jax.tree.map(put_array, build_initial_motion(system, start, topology.frames))
    return system, topology.state.replace(motion=motion)


def _find_used(function: Callable[[Parameters], Any], values: Parameters) -> list[str]:
    """Keys of the values on which the results of a function depend."""
    jaxpr = jax.make_jaxpr(function)(dict(values)).jaxpr
    needed = {variable for variable in jaxpr.outvars if isinstance(variable, Var)}
    for equation in reversed(jaxpr.eqns):
        if not needed.isdisjoint(equation.outvars):
            needed.update(variable for variable in equation.invars if isinstance(variable, Var))
    return [
        key
        for key, variable in zip(sorted(values), jaxpr.invars, strict=True)
        if variable in needed
    ]


def _form_of(leaf: Any) -> tuple[tuple[int, ...], str]:
    return np.shape(leaf), str(leaf.dtype)
