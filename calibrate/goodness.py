"""Goodness of a fit: p-values of traces against data sets simulated by the Product Model."""

import jax
import numpy as np
from numpy.typing import ArrayLike

from calibrate.loss import BLOCKS, MeasuredSummaries
from calibrate.targets import Target, rebin
from calibrate.uncertainty import Refits
from calibrate.unconstrained import ModelParameters
from product_model import Landings, simulate
from product_model import parameters as inputs

ALARM = 0.05  # p-value below which the model does not describe the traces: one false alarm in
# twenty fits
SETS = 1999  # data sets of a check; its least p-value, 1/2000, times five blocks and checks is far
# below ALARM


def check_summaries(trace: Target) -> np.ndarray:
    """Two numbers that are not fitted: ln of the largest mean over 1 ms of the force over the
    weight, and the time (s) from the first impact until such a mean last exceeds 1.3 of the weight
    (rebounds and second peaks lengthen it).
    """
    start = trace.first_impact
    force = rebin(trace, start, 1e-3, int((trace.time[-1] - start) / 1e-3)) / trace.weight
    above = np.flatnonzero(force > 1.3)
    return np.array([np.log(max(force.max(), 1e-6)), 1e-3 * (above[-1] + 1 if len(above) else 0)])


def _energy(x: np.ndarray, y: np.ndarray) -> float:
    """Energy distance of two samples [K] and [M] of a number, U-statistic."""
    return 2.0 * np.abs(x[:, None] - y[None, :]).mean() - _within(x) - _within(y)


def simulated_targets(
    theta: ModelParameters,
    targets: list[Target],
    count: int,
    seed: int,
    landings: Landings | None = None,
) -> list[Target]:
    """`count` traces of the model with the compositions and sample times of `targets` in turn.

    landings: additions of the extended model.
    """
    out = []
    keys = jax.random.split(jax.random.key(seed), count)
    for k in range(count):
        of = targets[k % len(targets)]
        params = inputs(
            **{name: float(theta[name]) for name in theta},
            landings=landings,
            m_piece=of.m_piece,
            pieces=of.pieces,
            gravity=of.gravity,
            sample=of.sample,
            start=float(of.time[0]) - of.sample,
            duration=of.sample * len(of.time),
        )
        trace = simulate(params, keys[k])
        out.append(
            Target(
                trace.time,
                np.asarray(trace.force),
                of.m_piece,
                of.pieces,
                0.0,
                of.gravity,
                f"model:{k}",
            )
        )
    return out


def p_values(
    theta: ModelParameters,
    targets: list[Target],
    measured: MeasuredSummaries,
    distances: ArrayLike,
    refits: Refits | None,
    seed: int,
    sets: int = SETS,
) -> dict[str, float]:
    """name -> p-value, small where the traces differ from portions of the model.

    The blocks' minimised distances are compared with those of the bootstrap refits (left out
    without them), the unfitted checks with synthetic data sets. "all": the least p-value, times
    their number.
    """
    result: dict[str, float] = {}
    if refits is not None:
        result |= _block_p_values(distances, measured, refits)
    model = np.array(
        [check_summaries(t) for t in simulated_targets(theta, targets, 768, seed + 3_000_003)]
    )
    data = np.array([check_summaries(t) for t in targets])
    random = np.random.default_rng([seed, 4])
    for column, name in enumerate(("peak", "late impulse")):
        null, reference = model[256:, column], model[:256, column]
        observed = _energy(data[:, column], reference)
        drawn = [_energy(random.choice(null, len(data)), reference) for _ in range(sets)]
        result[name] = (1 + sum(d >= observed for d in drawn)) / (sets + 1)
    result["all"] = min(1.0, min(result.values()) * len(result))
    return result


def _within(x: np.ndarray) -> np.ndarray:
    """Mean distance of pairs of different entries of `x` [..., K]."""
    rank = 2.0 * np.arange(x.shape[-1]) - x.shape[-1] + 1.0
    return 2.0 * np.sort(x, axis=-1) @ rank / max(x.shape[-1] * (x.shape[-1] - 1), 1)


def complete_distances(parts: ArrayLike, measured: MeasuredSummaries) -> np.ndarray:
    """[..., 3] energy distances of the blocks with the part that depends on the data alone, which
    the loss omits.
    """
    columns = measured.columns(measured.height, measured.spread, measured.increments)
    within = _within(np.moveaxis(np.asarray(columns), -2, -1))
    return np.asarray(parts) - np.stack(
        [within[..., 0], within[..., 1], np.mean(within[..., 2:], axis=-1)], axis=-1
    )


def _block_p_values(
    distances: ArrayLike, measured: MeasuredSummaries, refits: Refits
) -> dict[str, float]:
    observed = complete_distances(distances, measured)
    null = complete_distances(refits.solution.distances, refits.sets)
    return {
        name: float((1 + np.sum(null[:, k] >= observed[k])) / (1 + len(null)))
        for k, name in enumerate(BLOCKS)
    }


def rmse_g(theta: ModelParameters, targets: list[Target], align: str, seed: int) -> float:
    """The paper's figure (g): root mean square difference of the PIF of each trace and of one
    random model trace, aligned alike, mean over the traces. Dominated by the random times of
    impact, hence never fitted.
    """
    values = []
    for trace, model in zip(
        targets, simulated_targets(theta, targets, len(targets), seed + 5_000_003), strict=True
    ):
        shift = trace.first_impact - model.first_impact if align == "first-impact" else 0.0
        other = np.interp(trace.time - shift, model.time, model.force)
        values.append(np.sqrt(np.mean((trace.force - other) ** 2)) / trace.gravity * 1e3)
    return float(np.mean(values))


def statements(p: dict[str, float], refits: int) -> list[str]:
    """Whether the model describes the traces, in words. refits: number of the bootstrap, which
    limits the least p-value of a block.
    """
    lines = _limits(p, refits)
    if p["all"] >= ALARM:
        return [*lines, f"no difference from the Product Model was found (p = {p['all']:.2g})"]
    worst = min((name for name in p if name != "all"), key=p.__getitem__)
    return [
        *lines,
        f"the Product Model does not describe these traces (p = {p['all']:.2g}, worst: {worst}): look for rebounds, "
        "delayed second peaks or impacts that are not rectangular; the intervals hold only within the model",
    ]


def _limits(p: dict[str, float], refits: int) -> list[str]:
    if not refits:
        return [
            "goodness of fit from peak and late impulse alone: the distances of the blocks need bootstrap refits"
        ]
    if len(p) - 1 >= ALARM * (1 + refits):
        return [
            f"{refits} refits are too few for a misfit of the blocks to be told: take at least 100"
        ]
    return []
