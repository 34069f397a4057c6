"""Traces that the Product Model itself made, with known parameters."""

import numpy as np

from calibrate.targets import target
from product_model import ensemble, parameters

TRUTH = {"dt_impact": 500e-6, "gamma_low": 0.02, "gamma_high": 0.06, "h_mean": 0.25}


def traces(count=16, pieces=16, seed=100, **changes):
    params = parameters(
        pieces=pieces, m_piece=0.05 / pieces, sample=6e-5, duration=0.42, **(TRUTH | changes)
    )
    made = ensemble(params, seed, count)
    return [target(made.time, np.asarray(force), 0.05 / pieces, pieces) for force in made.force]
