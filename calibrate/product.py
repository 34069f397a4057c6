"""From a product to its fitted model: simulated drops, fit, judgement, report. The one module of
calibrate that uses dem_jax.
"""

import json
import math
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.curves import Curves, collect_curves
from calibrate.errors import BadInput, checked_seed
from calibrate.overall_progress import OverallProgress, Stage
from calibrate.uncertainty import available_cores
from product_model.program import saving, temporary_file

if TYPE_CHECKING:
    from calibrate.judgement import Judgement
    from calibrate.models import FittedModel
    from calibrate.product_report import Report
    from dem_jax.scene import Scene

BASE_SCENE = "weigh-bucket"
LEAST_DROPS, MOST_DROPS = 4, 100_000
SAMPLE = 30e-6  # s
SLUMP = 0.05  # s that a heap slumps for
OPENING = 0.4  # share of the time of opening after which a portion falls
PORTIONS = 512  # of the model, that drops are compared with
FIT_SECONDS = 25.0  # that a fit is expected to take
OTHER_SECONDS = 3.0  # that judgement and report are expected to take each
PIECE_SECONDS = 0.06  # that a piece of a drop is, on two cores
SEED_OF_PORTIONS = 9_000_011  # added to the seed of a fit


@dataclass(frozen=True)
class ProductRequest:
    """Arguments of `calibrate product`.

    product: a name of the library, or a TOML file of a product or of a scene; bucket: a name, a
    TOML or an STL file; target: (kg) weight of a portion; scene: that the product is dropped in;
    settings: changed keys of the scene; out: a folder, or a .json file
    """

    product: str
    bucket: str | None = None
    target: float | None = None
    drops: int = 64
    seed: int = 0
    scene: str | None = None
    settings: Mapping[str, Any] | None = None
    model: str = "paper"
    out: str | None = None
    overwrite: bool = False
    force: bool = False

    @property
    def name(self) -> str:
        """Name of the product."""
        return Path(self.product).stem if self.product.endswith(".toml") else self.product


@dataclass(frozen=True)
class ProductFiles:
    """Paths of the results."""

    ensemble: Path
    fit: Path
    html: Path
    pdf: Path
    figures: dict[str, Path]

    @property
    def results(self) -> list[Path]:
        """All paths except that of the ensemble."""
        return [self.fit, self.html, self.pdf, *self.figures.values()]


@dataclass(frozen=True)
class ProductFit:
    """Result of a calibration, and the files written."""

    fitted: "FittedModel"
    judgement: "Judgement"
    files: ProductFiles


class SimulationFailed(Exception):
    """One line: a drop cannot be simulated."""


@contextmanager
def _dem_errors() -> Iterator[None]:
    """Errors of dem_jax as those of this package."""
    from dem_jax.errors import PlatformError, RecordError, SceneError, SimulationError

    try:
        yield
    except (SceneError, RecordError, PlatformError) as error:
        raise BadInput(" ".join(str(error).split())) from None
    except SimulationError as error:
        raise SimulationFailed(" ".join(str(error).split())) from None


def calibrate_product(
    request: ProductRequest, tell: Callable[[str], object] = lambda _: None, shown: bool = False
) -> ProductFit:
    """Simulate drops of a product, fit a model, judge it, and write all of it.

    Args:
        request: product, bucket, model and number of drops.
        tell: called with each line on the progress of the work.
        shown: whether there is a progress bar on stderr.

    Returns:
        The fit, its judgement, and the files.

    Raises:
        BadInput: one line.
        SimulationFailed: one line.
    """
    _check_request(request)
    files = plan_files(request)
    with _dem_errors():
        scene = load_product_scene(request)
        masses = portion_masses(scene)
    _check_ensemble(files, scene, request)
    tell(describe_drops(request, scene, masses))
    ensemble_seconds = PIECE_SECONDS * len(masses) * request.drops * 2 / available_cores()
    stages = [
        Stage("drops", ensemble_seconds),
        Stage("fit", FIT_SECONDS),
        *(Stage(n, OTHER_SECONDS) for n in ("judgement", "report")),
    ]
    with OverallProgress(stages, shown) as progress:
        progress.begin("drops")
        said = simulate_drops(files, scene, request, progress)
        progress.begin("fit")
        fitted, data = _fit_drops(files, request, progress)
        progress.begin("judgement")
        report = _judge(request, scene, masses, fitted, data)
        progress.begin("report")
        if not fitted.absurd or request.force:
            write_results(files, report, request)
        progress.finish()
    for line in said:
        tell(line)
    return ProductFit(fitted, report.judgement, files)


def _check_request(request: ProductRequest) -> None:
    from calibrate.models import find_model

    checked_seed(request.seed)
    find_model(request.model)
    if not LEAST_DROPS <= request.drops <= MOST_DROPS:
        raise BadInput(
            f"drops = {request.drops}: must be a whole number from {LEAST_DROPS} to {MOST_DROPS}"
        )
    if request.target is not None and not (math.isfinite(request.target) and request.target > 0):
        raise BadInput(f"target = {request.target:g}: must be greater than 0 (kg)")


def plan_files(request: ProductRequest) -> ProductFiles:
    """Paths of all results. Raises `BadInput` if one exists, unless it may be replaced, or cannot
    be written.
    """
    out = Path(request.out or request.name)
    if out.suffix == ".json":
        folder, stem = out.parent, f"{out.stem}-"
        names = {
            "ensemble": f"{out.stem}.h5",
            "fit": out.name,
            "html": f"{out.stem}.html",
            "pdf": f"{out.stem}.pdf",
        }
    else:
        folder, stem = out, ""
        names = {
            "ensemble": "drops.h5",
            "fit": "fit.json",
            "html": "report.html",
            "pdf": "report.pdf",
        }
    if folder != out and not folder.is_dir():
        raise BadInput(f"out = {out}: there is no folder {str(folder)!r}")
    if folder == out and (out.suffix or (out.exists() and not out.is_dir())):
        raise BadInput(f"out = {out}: must be a folder, or a file that ends in .json")
    figures = {name: folder / f"{stem}{name}.png" for name in ("force", "momentum", "load-cell")}
    ensemble, fit, html, pdf = (folder / names[key] for key in ("ensemble", "fit", "html", "pdf"))
    files = ProductFiles(ensemble, fit, html, pdf, figures)
    _check_writable(folder, out)
    for path in files.results:
        if path.exists() and not request.overwrite:
            raise BadInput(
                f"out = {out}: {path} exists; allowed: another --out, or --overwrite to replace it"
            )
        if path.exists() and not (path.is_file() and os.access(path, os.W_OK)):
            raise BadInput(f"out = {out}: {path} cannot be written")
    return files


def _check_writable(folder: Path, out: Path) -> None:
    """Make the folder. Raises `BadInput` where that fails or nothing can be written in it."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise BadInput(
            f"out = {out}: the folder cannot be made ({error.strerror or error})"
        ) from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInput(f"out = {out}: no permission to write in {str(folder)!r}")


def load_product_scene(request: ProductRequest) -> "Scene":
    """The scene of a drop, with STL files read.

    Raises SceneError, and `BadInput` unless one portion falls from one bucket into another.
    """
    from dem_jax import assembly
    from dem_jax.scene import load_scene

    settings = dict(request.settings or {})
    changes: dict[str, Any] = {
        "run.frame_interval": 0.0,
        "run.sample_interval": SAMPLE,
        "run.track_energy": False,
    }
    base = request.scene or BASE_SCENE
    if _is_scene(request.product):
        if request.scene is not None:
            raise BadInput(
                f"scene = {request.scene}: no effect beside {request.product}, which is a scene; leave out one of the two"
            )
        base = request.product
    else:
        changes["product"] = request.product
    changes |= _bucket_changes(request.bucket)
    if request.target is not None:
        changes["portion.target_weight"] = request.target
    scene = load_scene(base, changes | settings)
    _check_scene(base, scene)
    if "run.duration" not in settings:
        scene = scene.replace({"run.duration": min(scene.run.duration, choose_duration(scene))})
    if "name" not in settings:
        scene = scene.replace({"name": request.name})
    return assembly.inline_files(scene)


def _is_scene(product: str) -> bool:
    """Whether a product is a TOML file of a whole scene. Raises `BadInput` where it cannot be read."""
    from dem_jax.scene.library import PRODUCT_SECTIONS

    if not product.endswith(".toml"):
        return False
    try:
        tree = tomllib.loads(Path(product).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise BadInput(f"product = {product}: cannot be read ({error.strerror or error})") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(
            f"product = {product}: not valid TOML ({str(error).splitlines()[0]})"
        ) from None
    return not set(tree) <= set(PRODUCT_SECTIONS)


def _bucket_changes(bucket: str | None) -> dict[str, Any]:
    """Keys of a scene for a bucket by name, or in a TOML or an STL file."""
    if bucket is None:
        return {}
    if bucket.lower().endswith(".stl"):
        if not Path(bucket).is_file():
            raise BadInput(f"bucket = {bucket}: no such file")
        return {"weigh_bucket.stl": str(Path(bucket).resolve()), "weigh_bucket.centre": True}
    return {"bucket": bucket}


def _check_scene(base: str, scene: "Scene") -> None:
    has = [name for name in ("feeder", "cycle", "inlet") if getattr(scene, name) is not None]
    lacks = [
        name for name in ("portion", "feed_bucket", "weigh_bucket") if getattr(scene, name) is None
    ]
    if has or lacks or scene.piece:
        why = f"has [{has[0]}]" if has else f"lacks [{lacks[0]}]" if lacks else "lists its pieces"
        raise BadInput(
            f"scene = {base}: {why}; allowed: a scene in which one portion falls from a feed bucket into a weigh bucket"
        )


def choose_duration(scene: "Scene") -> float:
    """(s) until a portion is at rest: opening of the flaps, fall, rebounds, each ε times as long as
    the one before, and slumping.
    """
    named = [
        own.restitution
        for own in scene.material.named_materials.values()
        if own.restitution is not None
    ]
    restitution = min(max([scene.material.restitution, *named]), 0.9)
    fall = math.sqrt(2.0 * scene.drop.height / float(np.linalg.norm(scene.run.gravity)))
    assert scene.feed_bucket is not None  # as _check_scene makes sure
    opening = max(scene.feed_bucket.opening_start, 0.0) + OPENING * scene.feed_bucket.opening_time
    return round(opening + fall * (1.0 + 2.0 * restitution / (1.0 - restitution)) + SLUMP, 2)


def portion_masses(scene: "Scene") -> np.ndarray:
    """[N] (kg) of the pieces of a portion. Raises SceneError."""
    from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
    from dem_jax.scene.material_properties import build_material_table

    return compute_masses(build_piece_set(scene), build_material_table(scene))


def describe_drops(request: ProductRequest, scene: "Scene", masses: np.ndarray) -> str:
    """The portion, its fall and the number of drops, in one line."""
    low, high = f"{1e3 * masses.min():.4g}", f"{1e3 * masses.max():.4g}"
    each = (
        f"{low} g each" if low == high else f"{low} to {high} g, mean {1e3 * masses.mean():.4g} g"
    )
    count = f"{len(masses)} piece{'s' if len(masses) != 1 else ''} ({each})"
    seeds = f"seeds {request.seed} to {request.seed + request.drops - 1}"
    return (
        f"{request.name}: {count}, {1e3 * masses.sum():.4g} g in all, fall {1e3 * scene.drop.height:g} mm between the flaps of two "
        f"buckets; {request.drops} drops of {scene.run.duration:g} s, {seeds}"
    )


def _check_ensemble(files: ProductFiles, scene: "Scene", request: ProductRequest) -> bool:
    """Check an existing ensemble. Raises `BadInput` for one of other inputs, unless it may be
    replaced.
    """
    if not files.ensemble.exists():
        return False
    why = find_difference(files.ensemble, scene, request)
    if why is not None and not request.overwrite:
        raise BadInput(
            f"{files.ensemble} holds other drops ({why}); allowed: another --out, or --overwrite to replace it"
        )
    return why is None


def find_difference(path: Path, scene: "Scene", request: ProductRequest) -> str | None:
    """The first difference between the ensemble of a file and the requested one, in words; None:
    there is none.
    """
    import h5py

    from dem_jax import __version__

    try:
        with h5py.File(path, "r") as file:
            attrs = dict(file.attrs)
        held = tomllib.loads(str(attrs["scene"]))
        seeds, version = np.ravel(attrs["seed"]).tolist(), str(attrs["version"])
    except (OSError, KeyError, ValueError) as error:
        return f"it cannot be read as an ensemble: {str(error).splitlines()[0]}"
    asked = list(range(request.seed, request.seed + request.drops))
    if seeds != asked:
        return f"{len(seeds)} drops from seed {seeds[0]}, asked for are {len(asked)} from seed {asked[0]}"
    one, other = (dict(_flatten(tree)) for tree in (held, tomllib.loads(scene.to_toml())))
    for key in sorted(one.keys() | other.keys()):
        if one.get(key) != other.get(key):
            return f"{key} = {_short(one.get(key))}, asked for is {_short(other.get(key))}"
    return (
        None
        if version == __version__
        else f"of version {version} of dem_jax, this is {__version__}"
    )


def _flatten(tree: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys of a tree and their values."""
    if isinstance(tree, dict):
        for name, item in tree.items():
            yield from _flatten(item, f"{key}.{name}" if key else name)
    else:
        yield key, tree


def _short(item: Any) -> str:
    text = "not given" if item is None else str(item)
    return text if len(text) <= 40 else f"{text[:37]}..."


def simulate_drops(
    files: ProductFiles, scene: "Scene", request: ProductRequest, progress: OverallProgress
) -> list[str]:
    """Make the ensemble of a file, or complete the one that is there; returns lines on the work
    done.

    Raises as `calibrate_product`.
    """
    import dem_jax
    from dem_jax import process

    path = files.ensemble
    held = path.exists() and find_difference(path, scene, request) is None
    before = _recorded_time(path) if held else 0.0
    if held and before >= scene.run.duration - 1.5 * scene.run.sample_interval:
        return [f"drops: {path} holds them already; reused, not computed anew"]

    def save() -> str | None:
        return (
            f"what was computed is in {path}; the same command continues"
            if process.save_partial_results()
            else None
        )

    with _dem_errors(), saving(save):
        if held:
            run = dem_jax.resume(path, progress=progress.tell)
        else:
            run = dem_jax.ensemble(
                scene, request.drops, request.seed, path, overwrite=True, progress=progress.tell
            )
    said = [f"drops: continued from {1e3 * max(before, 0.0):.0f} ms in {path}"] if held else []
    return [*said, *(f"note: {note}" for note in run.info.get("notes", ()))]


def _recorded_time(path: Path) -> float:
    """Recorded time (s) of the ensemble in a file; infinite if it ended because all was at rest."""
    import h5py

    with h5py.File(path, "r") as file:
        if "settled" in json.loads(str(file.attrs.get("info", "{}"))):
            return math.inf
        return float(file["time"][-1]) if "time" in file and len(file["time"]) else 0.0


def _fit_drops(
    files: ProductFiles, request: ProductRequest, progress: OverallProgress
) -> tuple["FittedModel", Curves]:
    from calibrate.models import find_model
    from calibrate.targets import read

    shares = {
        "starts": (0.0, 0.3),
        "bootstrap": (0.3, 0.7),
    }  # of the time of a fit: before a stage, and of it

    def tell(stage: str, done: int, total: int) -> None:
        before, own = shares.get(stage, (0.0, 1.0))
        words = f"interval {min(done, total)} of {total}" if stage == "bootstrap" else stage
        progress.tell(words, before + own * min(done / max(total, 1), 1.0))

    targets = read(files.ensemble)
    return find_model(request.model)(targets, request.seed, tell, request.force), collect_curves(
        targets
    )


def _judge(
    request: ProductRequest, scene: "Scene", masses: np.ndarray, fitted: "FittedModel", data: Curves
) -> "Report":
    from calibrate.judgement import judge
    from calibrate.product_report import Report
    from dem_jax.visualization.metadata import describe_fills, describe_peak_factors

    model = fitted.simulate(PORTIONS, request.seed + SEED_OF_PORTIONS)
    feed = scene.feed_bucket
    assert feed is not None  # as _check_scene makes sure
    facts = {
        "scene": f"{request.scene or BASE_SCENE if not _is_scene(request.product) else request.product}"
        + (f", bucket {request.bucket}" if request.bucket else ""),
        "flaps": f"of the feed bucket open in {1e3 * feed.opening_time:g} ms",
        "fill": (describe_fills(scene) or ["not known"])[-1],
        "stiffness": describe_peak_factors(scene),
    }
    found = judge(fitted, data, model)
    return Report(
        request.name, describe_drops(request, scene, masses), facts, fitted, found, data, model
    )


def write_results(files: ProductFiles, report: "Report", request: ProductRequest) -> None:
    """Write fit.json, the figures and the report. Raises `BadInput`."""
    from calibrate.product_figures import draw_all
    from calibrate.product_report import html_page, pdf_page

    figures = draw_all(report.data, report.model)
    content = report.fitted.content | {"product": describe_inputs(files, report, request)}
    try:
        for name, path in files.figures.items():
            with temporary_file(path) as part:
                figures[name].savefig(part, dpi=150, format="png")
        with temporary_file(files.html) as part:
            part.write_text(html_page(report, figures), encoding="utf-8")
        with temporary_file(files.pdf) as part:
            pdf_page(report).savefig(part, format="pdf")
        with temporary_file(files.fit) as part:
            part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise BadInput(
            f"out = {files.fit}: cannot be written ({error.strerror or error})"
        ) from None


def describe_inputs(
    files: ProductFiles, report: "Report", request: ProductRequest
) -> dict[str, Any]:
    """The entries of fit.json on the origin of its fit, and the judgement."""
    found = report.judgement
    return {
        "name": request.name,
        "model": report.fitted.name,
        "drops": request.drops,
        "seed": request.seed,
        "ensemble": files.ensemble.name,
        "portion_mass": float(np.mean(report.data.mass)),
        "verdict": found.verdict,
        "rejected": report.fitted.is_rejected,
        "reasons": found.reasons,
        "advice": found.advice,
        "comparisons": [vars(row) for row in found.comparisons],
    }
