"""Run time against error, for single impacts and for the weigh bucket: ``python -m
benchmarks.accuracy``.

Impacts of a sphere and of a tilted marshmallow on a plate, many phases and orientations at once,
against the exact solution or a fine run in double precision; drops into the weigh bucket, which are
chaotic, by their statistics over seeds. ``--quick``: fewer of each. Run times are processor time
without compiling; drops share out all cores.
"""

import argparse
import os
import statistics
import time
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from benchmarks import report
from dem_jax.xla_flags import set_loop_flags

SPEED, GRAVITY = 2.2147, 9.81  # m/s: a fall of 0.25 m; m/s2
SPHERE = {"shape": "sphere", "radius": 0.5 * (6 * 19440e-9 / np.pi) ** (1 / 3)}  # of the
# marshmallow's volume
PIECE = {"shape": "chamfered-cuboid"}
WINDOW = {"sphere": 6.5e-3, "chamfered-cuboid": 2.5e-3}  # s: to the separation, to the end of the
# first pulse
LONG = 6e-3  # s: to the end of the softest pulse, in which other corners strike too
FINE = 1600  # steps per loading quarter period of the reference
NUMBERS = (8, 12, 16, 25, 40, 63, 100, 160, 250, 400)
TABLE_NUMBERS = (32, 50, 80, 125, 200, 320)  # more, of the tables of walton_braun_accuracy
ROUNDS = 15  # in which the costs of a step are measured, one after the other, so that what else the
# machine does falls on all
DEFAULT = 100  # steps per loading quarter period of the default at restitution 0.1: ten in an
# unloading one
QUANTITIES = ("peak force", "restitution", "impulse")
SOFT_HEAD = (
    "softening",
    "peak, f32",
    "impulse, f32",
    "peak, f64",
    "impulse, f64",
    "steps over those at 1",
)
DROP_HEAD = (
    "drop",
    "s per drop",
    "peak PIF (g)",
    "settled (ms)",
    "peak (%)",
    "settled time (%)",
    "impulse (%)",
)


# --- single impacts ---


@dataclass(frozen=True)
class Impacts:
    """What was measured of impacts side by side, [K] each."""

    peak: np.ndarray  # N: as reported, of the top, also where that falls between two steps
    rebound: np.ndarray  # m/s: at separation (sphere), or of the corner that hit, at the end of the
    # window
    impulse: np.ndarray  # N s, vertical, over the window
    quarter: float  # s: quarter period of the loading branch, central impact on the plate
    once: np.ndarray | None = None  # whether the force has risen once and is gone by the end of the
    # window

    def of(self, chosen) -> "Impacts":
        """Some of the impacts; chosen: indices."""
        once = None if self.once is None else self.once[chosen]
        return Impacts(
            self.peak[chosen], self.rebound[chosen], self.impulse[chosen], self.quarter, once
        )

    def errors(self, exact: "Impacts"):
        """Relative errors [3, K] of peak force, rebound speed and impulse."""
        pairs = (
            (self.peak, exact.peak),
            (self.rebound, exact.rebound),
            (self.impulse, exact.impulse),
        )
        return np.array([np.abs(found - true) / np.abs(true) for found, true in pairs])


def starts(kind, count, apart=2e-3):
    """Positions, orientations and lowest corners of ``count`` pieces that touch the plate within
    0.1 to 0.2 ms.

    apart: (m) least height of the second corner above the lowest.
    """
    from scipy.spatial.transform import Rotation

    from dem_jax import shapes

    random = np.random.default_rng(1)
    gap = SPEED * random.uniform(1e-4, 2e-4, count)
    if kind is SPHERE:
        return [((0.0, 0.0, kind["radius"] + g), (1.0, 0.0, 0.0, 0.0), np.zeros(3)) for g in gap]
    corners, out = np.asarray(shapes.chamfered_cuboid().vertices), []
    while len(out) < count:
        turn = Rotation.random(random_state=random)
        low = np.sort(turn.apply(corners)[:, 2])
        if low[1] - low[0] > apart:  # a second corner that touches in the pulse makes another
            # problem of it
            corner = corners[np.argmin(turn.apply(corners)[:, 2])]
            w = turn.as_quat(scalar_first=True)
            out.append(((0.0, 0.0, float(gap[len(out)] - low[0])), tuple(map(float, w)), corner))
    return out


def plate(kind, start, number, precision, restitution=0.1, softening=0.01, **run):
    """The scene of an impact with so many steps per loading quarter period."""
    from dem_jax import validation

    position, orientation, _ = start
    piece = kind | {
        "position": position,
        "orientation": orientation,
        "velocity": (0.0, 0.0, -SPEED),
    }
    step = quarter_period(kind["shape"], softening) / number
    settings = {"time_step": step, "sample_interval": step, "allow_unstable_step": True} | run
    gravity = (0.0, 0.0, -GRAVITY)
    return validation.plate_scene(
        piece, gravity, precision, settings, restitution=restitution, numerical_softening=softening
    )


@cache
def quarter_period(shape, softening):
    """Loading quarter period (s) of a central impact on the plate."""
    return 0.5 * np.pi / spring(shape, softening).frequency


@cache
def stable_step(shape, restitution):
    """Linear stability limit (s) of an impact on the plate."""
    from dem_jax import assembly

    kind = SPHERE if shape == "sphere" else PIECE
    return assembly.assemble_system(
        plate(kind, starts(kind, 1)[0], 1, "f64", restitution, time_step="auto")
    ).step.linear_limit


@cache
def spring(shape, softening, restitution=0.1):
    """The exact solution of a central impact on the plate."""
    from dem_jax import assembly, validation

    kind = SPHERE if shape == "sphere" else PIECE
    system = assembly.assemble_system(
        validation.plate_scene(kind, numerical_softening=softening)
    ).system
    mass, stiffness = float(system.pieces.mass[0]), float(validation.wall_stiffness(system)[0])
    return validation.NormalImpact(mass, stiffness, restitution, SPEED, GRAVITY)


def impacts(
    kind, begin, number, precision, restitution=0.1, softening=0.01, window=None
) -> Impacts:
    """Impacts from all of ``begin``, each step sampled."""
    import jax

    from dem_jax import assembly
    from dem_jax.runner.interface import run_job
    from dem_jax.runner.job_setup import prepare_job

    window = window or WINDOW[kind["shape"]]
    quarter = quarter_period(kind["shape"], softening)
    length = round(window / (quarter / number)) * quarter / number
    kept = {"duration": length, "frame_interval": length}
    scene = plate(kind, begin[0], number, precision, restitution, softening, **kept)
    job = prepare_job(scene, (0,) * len(begin), len(begin))
    down, still = np.array([[0.0, 0.0, -SPEED]]), np.zeros((1, 3))
    with jax.enable_x64(precision == "f64"):
        placed = [
            assembly.InitialConditions(np.array([place]), np.array([turn]), down, still)
            for place, turn, _ in begin
        ]
        states = [assembly.replace_initial_motion(job.built, start) for start in placed]
        job = replace(job, state=jax.tree.map(lambda *x: jax.numpy.asarray(np.stack(x)), *states))
    found = run_job(job, None, False, False)
    force, mean = (-x["plate"][..., 2].astype(float) for x in (found.force, found.mean_force))
    last = {
        name: np.asarray(getattr(found.pieces, name)[:, -1, 0], float)
        for name in ("position", "velocity")
    }
    speed = last["velocity"][:, 2]
    if kind is SPHERE:
        apart = np.maximum(last["position"][:, 2] - kind["radius"], 0)
        rebound = np.sqrt(np.maximum(speed, 0) ** 2 + 2 * GRAVITY * apart)
    else:
        rebound = speed + _corner_speed(found.pieces, begin)
    peak = np.asarray(found.peak_force["plate"], float).max(1)
    return Impacts(peak, rebound, mean.sum(1) * quarter / number, quarter, _strikes_once(force))


def _strikes_once(force):
    """Whether forces [K, T] rise to a top and fall to nothing, up to 2 % of the top."""
    out = []
    for trace in force:
        little = 0.02 * trace.max()
        after = trace[np.argmax(np.maximum.accumulate(trace) - trace > little) :]
        out.append((after - np.minimum.accumulate(after)).max() <= little and trace[-1] <= little)
    return np.array(out)


def _corner_speed(pieces, begin):
    """Vertical speed [K] (m/s) of the corner that hit, about the centre of mass, at the last frame."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(np.asarray(pieces.orientation[:, -1, 0], float), scalar_first=True)
    arm = turn.apply([corner for _, _, corner in begin])
    return np.cross(np.asarray(pieces.angular_velocity[:, -1, 0], float), arm)[:, 2]


def exact(kind, begin, restitution=0.1, softening=0.01, window=None) -> Impacts:
    """The fine run in double precision; of the sphere peak and rebound in closed form."""
    fine = impacts(kind, begin, FINE, "f64", restitution, softening, window)
    if kind is not SPHERE:
        return fine
    case = spring("sphere", softening, restitution)
    touch = [np.sqrt(SPEED**2 + 2 * GRAVITY * (start[0][2] - kind["radius"])) for start in begin]
    cases = [replace(case, speed=speed) for speed in touch]
    return replace(
        fine,
        peak=np.array([c.peak_force for c in cases]),
        rebound=np.array([c.rebound_speed for c in cases]),
    )


def costs_of_a_step(kind, start, variants):
    """Seconds of processor time per step of one impact, alone, at the default sampling: name ->
    median.

    variants: name -> (precision, changes of ``run``). All take turns.
    """
    import jax

    from dem_jax.runner.executors import describe_chunk
    from dem_jax.runner.job_setup import prepare_job

    jobs, times = {}, {}
    for name, (precision, changes) in variants.items():
        scene = plate(
            kind, start, DEFAULT, precision, sample_interval=30e-6, duration=1.0, **changes
        )
        jobs[name], times[name] = prepare_job(scene, (0,), None), []
    for _ in range(1 + ROUNDS):  # the first compiles
        for name, job in jobs.items():
            begin = time.process_time()
            with jax.enable_x64(job.scene.run.precision == "f64"):
                job.executor(describe_chunk(job, job.system, job.state, 0, 200))
            times[name].append((time.process_time() - begin) / (200 * job.steps_per_sample))
    return {name: statistics.median(each[1:]) for name, each in times.items()}


@dataclass(frozen=True)
class Point:
    """A point of a work-precision diagram."""

    label: str  # what it is, for the table
    series: str  # points of one series are joined in the figure
    work: float  # s
    error: tuple  # relative, one per quantity
    worst: tuple = ()  # of an impact; of drops the standard errors
    default: bool = False
    number: int = 0  # steps per loading quarter period, of an impact


def impact_points(kind, count, numbers, cadences):
    """Points over the step and the precision, and over the cadence of rebuilds."""
    begin = starts(kind, count)
    true = exact(kind, begin)
    variants = {precision: (precision, {}) for precision in ("f32", "f64")}
    variants |= {cadence: ("f32", {"max_rebuild_interval": cadence}) for cadence in cadences}
    each = costs_of_a_step(kind, begin[0], variants)
    points = []
    for precision in ("f32", "f64"):
        for number in _stable(kind, numbers):
            found = impacts(kind, begin, number, precision)
            errors = found.errors(true)
            work = each[precision] * WINDOW[kind["shape"]] / found.quarter * number
            shown = tuple(np.sqrt(np.mean(errors**2, axis=1))), tuple(errors.max(axis=1))
            label = f"{number} steps, {precision}"
            points.append(
                Point(
                    label, precision, work, *shown, (number, precision) == (DEFAULT, "f32"), number
                )
            )
    at_default = next(p for p in points if p.default)
    for cadence in cadences:
        work = each[cadence] * WINDOW[kind["shape"]] / true.quarter * DEFAULT
        label = f"{DEFAULT} steps, f32, rebuilt every {cadence} steps"
        points.append(
            replace(
                at_default, label=label, series=f"rebuilt every {cadence}", work=work, default=False
            )
        )
    return points


def _stable(kind, numbers):
    """Those that are within the linear stability limit of the unloading branch, which an eccentric
    contact halves.
    """
    return [n for n in numbers if n >= (8 if kind is SPHERE else 20)]


def softening_rows(kind, count):
    """Rows of a table: what softening does to an impact, against the stiffest, at the default
    number of steps.
    """
    begin, rows = starts(kind, count), []
    stiff = impacts(kind, begin, FINE // 4, "f64", softening=1.0, window=LONG)
    for softening in (1.0, 0.1, 0.01, 0.001):
        row = [f"{softening:g}"]
        for precision in ("f32", "f64"):
            found = impacts(kind, begin, DEFAULT, precision, softening=softening, window=LONG)
            # The force goes with the root of the stiffness: what is left beside that.
            peak, _, impulse = replace(found, peak=found.peak / np.sqrt(softening)).errors(stiff)
            row += [_percent(np.sqrt(np.mean(error**2))) for error in (peak, impulse)]
        rows.append((*row, f"{np.sqrt(softening):.2g}"))
    return rows


def resolution(kind, count, numbers, restitutions):
    """Worst errors of one pulse: (steps per loading quarter period, restitution) -> (of peak force,
    of rebound speed).

    Over ``count`` phases of a sphere, or orientations of a piece that strikes with one corner alone
    until its force is gone. walton_braun_accuracy.ErrorBound are their bounds. numbers: steps, or
    (steps, precision); double precision unless said. Those beyond the linear stability limit are
    left out.
    """
    is_sphere, worst = kind is SPHERE, {}
    candidates = starts(kind, count) if is_sphere else starts(kind, 2 * count, apart=1.5e-3)
    quarter = quarter_period(kind["shape"], 0.01)
    for restitution in restitutions:
        window = None if is_sphere else 2e-4 + quarter * (1 + restitution)
        true, begin = exact(kind, candidates, restitution, window=window), candidates
        if not is_sphere:
            chosen = np.flatnonzero(true.once)[:count]
            true, begin = true.of(chosen), [candidates[k] for k in chosen]
        for each in numbers:
            number, precision = each if isinstance(each, tuple) else (each, "f64")
            if quarter / number < stable_step(kind["shape"], restitution):
                found = impacts(kind, begin, number, precision, restitution, window=window)
                worst[each, restitution] = tuple(found.errors(true).max(axis=1)[:2])
    return worst


def step_rows(worst, numbers, restitutions):
    """Rows of a table of worst errors: of rebound at each restitution, then the largest of peak
    force.
    """
    rows = []
    for n in numbers:
        at = [worst.get((n, e)) for e in restitutions]
        peaks = [both[0] for both in at if both]
        rebounds = ["beyond the linear limit" if both is None else _percent(both[1]) for both in at]
        name = n if isinstance(n, int) else ", ".join(map(str, n))
        rows.append((name, *rebounds, _percent(max(peaks)) if peaks else "beyond the linear limit"))
    return rows


def nearest_bound(kind, worst):
    """The largest ratios of the worst errors of rebound and of peak force to
    walton_braun_accuracy.ErrorBound, where that holds.
    """
    from dem_jax import assembly, validation
    from dem_jax.assembly.time_step import RESOLVED_SHARE
    from dem_jax.contact_laws import walton_braun_accuracy

    bound = walton_braun_accuracy.SPHERE if kind is SPHERE else walton_braun_accuracy.POLYTOPE
    made = assembly.assemble_system(validation.plate_scene(kind, restitution=0.1)).step
    # root of the least effective mass
    eccentric = made.linear_limit * spring(kind["shape"], 0.01).frequency / (2 * 0.1)
    ratios = []
    for (number, restitution), (peak, rebound) in worst.items():
        if isinstance(number, int) and eccentric * number >= bound.min_steps(restitution):
            step = quarter_period(kind["shape"], 0.01) / number
            corrected = step <= RESOLVED_SHARE * stable_step(kind["shape"], restitution)
            most = bound.error_bounds(eccentric * number, restitution, corrected)
            found = {"peak_force": peak, "restitution": rebound}
            ratios.append(
                [found[key] / max(most[key], finest) for key, finest in bound.finest["f64"].items()]
            )
    return np.max(ratios, axis=0)


def step_section(count, numbers, restitutions):
    """The section on errors against steps, from which ``run.accuracy`` takes its bounds."""
    heads = ("steps", *(f"restitution at ε = {e}" for e in restitutions), "peak force")
    text = ["## Error against steps per loading quarter period"]
    phases = f"Worst of {count} phases of a sphere, against the exact solution"
    tilts = f"Worst of {3 * count} orientations of a marshmallow that strikes with one corner, against {FINE} steps"
    for kind, most, what in ((SPHERE, count, phases), (PIECE, 3 * count, tilts)):
        every = (*numbers, (100, "f32"), (400, "f32"))
        worst = resolution(kind, most, every, restitutions)
        rebound, peak = nearest_bound(kind, worst)
        text.append(
            f"{what}; double precision unless said:\n\n{report.table(heads, step_rows(worst, every, restitutions))}"
        )
        text.append(
            "Of the bounds in `dem_jax/contact_laws/walton_braun_accuracy.py`, from which `run.accuracy` takes the step, "
            f"these errors reach at most "
            f"{100 * rebound:.0f} % (restitution) and {100 * peak:.0f} % (peak force)."
        )
    return "\n\n".join(text)


def tables_text(count, numbers, restitutions):
    """The errors of many orientations, from which the tables of walton_braun_accuracy are."""
    every = [*numbers, *TABLE_NUMBERS]
    worst = resolution(PIECE, count, sorted(set(every)), restitutions)
    rebound, peak = nearest_bound(PIECE, worst)
    heads = ("steps", *(f"restitution at ε = {e}" for e in restitutions), "peak force")
    return f"""# Error of many orientations

{report.environment()}

Worst of {count} orientations of a marshmallow that strikes with one corner, against {FINE} steps in double precision. The tables in
`dem_jax/contact_laws/walton_braun_accuracy.py` hold the largest error at so many or more steps of these and of other orientations;
the bounds of `run.accuracy` are 1.15 times that. Of them these errors reach at most {100 * rebound:.0f} % (restitution) and
{100 * peak:.0f} % (peak force).

{report.table(heads, step_rows(worst, sorted(set(every)), restitutions))}
"""


# --- the weigh bucket ---


@dataclass(frozen=True)
class Drops:
    """Statistics of drops into the weigh bucket, one value per seed."""

    peak: np.ndarray  # kg: largest PIF, mean over a sample
    impulse: np.ndarray  # N s, vertical, on the whole weigh bucket
    settled: np.ndarray  # s: from the first force to the last piece at rest
    work: float  # s of processor time per drop

    def against(self, other: "Drops"):
        """Differences of the means relative to the other's, and their standard errors, [3] each."""
        out = []
        for mine, theirs in (
            (self.peak, other.peak),
            (self.settled, other.settled),
            (self.impulse, other.impulse),
        ):
            mine, theirs = (x[np.isfinite(x)] for x in (mine, theirs))
            scale = theirs.mean()
            error = np.sqrt(mine.var(ddof=1) / len(mine) + theirs.var(ddof=1) / len(theirs)) / abs(
                scale
            )
            out.append(((mine.mean() - scale) / abs(scale), error))
        return np.array(out).T


def drops(scene, seeds) -> Drops:
    """Run a scene with all seeds, again if anything was compiled meanwhile: the time is that of
    running alone.
    """
    import jax

    from dem_jax.runner.executors import describe_chunk
    from dem_jax.runner.interface import run_job
    from dem_jax.runner.job_setup import prepare_job
    from dem_jax.visualization.summary import impact_duration

    job = prepare_job(scene, tuple(range(seeds)), seeds)
    with jax.enable_x64(scene.run.precision == "f64"):
        job.executor(describe_chunk(job, job.system, job.state, 0, 0))  # no samples: it compiles
    while True:
        compiled, start = job.clock.compile, time.process_time()
        found = run_job(job, None, False, False)
        took = time.process_time() - start
        if job.clock.compile == compiled:
            break
    members = [found.member(k) for k in range(seeds)]
    vertical = sum(
        -found.mean_force[group][..., 2].astype(float) for group in ("wb_flaps", "wb_walls")
    )
    return Drops(
        peak=np.array([m.pif_kg("wb_flaps").max() for m in members]),
        impulse=vertical.sum(axis=1) * found.sample,
        settled=np.array([impact_duration(m, "wb_flaps", "wb") for m in members]),
        work=took / seeds,
    )


def variants(quick):
    """Label, series and changes of the quick-release drop; the first is the reference (a quick one:
    the default).
    """
    from dem_jax import assembly, load_scene

    step = assembly.assemble_system(load_scene("quick-release")).step.critical
    sphere = {"portion": {"shape": "sphere", "radius": SPHERE["radius"]}}
    half = {"run": {"time_step": step / 2}}
    rows = [
        ("default", "step, f32", {}),
        ("twice the step", "step, f32", {"run": {"time_step": 2 * step}}),
        ("sphere of equal volume", "shape", sphere),
    ]
    if quick:
        return [("default (reference)", "reference", {}), *rows[1:]]
    return [
        (
            "half the step, f64 (reference)",
            "reference",
            {"run": half["run"] | {"precision": "f64"}},
        ),
        *rows,
        ("four times the step", "step, f32", {"run": {"time_step": 4 * step}}),
        ("half the step", "step, f32", half),
        ("f64", "f64", {"run": {"precision": "f64"}}),
        ("rebuilt every 10 steps", "rebuilds", {"run": {"max_rebuild_interval": 10}}),
        ("rebuilt every 150 steps", "rebuilds", {"run": {"max_rebuild_interval": 150}}),
        ("softening 0.03", "softening", {"material": {"numerical_softening": 0.03}}),
        ("softening 0.001", "softening", {"material": {"numerical_softening": 0.001}}),
    ]


def drop_points(seeds, quick):
    """Points of the drop, rows of its table, and the reference."""
    from dem_jax import SceneError, SimulationError, load_scene

    base = load_scene("quick-release").replace(
        portion={"settling_time": 0.3},
        run={"duration": 0.45, "frame_interval": 0.0, "track_energy": False},
    )
    points, rows, reference = [], [], None
    for label, series, changes in variants(quick):
        try:
            found = drops(base.replace(**changes), seeds)
        except (SceneError, SimulationError) as error:
            rows.append((label, f"stopped: {error}", *[""] * 6))
            continue
        reference = reference or found
        off, sure = found.against(reference)
        if found is not reference:
            points.append(
                Point(
                    label,
                    series,
                    found.work,
                    tuple(np.abs(off)),
                    tuple(sure),
                    default=label == "default",
                )
            )
        values = (
            report.spread(found.peak * 1e3),
            report.spread(found.settled[np.isfinite(found.settled)] * 1e3),
        )
        cells = [f"{100 * o:+.1f} ± {100 * s:.1f}" for o, s in zip(off, sure, strict=True)]
        rows.append(
            (label, f"{found.work:.3g}", *values, *(cells if found is not reference else [""] * 3))
        )
        print(rows[-1], flush=True)
    return points, rows


# --- tables and figure ---


def pareto(points):
    """Of (work, error) pairs those that no other beats in both, by rising work."""
    best, front = np.inf, []
    for work, error in sorted(points):
        if error < best:
            best = error
            front.append((work, error))
    return front


def _percent(value):
    return f"{100 * value:.2g} %" if value < 10 else "over 1000 %"


def impact_table(points):
    rows = []
    for p in points:
        name = f"**{p.label} (default)**" if p.default else p.label
        rows.append(
            (
                name,
                f"{1e3 * p.work:.3g}",
                *(f"{_percent(e)} ({_percent(w)})" for e, w in zip(p.error, p.worst, strict=True)),
            )
        )
    return report.table(("steps per loading quarter period", "run time (ms)", *QUANTITIES), rows)


def figure(sphere, piece, drop, path):
    """Errors over run times, the Pareto front and the default marked."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    fig, panels = plt.subplots(2, 3, figsize=(13, 7.5), layout="constrained")
    columns = (
        ("sphere on a plate", sphere, ("peak force", "restitution")),
        ("tilted marshmallow on a plate", piece, ("peak force", "restitution")),
        ("weigh bucket, mean over seeds", drop, ("peak PIF", "settled time")),
    )
    for column, (title, points, names) in enumerate(columns):
        for row, name in enumerate(names):
            axes = panels[row, column]
            for series in dict.fromkeys(p.series for p in points):
                here = sorted((p.work, p.error[row]) for p in points if p.series == series)
                axes.plot(
                    *zip(*here, strict=True),
                    "o-" if len(here) > 2 else "o",
                    ms=4,
                    lw=1,
                    label=series,
                )
            least = 0.0 if column < 2 else 1.0  # of drops the standard error counts: less is not
            # resolved
            known = [(p.work, max(p.error[row], least * p.worst[row])) for p in points]
            axes.plot(*zip(*pareto(known), strict=True), "k:", lw=1.5, label="Pareto front")
            default = [(p.work, p.error[row]) for p in points if p.default]
            if default:
                axes.plot(
                    *zip(*default, strict=True), "*", ms=15, mfc="none", mec="k", label="default"
                )
            if column == 2:
                axes.axhline(
                    statistics.median(p.worst[row] for p in points),
                    color="grey",
                    lw=0.8,
                    label="standard error",
                )
            axes.set(xscale="log", yscale="log", xlabel="run time (s)", ylabel=f"error in {name}")
            for axis in (axes.xaxis, axes.yaxis):  # few labels, but at least two on an axis shorter
                # than two decades
                low, high = axis.get_view_interval()
                axis.set_major_locator(
                    LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0))
                )
                # each tick has its label
                axis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(99, 99)))
                axis.set_minor_formatter(NullFormatter())
            axes.set_title(title if row == 0 else "")
            axes.grid(True, which="major", alpha=0.3)
        panels[0, column].legend(fontsize=7)
    fig.savefig(path, dpi=130)


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.accuracy", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="fewer steps, phases and seeds")
    parser.add_argument(
        "--orientations", type=int, help="only the errors of so many orientations of a marshmallow"
    )
    parser.add_argument("--seeds", type=int, help="of the drop; unset: 64, quick 4")
    options = parser.parse_args(argv)
    set_loop_flags()  # as in production, before anything is compiled
    if options.orientations:
        text = tables_text(options.orientations, NUMBERS, (0.1, 0.3, 0.5, 0.7))
        report.write("accuracy-orientations", text, options.quick)
        return
    begin, environment = time.perf_counter(), report.environment()
    count, seeds = (6, 4) if options.quick else (16, 64)
    seeds = options.seeds or seeds
    numbers = (25, 50, 100, 200) if options.quick else NUMBERS
    restitutions = (0.1, 0.5) if options.quick else (0.1, 0.3, 0.5, 0.7)
    cadences = () if options.quick else (10, 200)
    sphere, piece = (impact_points(kind, count, numbers, cadences) for kind in (SPHERE, PIECE))
    steps = step_section(count, numbers, restitutions)
    softened = [] if options.quick else softening_rows(PIECE, count)
    drop, dropped = drop_points(seeds, options.quick)
    figure(sphere, piece, drop, report.place("accuracy.png", options.quick))
    soft_text = f"""## Softening, the tilted marshmallow

Peak force, over the root of the softening, and impulse in the first {1e3 * LONG:g} ms, in which other corners strike too, against
softening 1 with {FINE // 4} steps; root mean square:

{report.table(SOFT_HEAD, softened)}
"""
    after = WINDOW["chamfered-cuboid"] * 1e3
    text = f"""# Run time against error

{environment}; load at the end {os.getloadavg()[0]:.2f}; {time.perf_counter() - begin:.0f} s in all

Run times are processor time without compiling. Errors of single impacts ({count} phases or orientations at
{SPEED} m/s, ε = 0.1, softening 0.01, gravity, friction 0.3): root mean square (worst), relative.

![Errors over run times](accuracy.png)

## A sphere on a plate

Peak force and restitution against the exact solution, impulse against {FINE} steps in double precision.

{impact_table(sphere)}

## A tilted marshmallow on a plate

Against {FINE} steps in double precision; restitution is the speed of the corner that hit, {after} ms after the start.

{impact_table(piece)}

{steps}

{"" if options.quick else soft_text}
## The weigh bucket

Nine marshmallows, {seeds} seeds, 0.3 s of settling and 0.45 s of run each, computed together; median (lowest to highest)
over the seeds, and differences of the means from the reference, with standard errors. The drop is chaotic: what is below
the standard error is not resolved by so many seeds. What clumps of spheres cost another program is in `peers.md`.

{report.table(DROP_HEAD, dropped)}
"""
    report.write("accuracy", text, options.quick)


if __name__ == "__main__":
    main()
