"""How soon a scale knows the weight: tuned filters and an estimator of ``calibrate weigher``, on
drops that neither has seen.

``python -m benchmarks.weighing [--quick] [--drops FOLDER]``. Simulated drops into the stock weigh
bucket on a load cell of 1 kg, 50 Hz and damping 0.02, read at 1 kHz with typical noise. Filters are
tuned and the estimator learns on drops of one set of seeds; both are judged on drops of another. A
drop counts by the time from its first impact until the error stays within a tolerance.
"""

import argparse
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import report
from calibrate.empty_cell import EmptyCell
from calibrate.weigher_fit import learn_weigher
from dem_jax import ensemble, load_scene
from dem_jax.scene import LoadCell
from dem_jax.weighing import filters
from dem_jax.weighing.cell import Cell, build_cell
from dem_jax.weighing.settling import find_quantile, time_to_weigh
from dem_jax.weighing.signal_noise import TYPICAL, add_noise
from dem_jax.weighing.traces import extract_trace
from dem_jax.weighing.tuning import Drops, tune_filters, weigh_drops
from product_model.decision import first_decision
from product_model.weigher import Reading, Weigher

PRODUCTS = {
    "marshmallow": tuple(range(5, 14)),
    "hazelnut": (38, 46, 54),
    "cherry-tomato": (5, 7, 9, 11, 13),
}
RUNS, LEARN, JUDGE = 16, 1, 501  # drops for each number of pieces; seeds of the two sets
CELL = EmptyCell(1.0, 50.0, 0.02)
SAMPLE, RATE = 2.5e-4, 1000.0  # s, of the simulation; readings per second
TOLERANCES, SHARES = (1e-3, 5e-4, 1e-4), (0.5, 0.9, 0.99)  # kg
REST, LAST = 0.03, 200  # relative; readings: a drop counts if the mean of the last ones is the
# weight
EDGE = 15  # readings at the end, which a late release makes up
FEW = 40  # portions
FILTERS = (
    "average:0.1",
    "average:0.2",
    "average:0.1:0.1",
    "bessel:4:8",
    "bessel:4:5",
    "bessel:3:2.7",
)
CONFIDENCES = (0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999)
HOLDS, BANDS, RIGHT = (20, 50, 100), (0.1, 0.2, 0.5, 1.0, 2.0), 0.99  # readings; of the tolerance;
# share of the drops
DECISIONS = """## When a scale decides

A filter's reading counts when it has stayed within a band for a while, the estimator's when its own
error bar is within the tolerance. Filter, band and duration are those of the least mean time since the
first impact, of those that are right in 99 % of the drops learnt from (if none is, the most often
right). The confidence is chosen in the same way, on one half of these drops by an estimator that has
learnt from the other half; the estimator that is judged has learnt from all."""
IMPACT = 0.01  # kg: first reading above, without noise

Outcome = tuple[float, float]  # mean time (s) of a decision, share of the drops that are decided
# right


@dataclass(frozen=True)
class Signals:
    """values: [K, n] (g). weights: [K] (g). impact: [K] (s) first impact; a late release is noise."""

    values: np.ndarray
    weights: np.ndarray
    impact: np.ndarray

    @property
    def drops(self) -> Drops:
        """The signals as filters take them."""
        time = np.arange(1, self.values.shape[1] + 1) / RATE
        return Drops(time, 1e-3 * self.values, 1e-3 * self.weights, self.impact)


def simulate(
    product: str, count: int, seed: int, folder: Path, runs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Signals of the cell [K, T] (kg) without noise and weights [K] (kg), from a file where there
    is one.
    """
    path = folder / f"{product}-{count:03d}-s{seed}.npz"
    if not path.exists():
        changes = {
            "product": product, "portion.count": count, "weigh_bucket.load_cell.natural_frequency": CELL.frequency,
            "weigh_bucket.load_cell.damping_ratio": CELL.damping_ratio, "run.duration": 1.0, "run.frames": 0.0,
            "run.sample": SAMPLE, "run.escape": "note",
        }  # fmt: skip
        trace = extract_trace(
            ensemble(load_scene("weigh-bucket", changes), runs, seed + 1000 * count)
        )
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, weight=trace.weight.astype(np.float32), truth=trace.truth)
    with np.load(path) as stored:
        return stored["weight"].astype(float), stored["truth"].astype(float)


def signals_of(product: str, counts, seed: int, folder: Path, runs: int = RUNS) -> Signals:
    """Noisy signals of drops that come to rest."""
    values, weights, impact = [], [], []
    for count in counts:
        weight, truth = simulate(product, count, seed, folder, runs)
        plain = weight.reshape(len(weight), -1, round(1 / (RATE * SAMPLE))).mean(axis=-1)
        load = truth[:, None] * (np.arange(plain.shape[1]) > 0.35 * RATE)
        noisy = add_noise(plain, RATE, TYPICAL, _cell(), (0, seed, count), 0.0, load)
        rests = np.abs(plain[:, -LAST:].mean(axis=1) - truth) < REST * truth
        values.append(1e3 * noisy[rests, :-EDGE])
        weights.append(1e3 * truth[rests])
        impact.append(np.argmax(plain[rests] > IMPACT, axis=1) / RATE)
    return Signals(*(np.concatenate(parts) for parts in (values, weights, impact)))


def tune(learnt: Signals, product: str, folder: Path) -> dict[float, str]:
    """The best filter for each tolerance (kg), from a file where there is one."""
    path = folder / f"filters-{product}.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for tolerance in TOLERANCES:
        if f"{tolerance:g}" not in known:
            known[f"{tolerance:g}"] = tune_filters([learnt.drops], RATE, tolerance, [_cell()])[
                0
            ].filter
            path.write_text(json.dumps(known), encoding="utf-8")
    return {tolerance: known[f"{tolerance:g}"] for tolerance in TOLERANCES}


def estimated(
    weigher: Weigher, judge: Signals
) -> tuple[dict[float, np.ndarray], np.ndarray, float]:
    """Times (s) since the first impact for each tolerance (kg), whether drops are doubted [K], and
    the share of readings from 50 ms after the impact on whose error is within the 95 % interval,
    where they are believed.
    """
    reading = weigher.read(judge.values)
    drops = judge.drops
    times = {
        tolerance: time_to_weigh(drops.time, 1e-3 * reading.grams, drops.truth, tolerance, 0.05)
        - judge.impact
        for tolerance in TOLERANCES
    }
    counts = reading.believed & (drops.time > judge.impact[:, None] + 0.05)
    inside = np.abs(reading.grams - judge.weights[:, None]) < 1.96 * reading.sd
    return (
        times,
        (reading.doubts > 0).any(axis=1),
        float(inside[counts].mean()) if counts.any() else np.nan,
    )


def _cell() -> Cell:
    return build_cell(
        LoadCell(mass=CELL.mass, natural_frequency=CELL.frequency, damping_ratio=CELL.damping_ratio)
    )


def learn(signals: Signals, count: int | None = None, cell: EmptyCell = CELL) -> Weigher:
    """An estimator of all or of some portions, drawn at random."""
    some = np.random.default_rng(0).permutation(len(signals.weights))[:count]
    return learn_weigher(
        [signals.values[k] for k in some], signals.weights[some], 1 / RATE, cell
    ).weigher


def in_words(times: np.ndarray) -> str:
    """Quantiles (ms)."""
    found = [find_quantile(times, share) for share in SHARES]
    return " / ".join(f"{1e3 * time:.0f}" if np.isfinite(time) else "-" for time in found)


def rows_of(
    product: str, sets: dict[str, tuple[Signals, Signals]], texts: dict[float, str]
) -> list[list[str]]:
    """Rows of the table for a product."""
    learnt, judge = sets[product]
    weigher = learn(learnt)
    name = f"{product} ({len(judge.weights)})"
    rows = []
    if texts:
        best = {t: weigh_drops(text, [judge.drops], RATE, t).impact for t, text in texts.items()}
        rows.append([name, "best tuned filter", *(in_words(best[t]) for t in TOLERANCES), "", ""])
        print(*rows[-1], sep=" | ", flush=True)
    stiff = EmptyCell(CELL.mass, 1.05 * CELL.frequency, CELL.damping_ratio)
    cases = {
        f"estimator, {len(learnt.weights)} portions": (weigher, judge),
        f"estimator, {FEW} portions": (learn(learnt, FEW), judge),
        "estimator, frequency 5 % too high": (learn(learnt, cell=stiff), judge),
        "its filter that stands in, alone": (stand_in(weigher), judge),
        "a second portion after 0.1 s": (weigher, two_portions(judge)),
        "the same, stand-in alone": (stand_in(weigher), two_portions(judge)),
        "a tenth comes 0.2 s late": (weigher, late_piece(judge)),
        "the same late tenth, stand-in alone": (stand_in(weigher), late_piece(judge)),
    }
    for other in sets:
        if other != product:
            cases[f"{other} on this estimator"] = (weigher, sets[other][1])
            cases[f"{other}, stand-in alone"] = (stand_in(weigher), sets[other][1])
    for words, (each, signals) in cases.items():
        times, doubted, inside = estimated(each, signals)
        shown = [in_words(times[t]) for t in TOLERANCES]
        rows.append(
            [
                name,
                words,
                *shown,
                f"{100 * inside:.0f} %" if np.isfinite(inside) else "",
                f"{100 * doubted.mean():.0f} %",
            ]
        )
        print(*rows[-1], sep=" | ", flush=True)
    return rows


def stand_in(weigher: Weigher) -> Weigher:
    """An estimator that is never believed."""
    return replace(weigher, threshold=np.full(3, -1e9))


def decisions(
    product: str, learnt: Signals, judge: Signals, texts: dict[float, str]
) -> list[list[str]]:
    """Rows: when a scale decides, and whether it is right. Filters and the confidence are chosen on
    the drops learnt from: of those that are right in 99 % the soonest.
    """
    chosen = take(learnt, slice(1, None, 2))
    pairs = [(chosen, learn(take(learnt, slice(0, None, 2)))), (judge, learn(learnt))]
    readings = [(each, weigher.read(each.values)) for each, weigher in pairs]
    filters_tried = dict.fromkeys([*FILTERS, *texts.values()])
    shown = {
        text: [(each, filtered(text, each)) for each in (learnt, judge)] for text in filters_tried
    }
    rows = []
    for tolerance in TOLERANCES[:2]:
        found = {
            "filter": filter_ways(shown, tolerance),
            "estimator": estimator_ways(readings, tolerance),
        }
        for kind, ways in found.items():
            words = best_way(ways)
            mean, right = ways[words][1]
            rows.append(
                [
                    product,
                    f"{1e3 * tolerance:g} g",
                    kind,
                    words,
                    f"{1e3 * mean:.0f}",
                    f"{100 * right:.1f} %",
                ]
            )
            print(*rows[-1], sep=" | ", flush=True)
    return rows


def filter_ways(
    shown: dict[str, list[tuple[Signals, np.ndarray]]], tolerance: float
) -> dict[str, list[Outcome]]:
    """Outcomes on the drops that choose and on those that judge, of all filters, durations and
    bands.
    """
    ways = {}
    for (text, parts), hold, band in itertools.product(shown.items(), HOLDS, BANDS):
        words = f"{text}, within {1e3 * band * tolerance:g} g for {1e3 * hold / RATE:g} ms"
        ways[words] = [
            _outcome(each, still(each, values, hold, band * 1e3 * tolerance), values, tolerance)
            for each, values in parts
        ]
    return ways


def estimator_ways(
    readings: list[tuple[Signals, Reading]], tolerance: float
) -> dict[str, list[Outcome]]:
    """Outcomes on the drops that choose and on those that judge, of all confidences."""
    return {
        f"confidence {confidence:g}": [
            _outcome(
                each, first_decision(reading, 1e3 * tolerance, confidence), reading.grams, tolerance
            )
            for each, reading in readings
        ]
        for confidence in CONFIDENCES
    }


def best_way(ways: dict[str, list[Outcome]]) -> str:
    """The soonest of those that are right often enough on the drops that choose; else the most
    often right.
    """
    enough = {words: outcomes for words, outcomes in ways.items() if outcomes[0][1] >= RIGHT}
    return (
        min(enough, key=lambda words: enough[words][0][0])
        if enough
        else max(ways, key=lambda words: ways[words][0][1])
    )


def take(signals: Signals, which: slice) -> Signals:
    """Some of the drops."""
    return Signals(signals.values[which], signals.weights[which], signals.impact[which])


def filtered(text: str, signals: Signals) -> np.ndarray:
    """[K, n] (g) readings through a filter, whose levels are in kg."""
    return 1e3 * filters.filter_signal(filters.parse_filter(text, RATE), signals.drops.signal)


def still(signals: Signals, values: np.ndarray, hold: int, band: float) -> np.ndarray:
    """[K] the first reading after the impact for which the last ``hold`` readings lie within a band
    (g); -1: none.
    """
    window = np.lib.stride_tricks.sliding_window_view(values, hold, axis=1)
    is_still = np.ptp(window, axis=-1) < band
    begins = (signals.impact * RATE).astype(int)[:, None] + 5
    is_still &= np.arange(is_still.shape[1]) >= begins
    return np.where(is_still.any(axis=1), is_still.argmax(axis=1) + hold - 1, -1)


def _outcome(signals: Signals, at: np.ndarray, grams: np.ndarray, tolerance: float) -> Outcome:
    """Mean time (s) since the first impact of the drops that are decided, and the share of all that
    are decided right.
    """
    decided = at >= 0
    off = np.abs(grams[np.arange(len(at)), at] - signals.weights)
    right = decided & (off <= 1e3 * tolerance)
    return float(np.mean((at + 1) / RATE - signals.impact, where=decided)), float(right.mean())


def plot(learnt: Signals, judge: Signals, texts: dict[str, str], path: Path) -> None:
    """Errors over the time since the first impact: the median and nine tenths of the drops."""
    from matplotlib.figure import Figure

    weigher = learn(learnt)
    curves = {"estimator": weigher.read(judge.values).grams}
    for words, text in texts.items():
        curves[f"{words} ({text})"] = filtered(text, judge)
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(600)
    first = np.round(judge.impact * RATE).astype(int)[:, None]
    for k, (words, grams) in enumerate(curves.items()):
        off = np.abs(grams - judge.weights[:, None])
        off = np.take_along_axis(off, np.minimum(first + rows, off.shape[1] - 1), axis=1)
        axes.semilogy(rows, np.median(off, axis=0), color=f"C{k}", label=f"{words}: median")
        axes.semilogy(
            rows,
            np.quantile(off, 0.9, axis=0),
            color=f"C{k}",
            ls="--",
            lw=1.0,
            label="90 % of the drops",
        )
    for tolerance in TOLERANCES:
        axes.axhline(1e3 * tolerance, color="0.5", lw=0.6)
    axes.set(
        xlabel="time since the first impact (ms)",
        ylabel="error of the reading (g)",
        xlim=(0, 600),
        ylim=(0.03, 300),
    )
    axes.legend(fontsize=8, loc="upper right")
    figure.savefig(path, dpi=120)


def later(values: np.ndarray, readings: int) -> np.ndarray:
    """Signals less their tare, that come later."""
    net = values - values[:, :100].mean(axis=1, keepdims=True)
    return np.pad(net, [(0, 0), (readings, 0)])[:, : values.shape[1]]


def two_portions(signals: Signals) -> Signals:
    """The portion of each drop and that of the drop before, which is 0.1 s late."""
    second = np.roll(later(signals.values, 100), 1, axis=0)
    return replace(
        signals,
        values=signals.values + second,
        weights=signals.weights + np.roll(signals.weights, 1),
    )


def late_piece(signals: Signals) -> Signals:
    """A tenth of each portion comes 0.2 s late."""
    values = 0.9 * signals.values + 0.1 * later(signals.values, 200)
    return replace(signals, values=values)


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.weighing", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="marshmallow of 8 and 10 pieces alone, without tuned filters",
    )
    parser.add_argument(
        "--drops",
        type=Path,
        default=Path("out/weighing"),
        help="folder of simulated drops, which are kept",
    )
    options = parser.parse_args(argv)
    products = {"marshmallow": (8, 10)} if options.quick else PRODUCTS
    sets = {}
    for product, counts in products.items():
        sets[product] = tuple(
            signals_of(product, counts, seed, options.drops) for seed in (LEARN, JUDGE)
        )
    texts = (
        {}
        if options.quick
        else {product: tune(sets[product][0], product, options.drops) for product in products}
    )
    rows = [row for product in products for row in rows_of(product, sets, texts.get(product, {}))]
    decided = [
        row
        for product in products
        for row in decisions(product, *sets[product], texts.get(product, {}))
    ]
    head = ["product (drops)", "reading"]
    head += [f"within {1e3 * t:g} g: 50 / 90 / 99 % (ms)" for t in TOLERANCES] + [
        "95 % interval holds",
        "doubted",
    ]
    parts = [
        f"# Weighing\n\n{__doc__.strip()}",
        report.environment(),
        report.table(head, rows),
        DECISIONS,
    ]
    parts.append(
        report.table(
            ["product", "tolerance", "reading", "rule", "mean time (ms)", "decided right"], decided
        )
    )
    figure = {
        f"filter tuned for {1e3 * t:g} g": text
        for t, text in texts.get("marshmallow", {}).items()
        if t != TOLERANCES[1]
    }
    plot(*sets["marshmallow"], figure, report.place("weighing.png", options.quick))
    text = "\n\n".join([*parts, "![Errors over time](weighing.png)"])
    report.write("weighing", text, options.quick)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
