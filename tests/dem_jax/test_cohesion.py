"""Cohesion on each law: pull-off force, work of separation, what hangs and what sticks, and
friction that never reverses.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import assembly, validation
from dem_jax.broad_phase import neighbour_list
from dem_jax.contact_laws import ContactKinematics, MaterialPair
from dem_jax.contact_laws.cohesion import Cohesive
from dem_jax.contact_laws.hertz_mindlin import HertzMindlin
from dem_jax.contact_laws.linear_dashpot import LinearDashpot
from dem_jax.contact_laws.walton_braun import WaltonBraun
from dem_jax.dynamics import stepping
from dem_jax.scene import Scene

PULL_OFF, RANGE = 0.5, 1e-4  # N, m
LAWS = ("walton-braun", "linear-dashpot", "hertz-mindlin")
PIECES = {
    "sphere": ({"shape": "sphere", "radius": 0.0167}, 0.0167),
    "marshmallow": ({"shape": "chamfered-cuboid"}, 0.008),
}


@cache
def built(law, shape="sphere", ratio=1.0, reach=RANGE):
    material = {"restitution": 0.5, "pull_off": PULL_OFF}
    scene = validation.plate_scene(PIECES[shape][0], **material)
    return assembly.assemble_system(
        scene.replace(
            contact={"law": law, "cohesion": {"interaction_range": reach, "stiffness": ratio}}
        )
    )


def coming_up(made):
    """d (m): the way in which the tension comes up."""
    return PULL_OFF / float(made.system.law.stiffness * validation.wall_stiffness(made.system)[0])


@jax.jit
def pulled(system, state, height, speed):
    """Forces (N) and heights (m) of a very heavy piece that is pushed into the plate for 500 steps
    and then pulled off.
    """
    heavy = system.replace(
        pieces=system.pieces.replace(mass=system.pieces.mass * 1e9),
        dt=jnp.full_like(system.dt, 2e-6),
    )
    heavy = validation.with_permanent_pairs(heavy)
    read = lambda _, s: (-s.walls.force[2, 0, 0], s.position[2, 0])
    zero = jnp.zeros_like(height)
    state = state.replace_motion(position=jnp.stack([zero, zero, height])[:, None])
    state, into = validation.trace_motion(
        heavy, state.replace_motion(velocity=jnp.stack([zero, zero, -speed])[:, None]), 500, read
    )
    _, out = validation.trace_motion(
        heavy, state.replace_motion(velocity=jnp.stack([zero, zero, speed])[:, None]), 2500, read
    )
    return into, out


PULLED = [(law, "sphere") for law in LAWS if law != "linear-dashpot"]
PULLED += [
    pytest.param(*case, marks=pytest.mark.long)
    for case in (("linear-dashpot", "sphere"), ("walton-braun", "marshmallow"))
]


@pytest.mark.parametrize(("law", "shape"), PULLED)
def test_the_pull_off_force_and_the_way_back(law, shape):
    made = built(law, shape)
    half, d = PIECES[shape][1], coming_up(made)
    (f, z), (force, place) = (
        tuple(np.asarray(x) for x in part) for part in pulled(made.system, made.state, half, 0.05)
    )
    assert (f >= 0).all()  # loading is that of the law alone
    assert force.min() == pytest.approx(-PULL_OFF, rel=1e-9)
    gap = place - half
    beyond = (gap > 0) & (gap < d)  # what is left of the law's own force ends where bodies part
    np.testing.assert_allclose(force[beyond], -PULL_OFF, rtol=1e-9)
    falls = (gap > d) & (gap < d + RANGE)
    np.testing.assert_allclose(force[falls], -PULL_OFF * (1 - (gap[falls] - d) / RANGE), atol=1e-9)
    assert (force[gap > d + RANGE] == 0).all() and gap[-1] > d + RANGE


def test_the_work_of_separation():
    """Just touching: P (d + range) / 2. After pressing, P s more of an elastic law, whatever the
    speed.
    """
    made = built("linear-dashpot")
    d, half = coming_up(made), PIECES["sphere"][1]
    for speed, pressed in ((0.05, None), (0.05, 1e-9)):
        start = half if pressed is None else half + 0.05 * 500 * 2e-6 - pressed
        _, (force, place) = pulled(made.system, made.state, start, speed)
        depth = float(half - place[0])
        work = np.trapezoid(-np.minimum(np.asarray(force), 0), np.asarray(place))
        wanted = PULL_OFF * (0.5 * (d + RANGE) + (max(depth, 0) if pressed is None else 0))
        assert work == pytest.approx(wanted, rel=2e-3)  # where the law's own force is more than the
        # tension, some 1e-3


@cache
def pair_of_spheres(law):
    pieces = [
        {"shape": "sphere", "radius": 0.0167, "position": (0.0, 0.0, s * 0.01671)} for s in (-1, 1)
    ]
    run = {"precision": "f64", "gravity": (0.0, 0.0, 0.0), "frame_interval": 0.0}
    material = {
        "restitution": 1.0,
        "pull_off": PULL_OFF,
        "friction_wall": 0.0,
        "friction_piece": 0.0,
    }
    return assembly.assemble_system(
        Scene(
            piece=pieces,
            run=run,
            material=material,
            contact={"law": law, "cohesion": {"interaction_range": RANGE}},
        )
    )


@jax.jit
def collided(system, state, speeds):
    def one(speed):
        velocity = jnp.zeros((3, 2)).at[2].set(jnp.stack([0.5 * speed, -0.5 * speed]))
        read = lambda _, s: (
            s.position[2, 1] - s.position[2, 0],
            s.velocity[2, 1] - s.velocity[2, 0],
        )
        return validation.trace_motion(
            validation.with_permanent_pairs(system),
            state.replace_motion(velocity=velocity),
            6000,
            read,
        )[1]

    return jax.vmap(one)(speeds)


def test_two_pieces_stick_or_part_with_what_is_left():
    made = pair_of_spheres("linear-dashpot")
    mass = 0.5 * float(made.system.pieces.mass[0])
    stiffness = 0.5 * float(made.system.materials.youngs_modulus[0] * made.system.pieces.size[0])
    d = PULL_OFF / stiffness
    speeds = np.array([0.1, 0.15, 0.25, 0.5, 1.0])
    pressed = speeds * np.sqrt(mass / stiffness)
    left = 0.5 * mass * speeds**2 - PULL_OFF * (pressed + 0.5 * (d + RANGE))
    assert (left[:2] < 0).all() and (left[2:] > 0).all()
    dt = np.pi / 2 * np.sqrt(mass / stiffness) / 80
    apart, speed = (
        np.asarray(x)
        for x in collided(made.system.replace(dt=jnp.asarray(dt)), made.state, jnp.asarray(speeds))
    )
    assert (apart[:2, -1] - 0.0334 < d + RANGE).all() and (apart[2:, -1] - 0.0334 > d + RANGE).all()
    np.testing.assert_allclose(
        0.5 * mass * speed[2:, -1] ** 2, left[2:], rtol=2e-3, atol=2e-3 * left[2]
    )
    assert np.abs(speed[:2, -2000:]).max() < 0.6 * 0.15  # they ring on, with what the tension did
    # not take


HANGING = [("walton-braun", "sphere"), ("linear-dashpot", "marshmallow")]
HANGING += [pytest.param("hertz-mindlin", "sphere", marks=pytest.mark.long)]


@pytest.mark.parametrize(("law", "shape"), HANGING)
def test_a_piece_hangs_below_a_ceiling_if_it_weighs_less_than_the_pull_off_force(law, shape):
    """The ceiling is the plate, with gravity away from it that grows slowly."""
    made = built(law, shape)
    system, mass = validation.with_permanent_pairs(made.system), float(made.system.pieces.mass[0])
    dt, steps = 2e-5, 6000
    system = system.replace(dt=jnp.asarray(dt))
    start = made.state.replace_motion(
        position=jnp.asarray([0.0, 0.0, PIECES[shape][1] - 1e-8])[:, None]
    )

    @jax.jit
    @jax.vmap
    def fall(weight):
        def one(state, part):
            gravity = jnp.stack(
                [0 * weight, 0 * weight, weight / mass * jnp.minimum(1.2 * part, 1)]
            )
            return stepping.advance_step(system.replace(gravity=gravity), state), None

        state = neighbour_list.rebuild_neighbour_list(system, start)
        return jax.lax.scan(one, state, jnp.arange(steps) / steps)[0].position[2, 0]

    gap = np.asarray(fall(PULL_OFF * jnp.array([0.5, 0.97, 1.03, 2.0]))) - PIECES[shape][1]
    assert (gap[:2] < coming_up(made)).all(), gap
    assert (gap[2:] > 10 * RANGE).all(), gap


@pytest.mark.parametrize(
    "law", [WaltonBraun(0.001, 1.0, None), LinearDashpot(1.0), HertzMindlin(5.0)], ids=LAWS
)
def test_friction_never_reverses_and_never_exceeds_its_limit(law):
    """The limit is mu times the repulsive part F_n + A, also where the sum pulls."""
    random, n, mu = np.random.default_rng(1), 400, 0.5
    one = jnp.ones(n)
    couple = MaterialPair(
        youngs_modulus=(1e6 * one, 1e9 * one),
        poisson_ratio=(0.3 * one, 0.3 * one),
        size=(0.03 * one, 0.03 * one),
        curvature=(60 * one, 0 * one),
        mass=5e-3 * one,
        restitution=0.5 * one,
        friction=mu * one,
        pull_off=PULL_OFF * jnp.asarray(random.integers(0, 2, n).astype(float)),
    )
    sticky = Cohesive(law, 1.0, RANGE)
    pair = sticky.pair_parameters(couple)
    history = sticky.init_history(pair, one)
    overlap, pulls = np.full(n, 2e-5), 0
    for _ in range(60):
        before, overlap = overlap, overlap + random.normal(-1e-6, 3e-6, n)
        slip = random.normal(0, 1e-5, (2, n))
        contact = ContactKinematics(
            jnp.asarray(overlap),
            jnp.asarray(overlap - before),
            (*jnp.asarray(slip), 0 * one),
            (0 * one, 0 * one, one),
            1e-5 * one,
        )
        fresh = sticky.init_history(pair, one)._replace(tension=history.tension, bond=history.bond)
        answer = sticky.force(pair, history, contact)
        repulsive = np.asarray(answer.normal_force + answer.history.tension)
        assert (repulsive >= 0).all()
        size = np.sqrt(sum(np.asarray(c) ** 2 for c in answer.tangential_force))
        assert (size <= mu * repulsive * (1 + 1e-9) + 1e-12).all()
        direct = sticky.force(pair, fresh, contact).tangential_force  # of a spring that begins:
        # against the slip
        assert (direct[0] * slip[0] + direct[1] * slip[1] <= 1e-18).all()
        away = np.asarray(couple.pull_off) == 0
        assert (np.asarray(answer.history.tension)[away] == 0).all()
        assert (np.asarray(answer.normal_force)[overlap < -coming_up_of(pair) - RANGE] == 0).all()
        pulls += int((np.asarray(answer.normal_force) < 0).sum())
        history = answer.history
    assert pulls > 1000


def coming_up_of(pair):
    return np.asarray(pair.pull_off / pair.stiffness)
