"""The Coulomb-limited tangential spring on a sphere: oblique impacts, and sliding or spinning that
turns into rolling.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import assembly, validation
from dem_jax.contact_laws import friction as friction_law
from dem_jax.validation import ObliqueImpact

RADIUS = 0.01  # m
G = 9.81  # m/s2
NORMAL = 0.1  # m/s
# A stiff contact: the closed forms take the arm of friction to be R, it is R - s/2; s / 2R < 3e-5
# here.
STIFF = 100.0


@cache
def built(softening, gravity):
    scene = validation.plate_scene(
        {"shape": "sphere", "radius": RADIUS},
        (0.0, 0.0, -gravity),
        numerical_softening=softening,
        separation_slope_ratio=0.0,
    )
    return assembly.assemble_system(scene)


@jax.jit
def run(system, state, rows):
    """4096 steps for each row: dt, epsilon, mu, K_t / K_n, gap (m), velocity x and z (m/s), spin y
    (rad/s).
    """

    def one(dt, epsilon, friction, tangential, gap, along, normal, spin):
        zero = jnp.zeros_like(dt)
        changed = validation.with_permanent_pairs(system).replace(
            dt=dt, law=system.law.replace(tangential=tangential)
        )
        changed = validation.with_friction(validation.with_restitution(changed, epsilon), friction)
        inertia = system.pieces.inertia[1, 0]
        start = state.replace_motion(
            position=jnp.stack([zero, zero, RADIUS + gap])[:, None],
            velocity=jnp.stack([along, zero, normal])[:, None],
            angular_momentum=jnp.stack([zero, inertia * spin, zero])[:, None],
        )
        return validation.trace_motion(changed, start, 4096, validation.read_motion)[1]

    return jax.vmap(one)(*rows.T)


def impacts(rows, steps):
    """Speed along the plate, surface speed R omega (m/s, see ObliqueImpact) and normal speed after
    impacts, [rows].

    First touch is half-way through a step, and so is the end, where (1 + epsilon) ``steps`` is a
    whole number. rows: epsilon, mu, K_t / K_n, v_t (m/s), surface speed (m/s); steps per loading
    quarter period.
    """
    made = built(STIFF, 0.0)
    pieces = made.system.pieces
    dt = (
        np.pi
        / 2
        * np.sqrt(float(pieces.mass[0] / validation.wall_stiffness(made.system)[0]))
        / steps
    )
    full = [(dt, e, mu, k, 0.5 * NORMAL * dt, v, -NORMAL, -w / RADIUS) for e, mu, k, v, w in rows]
    found = run(made.system, made.state, jnp.asarray(np.array(full)))
    force = np.asarray(found["force"])
    assert (force[:, -1] == 0).all() and (force.max(1) > 0).all()  # lambda = 0: no force on the way
    # out
    spin = np.asarray(found["momentum"])[:, -1, 1] / float(pieces.inertia[1, 0])
    velocity = np.asarray(found["velocity"])[:, -1]
    return velocity[:, 0], -RADIUS * spin, velocity[:, 2]


def test_gross_sliding():
    # Sliding throughout: friction is mu times the normal force in every step, so that its impulse
    # is mu times the normal impulse to rounding; the normal impulse itself is (1 + epsilon) v_n to
    # the order of the step.
    rows = [
        (e, 0.2, 1.0, v, w)
        for e in (0.1, 0.5, 1.0)
        for v, w in ((0.3, 0.0), (0.5, 0.4), (-0.3, -0.2))
    ]
    along, surface, normal = impacts(rows, 1000)
    for row, v, w, n in zip(rows, along, surface, normal, strict=True):
        exact = ObliqueImpact(row[0], row[1], row[2])
        sign = np.sign(row[3])
        v_exact, w_exact = exact.sliding_speeds(NORMAL, sign * row[3], sign * row[4])
        assert abs(sign * v - v_exact) < 1e-5 * NORMAL  # 0.25 / (epsilon N)^2
        assert abs(sign * w - w_exact) < 3e-5 * NORMAL  # and the arm
        assert abs(sign * (row[3] - v) - row[1] * (n + NORMAL)) < 1e-12 * NORMAL
        change = (row[3] + row[4]) - (v + w)  # of the contact speed: 7/2 mu (1 + epsilon) v_n
        assert abs(sign * change - 3.5 * row[1] * (1 + row[0]) * NORMAL) < 1e-4 * NORMAL


def test_sliding_criterion_of_linear_springs():
    mu = 0.2
    cases = [(1.0, 2 / 7), (1.0, 0.5), (1.0, 1.0), (0.5, 1.0), (0.1, 1.0)]
    bounds = np.array([ObliqueImpact(e, mu, k).sliding_ratio for e, k in cases])
    np.testing.assert_allclose(bounds[:3], [3.5, 5.0, 6.0], rtol=1e-12)
    rows = [
        (e, mu, k, f * b * mu * NORMAL, 0.0)
        for f in (1.01, 0.9)
        for (e, k), b in zip(cases, bounds, strict=True)
    ]
    along, _, normal = impacts(rows, 500)
    before = np.array([r[3] for r in rows])
    missing = (1 - (before - along) / (mu * (normal + NORMAL))).reshape(2, -1)  # of the friction of
    # gross sliding
    assert (np.abs(missing[0]) < 1e-12).all()  # above: slides in every step
    assert (missing[1] > 1e-3).all()  # below: does not


def test_ratio_of_contact_speeds_without_slip():
    cases = [(e, k) for k in (2 / 7, 1.0) for e in (1.0, 0.7, 0.5, 0.1)]
    along, surface, _ = impacts([(e, 1e6, k, 0.07, 0.0) for e, k in cases], 1500)
    ratio = (along + surface) / 0.07
    exact = np.array([ObliqueImpact(e, 0.0, k).gripping_ratio for e, k in cases])
    np.testing.assert_allclose(
        exact, [-1, -0.8910, -0.7071, -0.1564, 0.9188, 0.2796, -0.2997, -0.9959], atol=5e-5
    )
    # The spring is let go at its full force, a jump that only without friction's limit there is:
    # seen half-way through a step, so that it does not cost the order. The arm, R - s/2, has 2e-5
    # of a phase of up to 5.9 rad.
    assert np.abs(ratio - exact).max() < 1e-4
    # Spin and speed exchange by the same impulse, whatever the ratio.
    np.testing.assert_allclose(surface, 2.5 * (along - 0.07), rtol=5e-5)


def test_what_sticks_until_it_parts_does_so_whenever_in_a_step_it_touches():
    made, along = built(STIFF, 0.0), 0.0135
    quarter = (
        np.pi
        / 2
        * np.sqrt(float(made.system.pieces.mass[0] / validation.wall_stiffness(made.system)[0]))
    )

    def speeds(steps, phases):
        dt = quarter / steps
        rows = [(dt, 0.5, 0.8, 1.0, phase * NORMAL * dt, along, -NORMAL, 0.0) for phase in phases]
        return np.asarray(run(made.system, made.state, jnp.asarray(np.array(rows)))["velocity"])[
            :, -1, 0
        ]

    # 20 steps are the default's. Without the corners of the force it is up to 0.9 % of the speed.
    phases = (np.arange(6) + 0.5) / 6
    assert np.abs(speeds(20, phases) - speeds(1000, phases).mean()).max() < 4e-3 * along


def rolling(rows, dt):
    """Time (s) and the traces of a sphere at rest on the plate under gravity; rows: mu, speed
    (m/s), spin (rad/s).
    """
    made = built(1.0, G)
    pieces = made.system.pieces
    sunk = -float(pieces.mass[0]) * G / float(validation.wall_stiffness(made.system)[0])
    full = [(dt, 0.5, mu, 1.0, sunk, v, 0.0, w) for mu, v, w in rows]
    found = jax.tree.map(np.asarray, run(made.system, made.state, jnp.asarray(np.array(full))))
    time = dt * np.arange(1, 4097)
    spin = found["momentum"][..., 1] / float(pieces.inertia[1, 0])
    return time, found["velocity"][..., 0], spin, found["position"][..., 0]


def crossing(time, x):
    """First time at which x passes through zero, and the step before, linear within a step."""
    k = int(np.flatnonzero(x[1:] * x[:-1] < 0)[0])
    part = x[k] / (x[k] - x[k + 1])
    return time[k] + part * (time[k + 1] - time[k]), k, part


def test_sliding_turns_into_rolling():
    dt, mu, speed = 5e-6, 0.3, 0.1
    time, velocity, spin, place = rolling([(mu, speed, 0.0)], dt)
    slip = velocity[0] - RADIUS * spin[0]
    end, k, part = crossing(time, slip)
    # Until the spring carries mu m g, the force is less: that takes mu m g / K_t of slip, 1e-7 m,
    # 1e-6 s of 10 ms.
    exact = 2 * speed / (7 * mu * G)
    # (The sphere rings on the plate; at half this step it is 5e-4 late.)
    assert abs(end / exact - 1) < 7e-4
    distance = place[0, k] + part * (place[0, k + 1] - place[0, k])
    assert abs(distance / (12 * speed**2 / (49 * mu * G)) - 1) < 7e-4
    # From then on the spring, which nothing damps, swings about zero: v has a mean of 5/7 v0 and a
    # part mu g / omega_t.
    late = time > 1.2 * exact
    assert abs(velocity[0, late].mean() / (5 / 7 * speed) - 1) < 2e-4
    assert abs(RADIUS * spin[0, late].mean() / (5 / 7 * speed) - 1) < 2e-4


def test_spinning_turns_into_rolling():
    dt, mu, spin0 = 5e-6, 0.3, 10.0
    time, velocity, spin, _ = rolling([(mu, 0.0, spin0)], dt)
    end, _, _ = crossing(time, velocity[0] - RADIUS * spin[0])
    late = time > 1.2 * end
    exact = 2 / 7 * RADIUS * spin0
    assert abs(velocity[0, late].mean() / exact - 1) < 2e-4
    assert abs(RADIUS * spin[0, late].mean() / exact - 1) < 2e-4


def test_angular_momentum_about_the_contact_is_kept():
    # Friction has no arm about the line of contact: m v (R - s/2) + I omega stays, sliding or
    # rolling, but for what the ringing of s (by less than m g / K = 6e-9 m) changes of the arm.
    made = built(1.0, G)
    mass, inertia = float(made.system.pieces.mass[0]), float(made.system.pieces.inertia[1, 0])
    arm = RADIUS - 0.5 * mass * G / float(validation.wall_stiffness(made.system)[0])
    _, velocity, spin, _ = rolling([(0.3, 0.1, 0.0), (0.3, 0.0, 10.0), (0.05, 0.1, -20.0)], 5e-6)
    kept = mass * velocity * arm + inertia * spin
    assert np.abs(kept / kept[:, :1] - 1).max() < 3e-7


def turning_slip(steps, limit):
    """Spring after slip along a quarter circle from x to y, with mu F_n = ``limit(t)``, t from 0 to
    1, in ``steps`` steps.
    """
    time = jnp.linspace(0, 1, steps + 1)[1:]
    middle = (time - 0.5 / steps) * jnp.pi / 2

    def one(spring, now):
        force, angle = now
        slip = (jnp.cos(angle) / steps, jnp.sin(angle) / steps, jnp.zeros_like(angle))
        normal = tuple(jnp.asarray(c) for c in (0.0, 0.0, 1.0))
        return friction_law.tangential_force(spring, normal, slip, force, 10.0, 1.0), None

    zero = jnp.zeros(())
    last, _ = jax.lax.scan(one, (zero, zero, zero), (limit(time), middle))
    return np.array(last)


def test_direction_of_friction_follows_a_turning_slip_at_second_order():
    # The spring's direction relaxes to that of the slip over a slip of mu F_n / K_t. Limits that
    # stay, grow, fall.
    for limit in (lambda t: 1.0 + 0 * t, lambda t: 0.5 + t, lambda t: 2.5 - 2 * t):
        exact = turning_slip(25600, limit)
        errors = [np.linalg.norm(turning_slip(n, limit) - exact) for n in (100, 200, 400)]
        order = np.log2(np.divide(errors[:-1], errors[1:]))
        assert (np.abs(order - 2) < 0.1).all(), (errors, order)
        assert abs(np.linalg.norm(exact) - limit(1.0)) < 1e-12
        lag = np.pi / 2 - np.arctan2(-exact[1], -exact[0])  # against the slip, and behind it
        assert 0.02 < lag < 0.4


def test_spring_turns_with_the_normal_and_keeps_its_size():
    spring = tuple(jnp.asarray(c) for c in (3.0, 0.0, 4.0))
    normal = tuple(jnp.asarray(c) for c in (0.0, 0.6, 0.8))
    still = tuple(jnp.zeros(()) for _ in range(3))
    turned = np.array(friction_law.tangential_force(spring, normal, still, 100.0, 1.0, 1.0))
    np.testing.assert_allclose(turned @ np.array([0.0, 0.6, 0.8]), 0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(turned), 5.0, rtol=1e-15)


def test_spring_that_is_reversed_unloads_before_it_slides():
    # One step of slip against a spring at its limit: elastic up to twice the limit, then sliding
    # the other way.
    normal, zero = tuple(jnp.asarray(c) for c in (0.0, 0.0, 1.0)), jnp.zeros(())
    spring = (jnp.asarray(2.0), zero, zero)
    slips = [(jnp.asarray(x), zero, zero) for x in (1.0, 3.5, 4.5, 100.0)]
    after = [
        float(friction_law.tangential_force(spring, normal, slip, 2.0, 1.0, 1.0)[0])
        for slip in slips
    ]
    np.testing.assert_allclose(after, [1.0, -1.5, -2.0, -2.0], rtol=1e-14)


def test_sticking_impact_converges_at_second_order():
    # Grip at first touch, K_t / K_n = 2/7: all depends on the spring beginning when the touch does,
    # not a step before.
    made = built(STIFF, 0.0)
    quarter = (
        np.pi
        / 2
        * np.sqrt(float(made.system.pieces.mass[0] / validation.wall_stiffness(made.system)[0]))
    )

    def speeds(number, phase):
        dt = quarter / number
        rows = [(dt, 0.7, 0.3, 2 / 7, p * NORMAL * dt, 0.08, -NORMAL, 0.0) for p in phase]
        return np.asarray(run(made.system, made.state, jnp.asarray(np.array(rows)))["velocity"])[
            :, -1, 0
        ]

    exact = speeds(1600, (0.5,) * 16)[0]
    phase = (np.arange(16) + 0.5) / 16
    errors = [np.sqrt(np.mean((speeds(n, phase) - exact) ** 2)) for n in (50, 100, 200)]
    order = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(order - 2) < 0.35).all(), (errors, order)  # kinks fall at other phases at each N
    assert errors[1] < 1e-5 * 0.08
