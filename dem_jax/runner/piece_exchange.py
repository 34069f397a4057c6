"""Pieces that come into a scene and leave it, between two chunks: decided on the host, from the
scene, the seed and the time alone.

A removed piece waits outside, at rest and without weight, and is inserted again later, without
recompilation.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.assembly.exchange_plan import ExchangePlan
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.runner.chunk import take_runs
from dem_jax.runner.job import Job
from dem_jax.scene import Inlet, Scene
from dem_jax.scene.placement import draw_orientations
from dem_jax.types import PieceExchange, PieceMotion, State, System, as_array

MOST_TRIES = 200  # places that are tried for a piece
GAP_FACTOR = 1.001  # times the sum of two bounding radii: nearest that a new piece begins to
# another


def exchange_pieces(job: Job, state: State, at: int) -> State:
    """The state at a sample after the removal of pieces below the outlet and the insertion of
    pieces that are due.
    """
    if not job.system.exchanges or at < 0 or at % job.samples_between_exchanges:
        return state
    host = jax.device_get(state)
    if np.all(host.exchange.last == host.step):
        return state  # it began with them
    if job.runs is None:
        new = _exchange_run(job, host, at, 0)
    else:
        each = [
            _exchange_run(job, take_runs(host.replace(scratch=None), k), at, k)
            for k in range(job.runs)
        ]
        new = jax.tree.map(lambda *x: np.stack(x), *each)
    return state.replace(
        motion=jax.tree.map(jnp.asarray, new.motion),
        exchange=jax.tree.map(jnp.asarray, new.exchange),
    )


def note_missing_inflow(job: Job, state: State, at: int) -> list[str]:
    """Note on runs in which fewer pieces were inserted up to a sample than were due."""
    inlet = job.scene.inlet
    if inlet is None or at < 0:
        return []
    mass, there = (
        np.atleast_1d(np.asarray(get_exchange(state).mass)[..., 0, 0]),
        np.atleast_2d(np.asarray(get_exchange(state).there)),
    )
    late = mass < _due_mass(inlet, at * job.scene.run.sample_interval) - 2 * float(
        np.max(job.system.pieces.mass)
    )
    why = lambda k: (
        "no piece waits (inlet.reservoir)" if there[k].all() else "there is no room in its box"
    )
    return [
        f"{job.scene.name}: the inlet brings less than inlet.mass_rate: {why(k)}"
        for k in np.flatnonzero(late)[:1]
    ]


def get_exchange(state: State) -> PieceExchange:
    """The part of a state that counts exchanged pieces, in a system with an inlet or outlet."""
    assert state.exchange is not None
    return state.exchange


def _exchange_run(job: Job, state: State, at: int, run: int) -> State:
    """Remove and insert the pieces of one run at a sample. state: of a single run, in numpy."""
    built, scene = job.built_for_run(run), job.scene_for_run(run)
    plan, system = built.exchange_plan, built.system
    assert plan is not None  # as its system exchanges
    random = np.random.default_rng([job.seeds[run], at])
    state = _remove_pieces(system, plan, state)
    if scene.inlet is not None:
        state = _insert_pieces(system, plan, scene, state, at * scene.run.sample_interval, random)
    return state.replace(exchange=replace(get_exchange(state), last=state.step))


def _remove_pieces(system: System, plan: ExchangePlan, state: State) -> State:
    """The state without the pieces below the outlet."""
    if plan.outlet_height is None:
        return state
    gone = np.flatnonzero(get_exchange(state).there & (state.position[2] < plan.outlet_height))
    if not len(gone):
        return state
    lost = -_piece_energy(system, state, gone)
    moved = _move_pieces(
        state.motion,
        gone,
        plan.waiting_places[gone],
        np.tile([1.0, 0.0, 0.0, 0.0], (len(gone), 1)),
        np.zeros(3),
    )
    return _count_exchange(system, state.replace(motion=moved), gone, 1, lost)


def _insert_pieces(
    system: System,
    plan: ExchangePlan,
    scene: Scene,
    state: State,
    time: float,
    random: np.random.Generator,
) -> State:
    """The state with the waiting pieces, drawn at random, that are due and find a place."""
    inlet, mass = scene.inlet, np.asarray(system.pieces.mass)
    assert inlet is not None and plan.inlet_box is not None
    lack = _due_mass(inlet, time) - float(get_exchange(state).mass[0, 0])
    chosen, places = list[int](), list[np.ndarray]()
    for k in random.permutation(np.flatnonzero(~get_exchange(state).there)):
        if lack < 0.5 * mass[k]:
            break
        place = _find_free_place(system, plan, state, k, chosen, places, random)
        if place is None:
            break
        chosen.append(k)
        places.append(place)
        lack -= mass[k]
    if not chosen:
        return state
    new = np.array(chosen)
    turns = draw_orientations(len(new), random)
    state = state.replace(
        motion=_move_pieces(state.motion, new, np.array(places), turns, np.array(inlet.velocity))
    )
    return _count_exchange(system, state, new, 0, _piece_energy(system, state, new))


def _find_free_place(
    system: System,
    plan: ExchangePlan,
    state: State,
    piece: int,
    chosen: list[int],
    places: list[np.ndarray],
    random: np.random.Generator,
) -> np.ndarray | None:
    """A point [3] (m) of the inlet's box where a piece, however turned, touches none that are there
    or chosen; None: not found.
    """
    assert plan.inlet_box is not None
    radius, there = (
        np.asarray(system.pieces.bounding_radius),
        np.flatnonzero(get_exchange(state).there),
    )
    others = np.concatenate([state.position[:, there].T, np.array(places).reshape(-1, 3)])
    far = GAP_FACTOR * (radius[piece] + radius[np.append(there, np.array(chosen, int))])
    low, high = plan.inlet_box[0] + radius[piece], plan.inlet_box[1] - radius[piece]
    for place in random.uniform(low, np.maximum(low, high), (MOST_TRIES, 3)):
        if np.all(np.linalg.norm(others - place, axis=1) > far):
            return place
    return None


def _due_mass(inlet: Inlet, time: float) -> float:
    """Mass (kg) that should have come in by a time (s)."""
    end = time if inlet.end is None else min(time, inlet.end)
    return inlet.mass_rate * max(0.0, end - inlet.start)


def _move_pieces(
    motion: PieceMotion,
    which: np.ndarray,
    position: np.ndarray,
    turn: np.ndarray,
    velocity: np.ndarray,
) -> PieceMotion:
    """The motion with some pieces moved elsewhere, without spin or load; position [n, 3], turn [n,
    4], velocity [3] or [n, 3].
    """
    values = {
        "position": position.T,
        "orientation": turn.T,
        "velocity": np.broadcast_to(velocity, position.shape).T,
    }
    for name in ("position", "orientation"):
        values[f"{name}_rest"] = values[name] - values[name].astype(motion.position.dtype)

    def replace_columns(name: str, array: np.ndarray) -> np.ndarray:
        array = np.array(array)
        array[:, which] = values.get(name, 0.0)
        return array

    return motion.replace(
        **{name: replace_columns(name, array) for name, array in vars(motion).items()}
    )


def _count_exchange(
    system: System, state: State, which: np.ndarray, way: int, energy: float
) -> State:
    """The state with some pieces counted as inserted (way 0) or removed (1); energy: (J) that they
    add.
    """
    old, mass = get_exchange(state), np.asarray(system.pieces.mass, float)
    there, count, total = np.array(old.there), np.array(old.count), np.array(old.mass)
    there[which] = way == 0
    count[way] += len(which)
    total[way] += mass[which].sum()
    sum_of = np.asarray(old.energy + energy, total.dtype)
    return state.replace(
        exchange=PieceExchange(
            as_array(there), as_array(count), as_array(total), as_array(sum_of), old.last
        )
    )


def _piece_energy(system: System, state: State, which: np.ndarray) -> float:
    """Kinetic and potential energy (J) of some pieces."""
    mass, inertia = (
        np.asarray(x, float)[..., which] for x in (system.pieces.mass, system.pieces.inertia)
    )
    now = state.motion
    x, v, q, p = (
        np.asarray(a, float)[:, which]
        for a in (now.position, now.velocity, now.orientation, now.angular_momentum)
    )
    own = np.einsum("nij,in->jn", quaternion_to_matrix(q.T), p)  # in the principal frame
    height = -np.asarray(system.gravity, float) @ x
    return float(
        np.sum(mass * (0.5 * np.sum(v * v, axis=0) + height)) + 0.5 * np.sum(own * own / inertia)
    )
