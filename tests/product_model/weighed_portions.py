"""Signals of portions on a load cell, and estimators of their weight."""

from dataclasses import replace

import numpy as np

from product_model.weigher import Weigher, cell_step

H, OMEGA, ZETA, MASS = 1e-3, 2 * np.pi * 50.0, 0.02, 1000.0  # s, 1/s, ratio, g
ROWS, LEAD, TARE = 150, 80, 12.5


def make_weigher(momentum, residual=1e-7, **changes):
    """An estimator of a product with this mean momentum per weight [ROWS + 1] (s), a cell known
    exactly and nearly no noise."""
    values = dict(
        interval=H,
        omega=OMEGA,
        delta=ZETA * OMEGA,
        mass=MASS,
        stiffness_sd=1e-7,
        damping_sd=1e-7,
        kick=1.0,
        kick_rate=1e-9,
        load_rate=1e-9,
        white=1e-3,
        line=np.zeros(2),
        line_innovation=0.0,
        drift=1e-12,
        level=1e-3,
        weight=50.0,
        least=5.0,
        most=500.0,
        impulse=H - np.diff(momentum),
        shapes=np.zeros((ROWS, 1)),
        residual=np.full(ROWS, residual),
        residual_decay=0.9,
        landed=np.clip(1 - momentum[1:] / max(momentum[0], 1e-9), 0, 1),
        pulse=np.zeros(ROWS),
        widening=np.ones(ROWS),
        check_mean=np.zeros((ROWS, 3)),
        check_sd=np.ones((ROWS, 3)),
        check_decay=0.95,
        threshold=np.full(3, 5.0),
        sections=np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]]),
        filter_sd=np.full(ROWS, 100.0),
        settled=10 * ROWS,
    )
    return Weigher(**values | changes)


def show(impulses, landed, weight, omega=OMEGA, mass=MASS):
    """Signal (g) of the cell under impulses (g s) of samples from LEAD on, with a share of the
    weight on it."""
    xi = eta = 0.0
    signal = [TARE] * LEAD
    for impulse, share in zip(impulses, landed, strict=True):
        ratio = mass / (mass + weight * share)
        e00, e01, e10, e11, g0, g1 = cell_step(np, omega**2 * ratio, ZETA * OMEGA * ratio, H)
        xi, after = e00 * xi + e01 * eta + g0 * impulse, e10 * xi + e11 * eta + g1 * impulse
        signal.append(TARE + (impulse - (after - eta)) / H)
        eta = after
    return np.array(signal)


def portions(count=6):
    """Signals [count, n] of a product with scatter, noise, and weights of 30 to 70 g; an estimator
    of it."""
    random = np.random.default_rng(3)
    momentum = 0.2 * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    shape = 0.3 * np.exp(-np.arange(ROWS + 1) * H / 0.03)
    weigher = make_weigher(
        momentum,
        1e-3,
        shapes=-np.diff(shape)[:, None],
        white=0.1,
        level=3.0,
        stiffness_sd=0.01,
        damping_sd=0.1,
    )
    weigher = replace(weigher, check_sd=np.full((ROWS, 3), 0.5))
    weights = np.linspace(30.0, 70.0, count)
    signals = []
    for weight in weights:
        impulses = weight * weigher.impulse + random.standard_normal() * weigher.shapes[:, 0]
        signals.append(show(impulses, weigher.landed, weight))
    return np.array(signals) + 0.1 * random.standard_normal((count, LEAD + ROWS)), weights, weigher
