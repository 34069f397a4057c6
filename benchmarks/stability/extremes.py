"""Numbers that a scene may hold but that nobody means: ``python -m benchmarks.stability.extremes``
(``--every 7``: fewer).

Every number of a few scenes, in turn, is made far too small or large, also those that are unset.
What is allowed is a run whose series are all finite, or one line that says what is wrong; never a
traceback, a hang, or numbers that are not finite in a file. A run that is to take very long is set
up, and shortened where it can be. Exits with 1 if anything else happens.
"""

import argparse
import collections
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel

from benchmarks import apart

FLOATS = (1e-300, 1e-30, 1e-6, 1e6, 1e30, 1e300)
WHOLE = (1, 10**6, 2**31, 10**30, 10**400)
STEPS = 50_000  # beyond, a run is shortened
LONG = 10_000_000  # steps of a piece: beyond, it is only set up
PATIENCE = 120.0  # s for a scene; compiling takes some
USUAL = 0.02  # of the other components of a vector that is unset
GOOD = ("finite", "one line", "long")

SHORT = {"run.duration": 0.02}
PORTION = SHORT | {"portion.count": 3, "portion.settling_time": 0.06}
BOX = [
    {"shape": "cuboid", "size": [0.03, 0.012, 0.012], "position": [x, 0.0, 0.3 * x]}
    for x in (-0.008, 0.008)
]
PRODUCTS = [
    {"shape": "sphere", "radius": 0.008, "size_spread": 0.1, "material": "gummy"},
    {"shape": "compound", "part": BOX},
    {"shape": "prism", "sides": 5, "radius": 0.01, "height": 0.02, "share": 2.0},
]
SPHERES = [
    {"shape": "sphere", "radius": 0.01, "position": [0, 0, z], "velocity": [0.1, 0, -1]}
    for z in (0.011, 0.032)
]
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "plate-drop": (
        "plate-drop",
        SHORT | {"piece.0.position": [0.0, 0.0, 0.009], "run.accuracy": {"restitution": 0.05}},
    ),
    "quick-release": ("quick-release", PORTION),
    "weighing-station": ("weighing-station", PORTION | {"feeder.count": 2, "feeder.start": 0.0}),
    "products": (
        "weigh-bucket",
        PORTION
        | {
            "portion.shape": "chamfered-cuboid",
            "portion.product": PRODUCTS,
            "material.gummy": {"density": 1200.0, "restitution": 0.4, "pull_off": 1e-3},
            "pair": [{"of": ["gummy", "wall"], "friction": 0.5}],
            "motion": [
                {
                    "group": "wb_walls",
                    "stroke": [0.0, 0.0, 1e-4],
                    "times": [0.0, 1.0],
                    "angles_deg": [0.0, 1.0],
                }
            ],
        },
    ),
    "hertz-mindlin": (
        "plate-drop",
        SHORT | {"piece": SPHERES, "contact.law": "hertz-mindlin", "material.pull_off": 1e-3},
    ),
}


class Case(NamedTuple):
    """A scene with one number changed."""

    scene: str
    key: str
    value: Any

    def __str__(self) -> str:
        text = str(self.value)
        return f"{self.scene}: {self.key} = {text if len(text) < 40 else f'{text[:8]}...'}"


def cases() -> list[Case]:
    """All of them."""
    from dem_jax import load_scene

    found = []
    for name, (base, changes) in SCENES.items():
        scene = load_scene(base, changes)
        found += [Case(name, key, value) for key, value in _values(scene, "")]
    return found


def _values(section: BaseModel, path: str) -> Iterator[tuple[str, Any]]:
    """(key, value) of all numbers of a section and of those below it."""
    for name, field in type(section).model_fields.items():
        now, key = getattr(section, name), f"{path}{name}"
        if isinstance(now, BaseModel):
            yield from _values(now, f"{key}.")
        elif isinstance(now, tuple) and now and isinstance(now[0], BaseModel):
            for n, row in enumerate(now):
                yield from _values(row, f"{key}.{n}.")
        else:
            for value in _extremes(field.annotation, now):
                yield key, value
    for name, below in (section.model_extra or {}).items():
        yield from _values(below, f"{path}{name}.")


def _extremes(annotation: Any, now: Any) -> list[Any]:
    """What to set a key to; now: what it is."""
    annotation = _bare(annotation)
    origin, args = get_origin(annotation), [_bare(arg) for arg in get_args(annotation)]
    if origin in (Union, UnionType):
        return next((found for arg in args if (found := _extremes(arg, now))), [])
    if origin is tuple and get_origin(args[0]) is tuple:  # points
        rows = [list(row) for row in now or ()]
        return [
            [[x, *rows[0][1:]], *rows[1:]]
            for sign in (1, -1)
            for x in np.multiply(sign, FLOATS).tolist()
            if rows
        ]
    if origin is tuple:
        rest = list(now or ()) if Ellipsis in args else list(now or [USUAL] * len(args))
        return [[x, *rest[1:]] for x in _extremes(args[0], None) if rest]
    return list({float: FLOATS, int: WHOLE}.get(annotation, ()))


def _bare(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def outcome(case: Case) -> tuple[str, str]:
    """What came of it, and in which words."""
    from dem_jax import load_scene
    from dem_jax.errors import RecordError, SceneError, SimulationError
    from dem_jax.io.run_files import collect_series
    from dem_jax.runner.interface import run_job
    from dem_jax.runner.job_setup import prepare_job

    base, changes = SCENES[case.scene]
    try:
        scene = load_scene(base, changes).replace({case.key: case.value})
        job = prepare_job(scene, (0,), None)
        if _steps(job) > STEPS:
            less = {"run.duration": 100 * scene.run.sample_interval}
            less |= (
                {"portion.settling_time": 100 * scene.run.sample_interval} if scene.portion else {}
            )
            job = prepare_job(scene.replace(less), (0,), None)
        pieces = job.system.pieces.mass.shape[0]
        if _steps(job) * pieces > LONG:
            return "long", f"{_steps(job):.3g} steps of {pieces} pieces"
        bad = [
            name
            for name, array in collect_series(run_job(job)).items()
            if not np.isfinite(array).all()
        ]
        return ("not finite", ", ".join(bad)) if bad else ("finite", "")
    except (SceneError, SimulationError, RecordError) as error:
        lines = str(error).splitlines()
        return ("one line", lines[0]) if len(lines) == 1 else ("many lines", str(error))
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        where = [
            f"{Path(frame.filename).name}:{frame.lineno}"
            for frame in frames
            if "dem_jax" in frame.filename
        ]
        return "traceback", f"{type(error).__name__} at {' '.join(where[-2:])}: {str(error)[:300]}"


def _steps(job: Any) -> int:
    return (
        job.built.settling_steps + job.samples * int(job.system.substeps) * job.system.sample_parts
    )


def main(argv: list[str] | None = None) -> int:
    """Print what is not as allowed, and how often what came out."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.stability.extremes", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--every", type=int, default=1, metavar="n", help="only each n-th of the cases"
    )
    parser.add_argument(
        "--scenes", nargs="+", default=list(SCENES), choices=SCENES, help="only these"
    )
    parser.add_argument("--all", action="store_true", help="print each case")
    options = parser.parse_args(argv)
    chosen = [case for case in cases() if case.scene in options.scenes][:: options.every]
    print(f"{len(chosen)} cases", flush=True)
    count: collections.Counter[str] = collections.Counter()
    for case, kind, words, seconds in apart.outcomes(outcome, chosen, PATIENCE):
        count[kind] += 1
        if kind not in GOOD or options.all:
            print(f"{case}: {kind} after {seconds:.1f} s: {words}", flush=True)
    print("; ".join(f"{kind}: {n}" for kind, n in count.most_common()))
    return int(bool(count.keys() - set(GOOD)))


if __name__ == "__main__":
    raise SystemExit(main())
