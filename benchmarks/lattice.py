"""Dense systems of any size for timing: pieces on a lattice, each touching its six neighbours, in a
box.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.box import open_box

PRESS = 5e-4  # overlap of neighbours relative to the pitch
SKIN = 5e-4  # m: for pieces at rest, as in a settled heap
SPEED, TURN = 1e-3, 1e-4  # m/s, rad, about: on a perfect lattice at rest there are denormal
# numbers, which a CPU is slow at


def box_scene(shape: str, count: int, precision="f32"):
    """Scene of ``count`` pieces, spheres of 10 mm radius or marshmallows, in a box that their
    lattice fills.
    """
    from dem_jax.scene import parse_scene

    pitch = np.array([0.02] * 3 if shape == "sphere" else [0.055, 0.023, 0.016]) * (1 - PRESS)
    cells = lattice_cells(count)
    size = cells * pitch
    corners = open_box(0.5 * size[0], 0.5 * size[1], size[2])
    walls = "\n".join(
        f'[[wall]]\ngroup = "box"\ncorners = {[list(map(float, c)) for c in row]}'
        for row in corners
    )
    radius = "radius = 0.01" if shape == "sphere" else ""
    scene = parse_scene(f"""
[portion]
shape = "{shape}"
{radius}
count = {count}
arrangement = "scattered"
region_low = [0.0, 0.0, 0.0]
region_high = [{size.max() + 0.2}, {size.max() + 0.2}, 1.0]
[run]
duration = 3e-5
frame_interval = 0.0
precision = "{precision}"
domain_low = {[float(-v) for v in size + 0.2]}
domain_high = {[float(v) for v in size * 30 + 100]}
[material]
restitution = 0.1
{walls}
""")
    return scene, positions(cells, pitch, count)


def lattice_cells(count: int):
    """Cells of a nearly cubic lattice [3] for a number of pieces."""
    side = int(np.ceil(count ** (1 / 3) - 1e-9))
    return np.array([side, side, int(np.ceil(count / side**2))])


def positions(cells, pitch, count):
    """Centres [3, count] (m) of the lattice, from below, with a jitter of a tenth of the overlap."""
    index = np.stack(np.unravel_index(np.arange(count), cells[::-1]))[::-1]
    jitter = np.random.default_rng(0).uniform(-0.05, 0.05, index.shape) * PRESS
    return (index + 0.5 + jitter) * pitch[:, None] - np.array(
        [0.5 * cells[0], 0.5 * cells[1], 0.0]
    )[:, None] * pitch[:, None]


def system_of(shape: str, count: int):
    """System and first state on the lattice, with capacities that fit, found by rebuilding until
    nothing overflows.
    """
    from dem_jax import assembly
    from dem_jax.broad_phase import neighbour_list, overflow_recovery
    from dem_jax.runner.job_setup import choose_slot_block

    scene, centres = box_scene(shape, count)
    built = assembly.assemble_system(scene, 0)
    high = centres.astype(np.float32)
    velocity, turns = np.random.default_rng(1).normal(0, 1, (2, *centres.shape)) * np.reshape(
        [SPEED, TURN], (2, 1, 1)
    )
    state = built.state.replace_motion(
        position=jnp.asarray(high),
        position_rest=jnp.asarray(centres - high, jnp.float32),
        orientation=jnp.asarray(np.concatenate([np.ones((1, count)), 0.5 * turns]), jnp.float32),
        velocity=jnp.asarray(velocity, jnp.float32),
    )
    high = jnp.max(state.position, axis=1) + 1
    system = built.system.replace(
        skin=jnp.float32(SKIN), domain_high=high, slot_block=choose_slot_block()
    )
    rebuild = jax.jit(neighbour_list.rebuild_neighbour_list)
    for _ in range(8):
        rebuilt = rebuild(system, state)
        seen = jax.device_get(rebuilt.guard)
        if not overflow_recovery.describe_overflow(system, seen):
            return system, rebuilt
        system, state = overflow_recovery.grow_capacity(
            system, overflow_recovery.reset_report(state), seen
        )
    raise RuntimeError(f"capacities did not settle for {count} pieces")
