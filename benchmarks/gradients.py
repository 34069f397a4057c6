"""Cost of the derivatives of a run: ``python -m benchmarks.gradients`` (``--quick``: a sphere and a
box).

Each row in a process of its own, on all cores, with nothing kept from before: the smooth peak of a
piece that lands on a plate at 2 m/s, and of a box in the feed bucket whose flaps open, by three
numbers of the scene. Forward mode is the measure of the error: what the two modes differ by, the
largest of the three, in double precision, in which all is computed.
"""

import argparse
import json
import os
import statistics
import sys
import time
from functools import partial

import jax
import numpy as np

import dem_jax
from benchmarks import report
from benchmarks.apart import outcomes
from dem_jax import assembly, xla_flags

PATIENCE = 900.0  # s for a row
ROUNDS = 9
WIDTH = 0.3  # N, of the smooth peak
NUMBERS = {"material.youngs_modulus": 1e8, "material.density": 300.0, "material.restitution": 0.3}
LANDING = {
    "position": (0.0, 0.0, 0.016),
    "velocity": (0.0, 0.0, -2.0),
    "orientation": (0.98, 0.1, 0.17, 0.0),
}
FRUSTUM = [
    [x * w * 0.012, y * w * 0.012, z * 0.02]
    for z, w in ((0.0, 1.0), (1.0, 0.6))
    for x in (-1, 1)
    for y in (-0.7, 0.7)
]
PIECES = {
    "sphere on a plate": {"shape": "sphere", "radius": 0.015},
    "marshmallow on a plate": {"shape": "chamfered-cuboid"},
    "frustum of a pyramid on a plate": {"shape": "hull", "points": tuple(map(tuple, FRUSTUM))},
}
IN_THE_BUCKET = "marshmallow in the weigh bucket"
QUICK = tuple(PIECES)[:2]
MODES = ("forward", "reverse", "reverse, checkpoint")


def scene(name):
    """The scene of a row."""
    run = {"precision": "f64", "track_energy": False}
    if name == IN_THE_BUCKET:
        return dem_jax.load_scene("weigh-bucket").replace(
            portion={"count": 1, "settling_time": 0.1}, run=run | {"duration": 0.05}
        )
    return dem_jax.load_scene("plate-drop").replace(
        piece=[PIECES[name] | LANDING], run=run | {"duration": 0.003}
    )


def peak(parameters, of, checkpoint):
    """Smooth peak (N) of the force on all walls."""
    run = dem_jax.rollout(of, parameters, checkpoint=checkpoint)
    return dem_jax.smooth_peak(-sum(force[:, 2] for force in run.force.values()), WIDTH)


def measure(case: tuple[str, str]) -> tuple[str, str]:
    """Name of a scene and a mode -> what was measured, as JSON."""
    jax.config.update("jax_enable_x64", True)
    xla_flags.set_loop_flags()
    name, mode = case
    of = scene(name)
    function = partial(peak, of=of, checkpoint=mode == "reverse, checkpoint")
    derivative = jax.jacfwd(function) if mode == "forward" else jax.grad(function)
    marks = [time.perf_counter()]
    traced = xla_flags.jit_for_backend(derivative, jax.default_backend()).lower(NUMBERS)
    marks.append(time.perf_counter())
    program = traced.compile()
    marks.append(time.perf_counter())
    found, times = None, []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        found = jax.block_until_ready(program(NUMBERS))
        times.append(time.perf_counter() - start)
    made = assembly.assemble_system(of)
    steps = made.settling_steps + made.samples * made.step.substeps
    memory = program.memory_analysis().temp_size_in_bytes
    trace, compiled = np.diff(marks).tolist()
    values = [float(found[key]) for key in NUMBERS]
    return "ok", json.dumps(
        {
            "trace": trace,
            "compile": compiled,
            "run": times,
            "steps": steps,
            "memory": memory,
            "values": values,
        }
    )


def row(name, mode, got, forward):
    """Cells of the table; forward: the derivatives by forward mode."""
    error = np.abs(np.array(got["values"]) / np.array(forward) - 1).max()
    return [
        name,
        mode,
        got["steps"],
        f"{got['trace']:.1f}",
        f"{got['compile']:.1f}",
        f"{got['trace'] + got['compile']:.1f}",
        report.spread(got["run"], 1e3),
        f"{1e6 * statistics.median(got['run']) / got['steps']:.1f}",
        f"{got['memory'] / 1e6:.2g}",
        "" if mode == "forward" else f"{error:.1e}",
    ]


HEAD = (
    "scene",
    "mode",
    "steps",
    "trace s",
    "compile s",
    "together s",
    "run ms",
    "run us/step",
    "memory MB",
    "off forward mode by",
)


def table(names) -> str:
    """The Markdown table."""
    begin, rows, said = report.environment(), [], []
    for name in names:
        forward = None
        for mode in MODES:
            [(_, kind, words, _)] = outcomes(measure, [(name, mode)], PATIENCE)
            print(f"{name}, {mode}: {kind}", file=sys.stderr, flush=True)
            if kind != "ok":
                said.append(f"{name}, {mode}: {kind}, {words}")
                continue
            got = json.loads(words)
            forward = got["values"] if mode == "forward" else forward
            rows.append(row(name, mode, got, forward or [np.nan] * len(NUMBERS)))
    notes = "".join(f"\n- {line}" for line in said)
    return f"# Cost of derivatives\n\n{begin}\n\n{__doc__.split(chr(10), 2)[2].strip()}\n\n{report.table(HEAD, rows)}\n{notes}"


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gradients", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args(argv)
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    report.write(
        "gradients", table(QUICK if options.quick else (*PIECES, IN_THE_BUCKET)), options.quick
    )


if __name__ == "__main__":
    main()
