"""Eqs 9-22 of the paper written down once more in plain NumPy, one piece and one sample at a time."""

import math

import numpy as np

G = 9.81


def sigma_height(gamma_low, gamma_high, z):
    sigma = gamma_low + (gamma_high - gamma_low) / 3 * z  # eqs 19-21 for the standard normal z
    return gamma_low if sigma < gamma_low else sigma  # eq. 22


def force_of_piece(t, height, mass, dt_impact):
    velocity = math.sqrt(2 * G * height)  # eq. 9
    impact = mass * velocity / dt_impact  # eqs 11-13
    t_i = math.sqrt(2 * height / G)  # eq. 14
    if t < t_i:
        return 0.0
    return impact if t < t_i + dt_impact else mass * G


def force(times, heights, mass, dt_impact):
    # eq. 15
    return np.array([sum(force_of_piece(t, h, mass, dt_impact) for h in heights) for t in times])


def mean_force(edges, heights, mass, dt_impact):
    """Mean of the same force between neighbouring `edges`, from its antiderivative."""
    total = np.zeros(len(edges))
    for h in heights:
        velocity, t_i = math.sqrt(2 * G * h), math.sqrt(2 * h / G)
        total += mass * velocity / dt_impact * np.clip(edges - t_i, 0, dt_impact)
        total += mass * G * np.maximum(edges - t_i - dt_impact, 0)
    return np.diff(total) / np.diff(edges)
