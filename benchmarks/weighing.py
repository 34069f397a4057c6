"""How soon a scale knows the weight: tuned filters and an estimator of ``calibrate weigher``, on
drops that neither has seen.

``python -m benchmarks weighing [--quick] [--drops FOLDER] [--product NAME]``. Drops into the stock
weigh bucket on a load cell of 1 kg, 50 Hz and damping 0.02, simulated by ``dem-jax ensemble``, read
at 1 kHz with typical noise. Filters are tuned and the estimator learns on drops of one seed; both
are judged on drops of another. A drop counts by the time from its first impact until the error
stays within a tolerance.
"""

import argparse
import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import report
from calibrate.empty_cell import EmptyCell, dem_cell
from calibrate.errors import BadInput
from calibrate.weigher_fit import learn_weigher
from dem_jax.__main__ import main as run_dem_jax
from dem_jax.visualization.scale_readings import convert_trace, read_settled_trace
from dem_jax.weighing import filters
from dem_jax.weighing.settling import HOLD, find_quantile, time_to_weigh
from dem_jax.weighing.signal_noise import TYPICAL
from dem_jax.weighing.tuning import Drops, tune_filters, weigh_drops
from product_model.decision import check_decision, first_decision
from product_model.weigher import Reading, Weigher


@dataclass(frozen=True)
class Plan:
    """Drops of a product. counts: numbers of pieces, as --vary takes them. runs, seeds: of the
    drops that are learnt from and of those that judge.
    """

    counts: str
    runs: tuple[int, int]
    seeds: tuple[int, int]


PRODUCTS = {
    "marshmallow": Plan("5:13", (63, 99), (1001, 2001)),
    "hazelnut": Plan("38:54:4", (40, 60), (1005, 2005)),
    "cherry-tomato": Plan("5:13", (63, 99), (1002, 2002)),
    "nugget": Plan("3:8", (60, 60), (1003, 2003)),
    "chocolate-ball": Plan("18:26:2", (45, 70), (1004, 2004)),
}
QUICK = {"marshmallow": Plan("8:9", (16, 8), (1, 2))}
CELL = EmptyCell(1.0, 50.0, 0.02)
RATE, DURATION = 1000.0, 1.2  # readings per second; s
TOLERANCES, SHARES = (1.0, 0.5, 0.1), (0.5, 0.9, 0.99)  # g
PORTIONS, FEW = 40, (10, 20)  # learnt from
OTHERS = 40  # drops of another product
SETTLED = 0.05  # s after the first impact, from which on error bars are judged
JITTER = 5e-3  # s, of the release, instead of 2e-3
BOOTSTRAPS, COVERAGE = 1000, 0.9
FILTERS = (
    "average:0.1",
    "average:0.2",
    "average:0.1:0.1",
    "bessel:4:8",
    "bessel:4:5",
    "bessel:3:2.7",
)
HOLDS, BANDS, RIGHT = (20, 50, 100), (0.1, 0.2, 0.5, 1.0, 2.0), 0.99  # readings; of the tolerance
CONFIDENCE = 0.99

Outcome = tuple[float, float]  # mean time (s) of a decision, share of the drops decided right


@dataclass(frozen=True)
class Signals:
    """values: [K, n] (g). weights: [K] (g). impact: [K] (s) first impact. time: [n] (s)."""

    values: np.ndarray
    weights: np.ndarray
    impact: np.ndarray
    time: np.ndarray

    @property
    def drops(self) -> Drops:
        """The signals as filters take them."""
        return Drops(self.time, 1e-3 * self.values, 1e-3 * self.weights, self.impact)

    def take(self, which: slice | np.ndarray) -> "Signals":
        """Some of the drops."""
        return Signals(self.values[which], self.weights[which], self.impact[which], self.time)


def simulate(product: str, plan: Plan, is_judge: bool, folder: Path) -> Path:
    """The file of an ensemble, made by the command where there is none."""
    path = folder / f"{product}-{'judge' if is_judge else 'learn'}.h5"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        cell = {
            "natural_frequency": CELL.frequency,
            "damping_ratio": CELL.damping_ratio,
            "mass": CELL.mass,
        }
        settings = [f"weigh_bucket.load_cell.{key}={value:g}" for key, value in cell.items()]
        settings += [f"product={product}", "run.on_escape=warn"]
        changes = [word for setting in settings for word in ("--set", setting)]
        runs = ["--runs", str(plan.runs[is_judge]), "--seed", str(plan.seeds[is_judge])]
        thin = ["--record-rate", f"{RATE:g}", "--duration", f"{DURATION:g}", "--no-plot"]
        counts = ["--vary", f"portion.count={plan.counts}"]
        code = run_dem_jax(
            ["ensemble", "weigh-bucket", *counts, *runs, *thin, *changes, "--out", str(path)]
        )
        if code:
            raise SystemExit(code)
    return path


def load(path: Path, seed: int, jitter: float = TYPICAL.release_jitter) -> Signals:
    """Signals of the drops of a file that come to rest, with noise."""
    trace, _ = read_settled_trace(path, None, None, None)
    noise = TYPICAL.model_copy(update={"release_jitter": jitter})
    drops = convert_trace(trace._replace(noise=noise), RATE, (seed,))
    known = np.isfinite(drops.truth)
    values, weights = 1e3 * drops.signal[known], 1e3 * drops.truth[known]
    return Signals(values, weights, drops.impact[known], drops.time)


def learn(
    signals: Signals, count: int = PORTIONS, cell: EmptyCell = CELL, is_known: bool = True
) -> Weigher:
    """An estimator of some portions, drawn at random; is_known: whether their weights are, else
    they are read at rest.
    """
    some = np.random.default_rng(0).permutation(len(signals.weights))[:count]
    weights = signals.weights[some] if is_known else None
    return learn_weigher([signals.values[k] for k in some], weights, 1 / RATE, cell).weigher


def stand_in(weigher: Weigher) -> Weigher:
    """The filter of an estimator alone."""
    nothing, never = np.zeros((len(weigher.impulse), 0)), np.zeros(len(weigher.impulse))
    return replace(weigher, shapes=nothing, threshold=np.full(3, -1e9), widening=never + 1e9)


def times_of(signals: Signals, grams: np.ndarray, tolerance: float) -> np.ndarray:
    """[K] (s) since the first impact until readings [K, n] (g) stay within a tolerance (g)."""
    return time_to_weigh(signals.time, grams, signals.weights, tolerance, HOLD) - signals.impact


# ---- how soon ----


def describe_times(times: np.ndarray) -> str:
    """Quantiles (ms), those of half and of nine in ten with their intervals."""
    words = []
    for share in SHARES:
        value = shown(find_quantile(times, share))
        if share < SHARES[-1]:
            low, high = interval(lambda pick, q=share: find_quantile(times[pick], q), len(times))
            value += f" ({shown(low)}-{shown(high)})"
        words.append(value)
    return " / ".join(words)


def shown(time: float) -> str:
    """A time in ms."""
    return f"{1e3 * time:.0f}" if np.isfinite(time) else "never"


def interval(statistic: Callable[[np.ndarray], float], count: int) -> np.ndarray:
    """[2] percentiles of a statistic of resampled drops; never is later than any time."""
    random = np.random.default_rng(0)
    found = [statistic(random.integers(0, count, count)) for _ in range(BOOTSTRAPS)]
    ordered = np.where(np.isnan(found), np.inf, found)
    return np.quantile(ordered, [0.5 - COVERAGE / 2, 0.5 + COVERAGE / 2], method="nearest")


def describe_ratio(ours: np.ndarray, theirs: np.ndarray) -> str:
    """Quantiles of our times over those of others, with intervals over drops."""
    words = []
    for share in SHARES[:2]:
        ratio = lambda pick, q=share: find_quantile(ours[pick], q) / find_quantile(theirs[pick], q)  # noqa: E731
        value, (low, high) = ratio(np.arange(len(ours))), interval(ratio, len(ours))
        words.append(f"{value:.2f} ({low:.2f}-{high:.2f})" if np.isfinite(value) else "-")
    return " / ".join(words)


def describe_bars(signals: Signals, reading: Reading) -> tuple[str, str]:
    """Share of believed readings within their 95 % interval, and share of the drops that are
    doubted.
    """
    counts = reading.believed & (signals.time > signals.impact[:, None] + SETTLED)
    inside = np.abs(reading.grams - signals.weights[:, None]) < 1.96 * reading.sd
    doubted = (reading.doubts > 0).any(axis=1)
    holds = f"{100 * inside[counts].mean():.1f} %" if counts.any() else ""
    return holds, f"{100 * doubted.mean():.0f} %"


def rows_of_speed(
    product: str, learnt: Signals, judge: Signals, jittered: Signals, texts: dict[float, str]
) -> list[list[str]]:
    """Rows of the first table for a product."""
    rows = []
    best = {t: weigh_drops(text, [judge.drops], RATE, 1e-3 * t).impact for t, text in texts.items()}
    if best:
        rows.append(
            [product, "best tuned filter", *(describe_times(best[t]) for t in TOLERANCES), "", ""]
        )
    cells = [replace(CELL, frequency=factor * CELL.frequency) for factor in (0.95, 1.05)]
    cases = {f"estimator, {PORTIONS} portions": (learn(learnt), judge)}
    if len(learnt.weights) > PORTIONS:
        cases[f"{len(learnt.weights)} portions"] = (learn(learnt, len(learnt.weights)), judge)
    cases |= {f"{count} portions": (learn(learnt, count), judge) for count in FEW}
    try:
        cases["weights read at rest in the signals"] = (learn(learnt, is_known=False), judge)
    except BadInput as error:
        print(f"weights read at rest: {error}", flush=True)  # some ring too much at the end
    cases["frequency 5 % too low"] = (learn(learnt, cell=cells[0]), judge)
    cases["frequency 5 % too high"] = (learn(learnt, cell=cells[1]), judge)
    cases[f"release scatters by {1e3 * JITTER:g} ms"] = (
        cases[f"estimator, {PORTIONS} portions"][0],
        jittered,
    )
    for words, (weigher, signals) in cases.items():
        reading = weigher.read(signals.values)
        times = {t: times_of(signals, reading.grams, t) for t in TOLERANCES}
        shown = [describe_times(times[t]) for t in TOLERANCES]
        rows.append([product, words, *shown, *describe_bars(signals, reading)])
        if words.startswith("estimator") and best:
            ratios = [describe_ratio(times[t], best[t]) for t in TOLERANCES]
            rows.append([product, "its times over the filter's", *ratios, "", ""])
        print(*rows[-1], sep=" | ", flush=True)
    return rows


def tune(learnt: Signals, product: str, folder: Path) -> dict[float, str]:
    """The best filter for each tolerance (g), from a file where there is one."""
    path = folder / f"filters-{product}.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for tolerance in TOLERANCES:
        if f"{tolerance:g}" not in known:
            found = tune_filters([learnt.drops], RATE, 1e-3 * tolerance, [dem_cell(CELL)])
            known[f"{tolerance:g}"] = found[0].filter
            path.write_text(json.dumps(known), encoding="utf-8")
    return {tolerance: known[f"{tolerance:g}"] for tolerance in TOLERANCES}


# ---- signals that the product does not make ----


def later(values: np.ndarray, readings: int) -> np.ndarray:
    """Signals less their tare, that come later."""
    net = values - values[:, :100].mean(axis=1, keepdims=True)
    return np.pad(net, [(0, 0), (readings, 0)])[:, : values.shape[1]]


def add_portion(signals: Signals, readings: int) -> Signals:
    """The portion of each drop and that of the drop before, which comes later."""
    second = np.roll(later(signals.values, readings), 1, axis=0)
    weights = signals.weights + np.roll(signals.weights, 1)
    return replace(signals, values=signals.values + second, weights=weights)


def hold_back(signals: Signals, share: float, readings: int) -> Signals:
    """A share of each portion comes later."""
    values = (1 - share) * signals.values + share * later(signals.values, readings)
    return replace(signals, values=values)


def rows_of_checks(product: str, weigher: Weigher, judges: dict[str, Signals]) -> list[list[str]]:
    """Rows of the second table for a product."""
    judge = judges[product]
    cases = {
        "right portions": judge,
        "a second portion at once": add_portion(judge, 0),
        "a second portion after 0.1 s": add_portion(judge, 100),
        "a tenth stuck for 0.2 s": hold_back(judge, 0.1, 200),
        "a fifth stuck for 0.4 s": hold_back(judge, 0.2, 400),
    }
    cases |= {name: each.take(slice(OTHERS)) for name, each in judges.items() if name != product}
    rows = []
    for words, signals in cases.items():
        reading, alone = weigher.read(signals.values), stand_in(weigher).read(signals.values)
        times = [times_of(signals, each.grams, TOLERANCES[0]) for each in (reading, alone)]
        quantiles = [" / ".join(shown(find_quantile(each, q)) for q in SHARES) for each in times]
        holds, doubted = describe_bars(signals, reading)
        wrong, missed = count_wrong(signals, reading)
        rows.append([product, words, *quantiles, holds, doubted, wrong, missed])
        print(*rows[-1], sep=" | ", flush=True)
    return rows


def count_wrong(signals: Signals, reading: Reading) -> tuple[str, str]:
    """Share of the drops that are decided wrongly for 1 g, and of those whose last reading is
    believed and off by more than 1 g and by more than its 99 % interval.
    """
    off = np.abs(reading.grams - signals.weights[:, None])
    limit = np.maximum(TOLERANCES[0], check_decision(TOLERANCES[0], CONFIDENCE) * reading.sd)
    ends_wrong = (reading.believed & (off > limit))[:, -1]
    at = first_decision(reading, TOLERANCES[0], CONFIDENCE)
    is_wrong = (at >= 0) & (off[np.arange(len(at)), at] > TOLERANCES[0])
    return f"{100 * is_wrong.mean():.0f} %", f"{100 * ends_wrong.mean():.0f} %"


# ---- when a scale decides ----


def rows_of_decisions(
    product: str, weigher: Weigher, learnt: Signals, judge: Signals, texts: dict[float, str]
) -> list[list[str]]:
    """Rows: when a scale decides, and whether it is right. Filters and their rules are chosen on
    the drops learnt from: of those that are right in 99 % the soonest.
    """
    reading = weigher.read(judge.values)
    texts_tried = dict.fromkeys([*FILTERS, *texts.values()])
    filtered = {
        text: [(each, apply_filter(text, each)) for each in (learnt, judge)] for text in texts_tried
    }
    rows = []
    for tolerance in TOLERANCES[:2]:
        rules = try_rules(filtered, tolerance)
        best = choose_rule(rules)
        at = first_decision(reading, tolerance, CONFIDENCE)
        ours = describe_decisions(judge, at, reading.grams, tolerance)
        for kind, words, outcome in (
            ("filter", best, rules[best][1]),
            ("estimator", "its own error bar, 99 %", ours),
        ):
            mean, right = outcome
            late = f"{100 * np.mean(at < 0):.0f} %" if kind == "estimator" else ""
            rows.append(
                [
                    product,
                    f"{tolerance:g} g",
                    kind,
                    words,
                    f"{1e3 * mean:.0f}",
                    f"{100 * right:.1f} %",
                    late,
                ]
            )
            print(*rows[-1], sep=" | ", flush=True)
    return rows


def try_rules(
    filtered: dict[str, list[tuple[Signals, np.ndarray]]], tolerance: float
) -> dict[str, list[Outcome]]:
    """Outcomes on the drops that choose and on those that judge, of all filters, durations and
    bands.
    """
    rules = {}
    for (text, parts), hold, band in itertools.product(filtered.items(), HOLDS, BANDS):
        words = f"{text}, within {band * tolerance:g} g for {1e3 * hold / RATE:g} ms"
        rules[words] = [
            describe_decisions(
                each, find_still(each, values, hold, band * tolerance), values, tolerance
            )
            for each, values in parts
        ]
    return rules


def choose_rule(rules: dict[str, list[Outcome]]) -> str:
    """The soonest of those that are right often enough on the drops that choose; else the most
    often right.
    """
    enough = {words: outcomes for words, outcomes in rules.items() if outcomes[0][1] >= RIGHT}
    if enough:
        return min(enough, key=lambda words: enough[words][0][0])
    return max(rules, key=lambda words: rules[words][0][1])


def apply_filter(text: str, signals: Signals) -> np.ndarray:
    """[K, n] (g) readings through a filter, whose levels are in kg."""
    return 1e3 * filters.filter_signal(filters.parse_filter(text, RATE), signals.drops.signal)


def find_still(signals: Signals, values: np.ndarray, hold: int, band: float) -> np.ndarray:
    """[K] the first reading after the impact for which the last ``hold`` readings lie within a band
    (g); -1: none.
    """
    window = np.lib.stride_tricks.sliding_window_view(values, hold, axis=1)
    is_still = np.ptp(window, axis=-1) < band
    begins = (signals.impact * RATE).astype(int)[:, None] + 5
    is_still &= np.arange(is_still.shape[1]) >= begins
    return np.where(is_still.any(axis=1), is_still.argmax(axis=1) + hold - 1, -1)


def describe_decisions(
    signals: Signals, at: np.ndarray, grams: np.ndarray, tolerance: float
) -> Outcome:
    """Mean time (s) since the first impact of the drops that are decided, and the share of these
    that are right.
    """
    decided = at >= 0
    off = np.abs(grams[np.arange(len(at)), at] - signals.weights)
    if not decided.any():
        return np.inf, 0.0
    time = float(np.mean(signals.time[at] - signals.impact, where=decided))
    return time, float((off <= tolerance)[decided].mean())


# ---- the page ----


def plot(weigher: Weigher, judge: Signals, texts: dict[float, str], path: Path) -> None:
    """Errors over the time since the first impact: the median and nine tenths of the drops."""
    from matplotlib.figure import Figure

    curves = {"estimator": weigher.read(judge.values).grams}
    for tolerance in TOLERANCES[::2]:
        if tolerance in texts:
            curves[f"filter tuned for {tolerance:g} g"] = apply_filter(texts[tolerance], judge)
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(700)
    first = np.round((judge.impact - judge.time[0]) * RATE).astype(int)[:, None]
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
        axes.axhline(tolerance, color="0.5", lw=0.6)
    axes.set(xlabel="time since the first impact (ms)", ylabel="error of the reading (g)")
    axes.set(xlim=(0, 700), ylim=(0.03, 300))
    figure.legend(fontsize=8, loc="outside lower center", ncols=len(curves))
    figure.savefig(path, dpi=120)


NOTES = {
    "speed": """Times are quantiles over drops, half / 90 % / 99 %, in ms; in parentheses their 90 % intervals
(bootstrap over drops). The 95 % interval is judged by all readings from 50 ms after the first impact on
that are the estimator's. Rows below the first of an estimator say what is different from it.""",
    "checks": """Signals that the product does not make. Times within 1 g as above, of the estimator and of
the filter that stands in, alone. A portion that is partly stuck is decided before the rest has come where
the tolerance is reached until then: nothing in the signal tells. Ends wrong: at the end of the record the
reading is the estimator's, off by more than 1 g and outside of its 99 % interval.""",
    "decisions": """A filter's reading counts when it has stayed within a band for a while: filter, band and
duration are those of the least mean time since the first impact, of those that are right in 99 % of the
drops learnt from (if none is, the most often right). The estimator's counts when its own error bar is
within the tolerance with a confidence of 99 %; nothing is tuned. Shares are of the drops decided.""",
}
BARS = ["95 % interval holds", "doubted"]
HEADS = {
    "speed": ["product", "reading", *(f"within {t:g} g" for t in TOLERANCES), *BARS],
    "checks": [
        "estimator of", "signals", "estimator (ms)", "filter alone (ms)", *BARS, "decided wrong", "ends wrong",
    ],
    "decisions": ["product", "tolerance", "reading", "rule", "mean time (ms)", "right", "undecided"],
}  # fmt: skip
TITLES = {
    "speed": "How soon",
    "checks": "Another product, stuck pieces, a second portion",
    "decisions": "When a scale decides",
}


def measure_product(
    product: str, plans: dict[str, Plan], folder: Path, is_quick: bool
) -> dict[str, list[list[str]]]:
    """The rows of all tables for a product, from a file where there is one."""
    path = folder / f"rows-{product}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    learnt = load(simulate(product, plans[product], False, folder), 0)
    judges = {name: load(simulate(name, plan, True, folder), 1) for name, plan in plans.items()}
    jittered = load(simulate(product, plans[product], True, folder), 1, JITTER)
    texts = {} if is_quick else tune(learnt, product, folder)
    weigher = learn(learnt)
    rows = {
        "speed": rows_of_speed(product, learnt, judges[product], jittered, texts),
        "checks": rows_of_checks(product, weigher, judges),
        "decisions": rows_of_decisions(product, weigher, learnt, judges[product], texts),
    }
    path.write_text(json.dumps(rows), encoding="utf-8")
    return rows


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.weighing", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--quick", action="store_true", help="a few marshmallows, without tuned filters"
    )
    parser.add_argument(
        "--drops", type=Path, help="folder of simulated drops, filters and rows, which are kept"
    )
    parser.add_argument(
        "--product",
        choices=PRODUCTS,
        help="measure one product and keep its rows, without the page",
    )
    options = parser.parse_args(argv)
    plans = QUICK if options.quick else PRODUCTS
    folder = options.drops or Path("out/weighing-quick" if options.quick else "out/weighing")
    found = [
        measure_product(name, plans, folder, options.quick)
        for name in ([options.product] if options.product else plans)
    ]
    if options.product:
        return 0
    parts = [f"# Weighing\n\n{__doc__.strip()}", report.environment()]
    for name, head in HEADS.items():
        rows = [row for each in found for row in each[name]]
        parts += [f"## {TITLES[name]}", NOTES[name], report.table(head, rows)]
    product = next(iter(plans))
    learnt, judge = (
        load(simulate(product, plans[product], k, folder), int(k)) for k in (False, True)
    )
    texts = {} if options.quick else tune(learnt, product, folder)
    plot(learn(learnt), judge, texts, report.place("weighing.png", options.quick))
    report.write(
        "weighing", "\n\n".join([*parts, "![Errors over time](weighing.png)"]), options.quick
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
