"""Impacts of a mass on the spring of a contact law, for tests of laws without a scene."""

import jax
import jax.numpy as jnp

from dem_jax.contact_laws import ContactKinematics


def trace_impacts(law, pair, mass, speed, dt, steps, phase=0.5):
    """Overlap (m), force (N), speed (m/s) and energy (J), [steps, P], of impacts by kick, drift,
    kick.

    Args:
        law: contact law without friction.
        pair: its constants.
        mass: (kg).
        speed: [P] (m/s) of the impact.
        dt: [P] (s) time step.
        steps: number of steps.
        phase: part of a step after which they touch.
    """
    zero = jnp.zeros_like(speed)
    nothing = (zero, zero, zero)

    def step(carry, _):
        overlap, velocity, push, history = carry
        velocity = velocity - 0.5 * dt * push / mass
        moved = velocity * dt
        overlap = overlap + moved
        answer = law.force(pair, history, ContactKinematics(overlap, moved, nothing, nothing, dt))
        velocity = velocity - 0.5 * dt * answer.normal_force / mass
        seen = overlap, answer.normal_force, velocity, law.energy(pair, answer.history, overlap)
        return (overlap, velocity, answer.normal_force, answer.history), seen

    first = (-phase * speed * dt, speed, zero, law.init_history(pair, zero))
    return jax.lax.scan(step, first, None, steps)[1]
