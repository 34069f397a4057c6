"""Linear spring and dashpot, and Hertz-Mindlin: a single impact against their closed forms."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dem_jax import assembly, validation
from dem_jax.broad_phase.pair_constants import compute_pair_constants
from dem_jax.contact_laws import dashpot
from dem_jax.contact_laws.linear_dashpot import LinearDashpot
from dem_jax.scene import Scene
from dem_jax.validation import DashpotImpact, HertzImpact, ObliqueImpact

SPEED = 2.0  # m/s
RADIUS = 0.0167
LAWS = ("linear-dashpot", "hertz-mindlin")
PIECES = {
    "sphere": ({"shape": "sphere", "radius": RADIUS}, RADIUS),
    "marshmallow": ({"shape": "chamfered-cuboid"}, 0.008),
}
RESTITUTION = (0.1, 0.3, 0.5, 0.8, 1.0)
STEPS = 400


@cache
def built(law, shape="sphere", precision="f64", friction=0.0):
    """With friction so stiff that the arm of the contact point is the radius."""
    stiff = (
        {"youngs_modulus": 1e12, "wall_youngs_modulus": 1e15, "numerical_softening": 1.0}
        if friction
        else {}
    )
    mu = {"friction_wall": friction, "friction_piece": friction}
    scene = validation.plate_scene(PIECES[shape][0], precision=precision, **mu, **stiff)
    return assembly.assemble_system(scene.replace(contact={"law": law}))


def pair_of(made):
    """The law's constants of the piece against the wall, as numbers."""
    system, number = made.system, made.system.pieces.mass.shape[0]
    kind = next(iter(made.state.contacts))
    pair = compute_pair_constants(system, kind, jnp.array([number]), jnp.array([0])).pair
    return jax.tree.map(lambda x: float(x[0]), pair)


def elastic(law, made, speed=SPEED):
    """The undamped impact."""
    pair = pair_of(made)
    if law == "linear-dashpot":
        return DashpotImpact(pair.mass, pair.stiffness, 0.0, speed)
    return HertzImpact(pair.mass, pair.stiffness, speed)


def read(system, state):
    return {
        "force": -state.walls.force[:, 0, 0],
        "velocity": state.velocity[:, 0],
        "height": state.position[2, 0],
        "momentum": state.angular_momentum[:, 0],
    }


@jax.jit
def impacts(system, state, height, rows):
    """STEPS steps of impacts side by side; rows: [runs, 6] of dt, restitution, friction, part of a
    step to first touch, normal and tangential speed (m/s).
    """

    def one(row):
        dt, restitution, friction, part, normal, along = row
        changed = validation.with_restitution(
            validation.with_permanent_pairs(system).replace(dt=dt), restitution
        )
        if system.materials.friction is not None:
            changed = validation.with_friction(changed, friction)
        zero = jnp.zeros_like(dt)
        place = jnp.stack([zero, zero, height + normal * dt * part])
        start = state.replace_motion(
            position=place[:, None], velocity=jnp.stack([along, zero, -normal])[:, None]
        )
        return validation.trace_motion(changed, start, STEPS, read)

    return jax.vmap(one)(rows)[1]


def run(made, shape, rows):
    rows = jnp.asarray(np.array(rows), made.system.dt.dtype)
    height = jnp.asarray(PIECES[shape][1], rows.dtype)
    return {
        k: np.asarray(v, float) for k, v in impacts(made.system, made.state, height, rows).items()
    }


def phases(count):
    """Phases of first touch within a step, and factors on dt, a quasi-random pair: kinks fall at
    other phases in each.
    """
    n = np.arange(count)
    return np.mod(0.5 + 0.7548776662 * n, 1), 1 + 0.05 * np.mod(0.5 + 0.5698402910 * n, 1)


@cache
def traces(law, shape, precision="f64"):
    """Traces [restitution, resolution, phase, steps, ..] with 25, 50 and 100 steps per elastic
    loading time.
    """
    made = built(law, shape, precision)
    loading = elastic(law, made).loading_time
    part, factor = phases(16)
    places = list(zip(part, factor, strict=True))
    rows = [
        (loading / n * f, e, 0.0, p, SPEED, 0.0)
        for e in RESTITUTION
        for n in (25, 50, 100)
        for p, f in places
    ]
    found = run(made, shape, rows)
    return {k: v.reshape(len(RESTITUTION), 3, 16, *v.shape[1:]) for k, v in found.items()}


EXACT = [(law, "sphere") for law in LAWS]
EXACT += [
    pytest.param(law, "marshmallow", marks=pytest.mark.long)
    for law in ("hertz-mindlin", "linear-dashpot")
]


@pytest.mark.parametrize(("law", "shape"), EXACT)
def test_restitution_is_exact_and_of_second_order(law, shape):
    out = traces(law, shape)["velocity"][..., -1, 2] / SPEED
    error = (
        np.sqrt(np.mean((out - np.array(RESTITUTION)[:, None, None]) ** 2, axis=2))
        / np.array(RESTITUTION)[:, None]
    )
    order = np.log2(error[:, :-1] / error[:, 1:])
    print(law, shape, error, order)
    # Kinks (touch, and the force that vanishes) fall at other phases at each resolution; undamped
    # only they are left.
    assert (np.log2(error[:, 0] / error[:, 2]) > 2 * 1.75).all()
    assert (error[:, 2] < [5e-3, 1e-3, 1e-3, 5e-4, 5e-4]).all()


BY_DEFAULT = [("hertz-mindlin", "f64"), ("linear-dashpot", "f32")]
BY_DEFAULT += [
    pytest.param(law, {"f64": "f32", "f32": "f64"}[other], marks=pytest.mark.long)
    for law, other in BY_DEFAULT
]


@pytest.mark.parametrize(("law", "precision"), BY_DEFAULT)
def test_the_default_step_gives_the_restitution_within_a_percent(law, precision):
    with jax.enable_x64(precision == "f64"):
        made = built(law, "sphere", precision)
        for e in (0.1, 0.5, 0.9):
            scene = validation.plate_scene(PIECES["sphere"][0], restitution=e).replace(
                contact={"law": law, **_speed(law)}
            )
            dt = assembly.assemble_system(
                scene.replace(run={"sample_interval": 1e-2, "precision": precision})
            ).step.dt
            out = run(
                made, "sphere", [(dt, e, 0.0, p, SPEED, 0.0) for p in np.linspace(0.1, 1, 8)]
            )["velocity"][:, -1, 2]
            print(law, precision, e, out / SPEED / e - 1)
            assert np.abs(out / SPEED / e - 1).max() < 0.03
            assert np.sqrt(np.mean((out / SPEED / e - 1) ** 2)) < 0.015


def _speed(law):
    return {"max_impact_speed": SPEED} if law == "hertz-mindlin" else {}


@pytest.mark.parametrize("law", LAWS)
def test_restitution_does_not_depend_on_the_speed(law):
    made = built(law)
    rows = []
    for speed in (0.01, 0.3, 10.0):
        rows += [
            (elastic(law, made, speed).loading_time / 100, e, 0.0, 0.5, speed, 0.0)
            for e in (0.1, 0.5, 0.8)
        ]
    out = run(made, "sphere", rows)["velocity"][:, -1, 2].reshape(3, 3) / np.array(
        [[0.01], [0.3], [10.0]]
    )
    np.testing.assert_allclose(out, np.broadcast_to([0.1, 0.5, 0.8], (3, 3)), rtol=5e-3)
    np.testing.assert_allclose(out, np.broadcast_to(out[:1], (3, 3)), rtol=1e-9)  # the same but for
    # a scale


@pytest.mark.parametrize("shape", PIECES)
def test_the_dashpot_s_peaks_and_times(shape):
    made = built("linear-dashpot", shape)
    found = traces("linear-dashpot", shape)
    part, factor = phases(16)
    for k, e in enumerate(RESTITUTION[1:], 1):
        ratio = float(dashpot.damping_ratio(jnp.asarray(e)))
        case = DashpotImpact(
            elastic("linear-dashpot", made).mass, pair_of(made).stiffness, ratio, SPEED
        )
        assert case.restitution == pytest.approx(e, rel=1e-12)
        dt = elastic("linear-dashpot", made).loading_time / 100 * factor
        force, height = found["force"][k, 2, :, :, 2], found["height"][k, 2]
        time = dt[:, None] * (np.arange(1, STEPS + 1) - part[:, None])
        counts = (np.arange(STEPS) > 0)[None] & (time < 2 * case.loading_time)  # not the step of
        # first touch
        assert np.abs(force - case.force(time))[counts].max() < 1e-3 * case.peak_force
        first = np.array(
            [
                f[:1].sum() - c[:1].sum() * (0.5 + p)
                for f, c, p in zip(force, case.force(time), 1 - part, strict=True)
            ]
        )
        assert np.abs(first).max() < 0.02 * case.peak_force
        if ratio < 0.45:
            np.testing.assert_allclose(force.max(1), case.peak_force, rtol=3e-4)
        deepest = (PIECES[shape][1] - height).max(1)
        np.testing.assert_allclose(deepest, case.largest_overlap, rtol=3e-4)  # (omega dt)^2 / 8
        # between two readings, and order 2
        lasting = dt * (np.argmax(force[:, 50:] == 0, axis=1) + 50 + 1 - part)
        assert (np.abs(lasting - 2 * case.loading_time) < 1.5 * dt).all()


def test_the_damping_ratio_inverts_the_restitution():
    e = jnp.array([1.0, 0.999, 0.5, 0.136, float(np.exp(-2)), 0.135, 0.1, 0.01, 1e-4])
    ratio = np.asarray(dashpot.damping_ratio(e))
    for z, wanted in zip(ratio, np.asarray(e), strict=True):
        under, over = np.sqrt(max(1 - z * z, 1e-30)), np.sqrt(max(z * z - 1, 1e-30))
        r = (
            np.arccos(z) / under
            if z < 0.999
            else np.arccosh(z) / over
            if z > 1.001
            else 1 + (1 - z) / 3
        )
        assert np.exp(-2 * z * r) == pytest.approx(wanted, rel=1e-6 if 0.999 < z < 1.001 else 1e-11)
    slope = jax.vmap(jax.grad(dashpot.damping_ratio))(e)
    assert np.isfinite(slope).all() and (slope < 0).all()
    assert float(slope[0]) == pytest.approx(-1 / np.pi, rel=1e-12)


# --- Hertz: Chung and Ooi (2011) tests 1 and 2; numbers computed independently of this code ---

GLASS, LIMESTONE = (
    (48e9, 0.2, 2800.0, 274.113e-6, 10.6969e3),
    (20e9, 0.25, 2500.0, 368.304e-6, 7.1082e3),
)
ALUMINIUM, MAGNESIUM = (
    (70e9, 0.3, 2699.0, 49.717e-6, 11.370e3),
    (40e9, 0.35, 1800.0, 52.123e-6, 7.2327e3),
)


def hertz_material(modulus, ratio, density):
    rigid = {
        "wall_youngs_modulus": 1e25,
        "numerical_softening": 1.0,
        "friction_wall": 0.0,
        "friction_piece": 0.0,
        "restitution": 1.0,
    }
    return rigid | {"youngs_modulus": modulus, "poisson_ratio": ratio, "density": density}


@jax.jit
def approach(system, state):
    """Speeds and forces of STEPS steps."""
    return validation.trace_motion(
        validation.with_permanent_pairs(system),
        state,
        STEPS,
        lambda _, s: (s.position, s.velocity, s.motion.force),
    )[1]


@pytest.mark.parametrize(
    "material", [GLASS, LIMESTONE, ALUMINIUM, MAGNESIUM], ids=["glass", "limestone", "Al", "Mg"]
)
def test_elastic_impacts_of_chung_and_ooi(material):
    *kind, deepest, peak = material
    pairs = material in (GLASS, LIMESTONE)
    radius, closing = (0.01, 20.0) if pairs else (0.1, 0.2)
    lasting = 2.943275 * deepest / closing
    dt = lasting / 300
    run = {
        "precision": "f64",
        "time_step": dt,
        "sample_interval": dt,
        "frame_interval": 0.0,
        "gravity": (0.0, 0.0, 0.0),
    }
    sphere, gap = {"shape": "sphere", "radius": radius}, 0.5 * dt * closing
    contact = {"law": "hertz-mindlin", "max_impact_speed": closing}
    if pairs:
        pieces = [
            sphere
            | {
                "position": (0.0, 0.0, s * (radius + 0.5 * gap)),
                "velocity": (0.0, 0.0, -0.5 * s * closing),
            }
            for s in (-1, 1)
        ]
        scene = Scene(piece=pieces, material=hertz_material(*kind), contact=contact, run=run)
    else:
        piece = sphere | {"position": (0.0, 0.0, radius + gap), "velocity": (0.0, 0.0, -closing)}
        scene = validation.plate_scene(piece, run=run, **hertz_material(*kind)).replace(
            contact=contact
        )
    made = assembly.assemble_system(scene)
    place, velocity, force = (np.asarray(x)[:, 2] for x in approach(made.system, made.state))
    depth = 2 * radius - (place[:, 1] - place[:, 0]) if pairs else radius - place[:, 0]
    mass = float(made.system.pieces.mass[0]) / (2 if pairs else 1)
    case = HertzImpact(mass, pair_of_hertz(radius, kind, pairs), closing)
    assert case.largest_overlap == pytest.approx(
        deepest, rel=2e-5
    ) and case.peak_force == pytest.approx(peak, rel=2e-5)
    assert depth.max() == pytest.approx(deepest, rel=1e-4) and np.abs(force).max() == pytest.approx(
        peak, rel=2e-4
    )
    inside = depth > 0
    np.testing.assert_allclose(
        np.abs(force[inside, 0]), case.stiffness * depth[inside] ** 1.5, rtol=1e-9
    )
    end = int(np.flatnonzero(inside)[-1])
    time = dt * (end + 1 - 0.5 + depth[end] / (depth[end] - depth[end + 1]))
    assert time == pytest.approx(lasting, rel=1e-4) and 2 * case.loading_time == pytest.approx(
        lasting, rel=1e-5
    )
    rebound = velocity[-1, 1] - velocity[-1, 0] if pairs else velocity[-1, 0]
    assert rebound == pytest.approx(closing, rel=1e-4)


def pair_of_hertz(radius, kind, pairs):
    """k = 4/3 E* sqrt(R*) (N/m^1.5) of two alike, or against what is rigid."""
    modulus, ratio, _ = kind
    part = 0.5 if pairs else 1.0
    return 4 / 3 * part * modulus / (1 - ratio**2) * np.sqrt(part * radius)


# --- oblique ---


@pytest.mark.parametrize("law", LAWS)
def test_an_impact_that_slides_throughout(law):
    made = built(law, friction=0.3)
    dt, friction = elastic(law, made).loading_time / 100, 1e-3  # of all that slides, loading the
    # spring is some 1e-3
    for e in (0.3, 0.7, 1.0):
        found = run(made, "sphere", [(dt, e, friction, 0.5, SPEED, SPEED)])
        along, surface = ObliqueImpact(e, friction).sliding_speeds(SPEED, SPEED)
        spin = found["momentum"][0, -1, 1] / float(made.system.pieces.inertia[1, 0])
        assert SPEED - found["velocity"][0, -1, 0] == pytest.approx(SPEED - along, rel=2e-3)
        assert -RADIUS * spin == pytest.approx(surface, rel=2e-3)


def test_a_gripping_impact_of_linear_springs():
    made = built("linear-dashpot", friction=0.3)
    for tangential in (2 / 7, 1.0):
        other = replace(
            made, system=made.system.replace(law=LinearDashpot(jnp.asarray(tangential)))
        )
        dt = elastic("linear-dashpot", made).loading_time / 100
        found = run(other, "sphere", [(dt, 1.0, 1e9, 0.5, SPEED, 0.01)])
        spin = found["momentum"][0, -1, 1] / float(made.system.pieces.inertia[1, 0])
        ratio = (found["velocity"][0, -1, 0] - RADIUS * spin) / 0.01
        assert ratio == pytest.approx(ObliqueImpact(1.0, 1e9, tangential).gripping_ratio, abs=2e-3)


def test_a_gripping_impact_of_hertz_and_mindlin():
    """Against the equations of motion, solved to 1e-10: K_t grows with the contact and, as it
    shrinks, takes force away.
    """
    made = built("hertz-mindlin", friction=0.3)
    pair, case = pair_of(made), elastic("hertz-mindlin", made)
    dt, slip = case.loading_time / 100, 0.01

    def motion(_, y):
        s, v, u, spring = y  # overlap, its rate, speed of the contact point, force on it
        s = max(s, 1e-15)
        rate = -pair.tangential * np.sqrt(s) * u + (0.5 * v / s * spring if v < 0 else 0.0)
        return [v, -pair.stiffness * s**1.5 / pair.mass, 3.5 * spring / pair.mass, rate]

    end = lambda t, y: y[0] if t > case.loading_time else 1.0
    end.terminal = True
    exact = solve_ivp(
        motion,
        (0, 4 * case.loading_time),
        [1e-14, SPEED, slip, 0.0],
        "LSODA",
        rtol=1e-10,
        atol=1e-16,
        events=end,
    )
    found = run(made, "sphere", [(dt, 1.0, 1e9, p, SPEED, slip) for p in (0.25, 0.5, 0.75)])
    spin = found["momentum"][:, -1, 1] / float(made.system.pieces.inertia[1, 0])
    after = found["velocity"][:, -1, 0] - RADIUS * spin
    np.testing.assert_allclose(after / slip, exact.y[2, -1] / slip, atol=1e-3)
    # one impulse
    np.testing.assert_allclose(RADIUS * spin, 2.5 * (slip - found["velocity"][:, -1, 0]), rtol=1e-3)


# --- derivatives ---


@pytest.mark.parametrize(
    "law",
    [pytest.param(law, marks=pytest.mark.long) if law == "linear-dashpot" else law for law in LAWS],
)
def test_derivatives_of_the_rebound(law):
    made = built(law)
    dt = jnp.asarray(elastic(law, made).loading_time / 50)

    def rebound(e, speed, part):
        changed = validation.with_restitution(
            validation.with_permanent_pairs(made.system).replace(dt=dt), e
        )
        zero = jnp.zeros_like(e)
        place = jnp.stack([zero, zero, RADIUS + SPEED * dt * part])
        start = made.state.replace_motion(
            position=place[:, None], velocity=jnp.stack([zero, zero, -speed])[:, None]
        )
        return validation.trace_motion(changed, start, 130, lambda _, s: None)[0].velocity[2, 0]

    slopes = jax.jit(jax.grad(rebound, (0, 1, 2)))(
        jnp.asarray(0.6), jnp.asarray(SPEED), jnp.asarray(0.5)
    )
    assert np.isfinite(slopes).all()
    assert float(slopes[0]) == pytest.approx(SPEED, rel=0.01)  # v' = e v
    assert float(slopes[1]) == pytest.approx(0.6, rel=0.01)
