"""The table of transfer of the Product Model: `python -m benchmarks.transfer design|learn|check
FOLDER`.

design: simulates ensembles of drops that fill the space of products and scenes (Sobol sequences,
one for each number and shape of pieces) and writes their traces to FOLDER; what is there is kept.
learn: fits the table to them and writes FOLDER/transfer.json (`product_model/transfer.json` is such
a file). check: simulates products that were not learnt from and compares the predicted model with
them; writes out/benchmarks/transfer.md, and the errors into the table.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from scipy.stats import qmc

import dem_jax
import product_model
from benchmarks import report
from calibrate import target
from calibrate.curves import Curves, collect_curves, measure_curves
from calibrate.errors import BadInput
from calibrate.landing_fit import judge_landings
from calibrate.transfer_fit import Ensemble, choose_frame, learn_transfer
from dem_jax.errors import SceneError, SimulationError
from dem_jax.scene import load_scene
from product_model.conditions import product_conditions, scene_conditions
from product_model.fitted import FITTED
from product_model.transfer import predict_parameters, read_table, write_table

SAMPLE = 30e-6  # s
RADIUS = 16.7e-3  # m, of a sphere of the volume of a marshmallow
FAMILIES = {  # (shape, pieces) -> points, least and greatest scale factor: a portion fills the feed
    # bucket and fits into it
    ("chamfered-cuboid", 4): (16, 0.85, 1.5),
    ("chamfered-cuboid", 6): (12, 0.7, 1.4),
    ("chamfered-cuboid", 9): (16, 0.6, 1.25),
    ("chamfered-cuboid", 14): (16, 0.5, 1.05),
    ("chamfered-cuboid", 22): (8, 0.42, 0.9),
    ("chamfered-cuboid", 40): (8, 0.33, 0.72),
    ("sphere", 6): (6, 0.7, 1.4),
    ("sphere", 14): (6, 0.5, 1.05),
    ("sphere", 40): (6, 0.33, 0.72),
}
RANGES = {  # key -> least, greatest, whether by the logarithm
    "material.density": (250.0, 1300.0, True),
    "material.youngs_modulus": (1.5e7, 6e8, True),  # softened to a hundredth
    "material.restitution": (0.08, 0.63, False),
    "drop.height": (0.22, 0.45, True),
    "feed_bucket.opening_time": (0.08, 0.30, True),
    "material.friction_wall": (0.15, 0.55, False),
    "material.friction_piece": (0.3, 0.9, False),
}
PRODUCTS = ("cherry-tomato", "cheese-cube", "chocolate-ball", "nugget", "toffee", "gummy-bear")
TARGET, DROPS, PORTIONS = 0.05, 64, 256  # kg; of a product that is checked
OUTPUTS = ("peak_1ms", "peak_10ms", "landing_time", "cell_peak")  # of calibrate.curves
HEAD = ("product", "pieces", "outside the design", "joint energy distance", *OUTPUTS)
SEEDS = {"chamfered-cuboid": 1, "sphere": 3}  # of the Sobol sequences


def design_points(shape, pieces):
    """Settings of the scene at each point of a family."""
    count, *scales = FAMILIES[shape, pieces]
    ranges = [(*scales, True), *RANGES.values()]
    rows = qmc.Sobol(len(ranges), seed=SEEDS[shape]).random(count)
    for row in rows:
        values = [
            low * (high / low) ** x if by_log else low + x * (high - low)
            for x, (low, high, by_log) in zip(row, ranges, strict=True)
        ]
        size = (
            {"portion.scale_factor": values[0]}
            if shape != "sphere"
            else {"portion.radius": RADIUS * values[0]}
        )
        yield {
            "portion.shape": shape,
            "portion.count": pieces,
            **size,
            **dict(zip(RANGES, values[1:], strict=True)),
        }


def scene_of(settings):
    """The scene of a point, which ends when the portion has landed."""
    scene = load_scene("weigh-bucket", settings)
    fall = np.sqrt(2 * scene.drop.height / 9.81)
    opening, rebounds = 0.4 * scene.feed_bucket.opening_time, 0.25 * scene.material.restitution
    fixed = {
        "run.frame_interval": 0.0,
        "run.sample_interval": SAMPLE,
        "run.track_energy": False,
        "run.on_escape": "warn",
    }
    return scene.replace({"run.duration": round(opening + fall + 0.11 + rebounds, 3), **fixed})


def simulate(scene, runs, seed):
    """Times [T] (s) and forces [runs, T] (N) of drops."""
    run = dem_jax.ensemble(scene, runs, seed)
    return np.asarray(run.time), -np.asarray(run.mean_force["wb_flaps"][..., 2], np.float32)


def write_design(folder, runs):
    """Simulate the points that `folder` lacks."""
    folder.mkdir(parents=True, exist_ok=True)
    for shape, pieces in FAMILIES:
        for number, settings in enumerate(design_points(shape, pieces)):
            path = folder / f"{shape}-{pieces}-{number}.npz"
            if path.exists():
                continue
            try:
                time, force = simulate(scene_of(settings), runs, 1000 * SEEDS[shape] + 100 * number)
            except (SceneError, SimulationError) as error:
                print(f"{path.stem}: left out: {error}", flush=True)
                continue
            np.savez(path, time=time, force=force, settings=json.dumps(settings))
            print(path.stem, flush=True)


def targets_of(drop, time, force, name):
    """`Target` of each trace that has any force."""
    return [
        target(time, row, drop.m_piece, drop.pieces, name=f"{name}:{k}")
        for k, row in enumerate(force)
        if row.max() > 0
    ]


def read_design(folder):
    """The ensembles of a folder."""
    found = []
    for path in sorted(folder.glob("*-*-*.npz")):
        with np.load(path) as data:
            drop, _ = scene_conditions(scene_of(json.loads(str(data["settings"]))))
            found.append(
                Ensemble(
                    path.stem,
                    drop,
                    targets_of(drop, data["time"], data["force"].astype(float), path.stem),
                )
            )
    if not found:
        raise BadInput(
            f"{folder}: no ensembles; make them by: python -m benchmarks.transfer design {folder}"
        )
    return found


def simulate_model(fitted, drop, time):
    """`Curves` of portions of a predicted model at the times of traces."""
    sample = float(time[1] - time[0])
    values = {name: fitted.value[name] for name in FITTED}
    given = {
        "m_piece": drop.m_piece,
        "pieces": drop.pieces,
        "gravity": drop.gravity,
        "landings": fitted.landings,
    }
    span = {"sample": sample, "start": float(time[0]) - sample, "duration": sample * len(time)}
    made = product_model.ensemble(product_model.parameters(**values, **given, **span), 5, PORTIONS)
    mass = np.full(PORTIONS, drop.m_piece * drop.pieces)
    return Curves(np.asarray(made.time), np.asarray(made.force, np.float64), mass, drop.gravity)


def check_product(name, table):
    """Row of a product, and the relative error of the median of each output."""
    drop, _ = product_conditions(name, TARGET)
    settings = {"product": name, "portion.target_weight": TARGET}
    time, force = simulate(scene_of(settings), DROPS, 7_000_000)
    targets = targets_of(drop, time, force, name)
    fitted = predict_parameters(drop, table)
    frame = choose_frame(targets)
    with jax.enable_x64(True):
        distance = judge_landings(fitted.value, targets, frame, 0, PORTIONS).joint.distance
    data, model = (
        measure_curves(collect_curves(targets)),
        measure_curves(simulate_model(fitted, drop, time)),
    )
    errors = {
        key: float(np.median(model[key].values) / np.median(data[key].values) - 1)
        for key in OUTPUTS
    }
    outside = "; ".join(line.split(" = ")[0] for line in table.outside(drop))
    return [
        name,
        drop.pieces,
        outside,
        f"{distance:.3g}",
        *(f"{100 * errors[key]:+.0f} %" for key in OUTPUTS),
    ], errors


def check_products(folder):
    """Compare the table of a folder with products that were not learnt from."""
    table = read_table(folder / "transfer.json")
    rows, errors = [], []
    for name in PRODUCTS:
        row, found = check_product(name, table)
        print(*row, flush=True)
        rows.append(row)
        if not row[2]:  # inside of the design
            errors.append([abs(found[key]) for key in OUTPUTS])
    quantiles = {
        key: np.quantile([row[k] for row in errors], (0.5, 0.9)) for k, key in enumerate(OUTPUTS)
    }
    found = {
        key: {"median": float(q[0]), "nine_tenths": float(q[1])} for key, q in quantiles.items()
    }
    write_table(folder / "transfer.json", replace(table, errors=found))
    words = [
        f"{DROPS} drops of {1e3 * TARGET:g} g of each beside {PORTIONS} predicted portions; errors are those of medians.",
        "Median (nine tenths) of the errors of products inside of the design: "
        + ", ".join(f"{key} {100 * q[0]:.0f} % ({100 * q[1]:.0f} %)" for key, q in quantiles.items()) + ".",
    ]  # fmt: skip
    lines = [
        "# The Product Model of products that were not learnt from",
        "",
        report.environment(),
        "",
        *words,
        "",
    ]
    report.write("transfer", "\n".join([*lines, report.table(HEAD, rows)]), quick=True)


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.transfer", description=__doc__.splitlines()[0]
    )
    parser.add_argument("what", choices=("design", "learn", "check"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--runs", type=int, default=32, help="drops at each point (default 32)")
    options = parser.parse_args(argv)
    if options.what == "design":
        write_design(options.folder, options.runs)
    elif options.what == "learn":
        say = lambda what, epoch, value: print(
            f"{what}: epoch {epoch}, mean loss {value:.4f}", flush=True
        )
        write_table(
            options.folder / "transfer.json",
            learn_transfer(read_design(options.folder), "1", tell=say),
        )
    else:
        check_products(options.folder)


if __name__ == "__main__":
    main()
