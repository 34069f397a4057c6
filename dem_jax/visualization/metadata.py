"""A run's product, scene and computation in words and units."""

from collections.abc import Sequence

import numpy as np

from dem_jax.assembly.bucket_fill import list_bucket_fills
from dem_jax.assembly.piece_arrays import (
    PieceSet,
    build_piece_set,
    compute_densities,
    compute_masses,
)
from dem_jax.io.run_data import Run
from dem_jax.scene import Scene, parse_scene
from dem_jax.scene.material_properties import (
    MaterialTable,
    build_material_table,
    find_modulus_range,
    find_piece_rows,
    keep_modulus_ranges,
)
from dem_jax.shapes import principal_extents
from dem_jax.visualization.bucket_heap import describe_heap

Facts = list[tuple[str, str]]  # name, and words
# Power of the stiffness in the peak of one impact; of a densifying spring while its overlap is
# small, of an elastic-plastic contact before it yields (then 0).
STIFFNESS_EXPONENTS = {
    "walton-braun": 0.5,
    "linear-dashpot": 0.5,
    "hertz-mindlin": 0.4,
    "densifying": 0.5,
    "elastic-plastic": 0.4,
}
ROUNDING = 1e-9  # of masses
YIELDING_LAWS = ("elastic-plastic",)  # laws whose peaks stay below those of the modulus


def find_main_group(run: Run) -> str | None:
    """The wall group whose force is the PIF: the weigh bucket's flaps, or the first; None: no
    walls.
    """
    return "wb_flaps" if "wb_flaps" in run.force else next(iter(run.force), None)


def find_main_block(run: Run) -> str | None:
    """The block whose settled mass counts: the weigh bucket's, or the first; None: there is none."""
    return "wb" if "wb" in run.settled_mass else next(iter(run.settled_mass), None)


def collect_facts(run: Run) -> dict[str, Facts]:
    """ "Product", "Scene" and "Computation" of a run, from the scene in its file. Raises
    SceneError.
    """
    scene = parse_scene(run.scene, "the file's scene")
    product = _product_facts(scene)
    if (portions := describe_portions(run)) is not None:
        product.append(("in the runs", portions))
    return {
        "Product": product,
        "Scene": _scene_facts(scene, run),
        "Computation": _computation_facts(scene, run),
    }


def describe_stiffness(run: Run) -> str:
    """Describe the dependence of the peak on Young's modulus and NSF (eqs 5, 7 and 8)."""
    scenes = list_stiffness_scenes(run)
    moduli, softening = _describe_moduli(scenes), _describe_softening(scenes)
    nsf = np.array([one.material.numerical_softening for one in scenes])
    power = STIFFNESS_EXPONENTS[scenes[0].contact.law]
    words = f"E of the pieces is {moduli}, and NSF = {softening} multiplies all moduli"
    grows = f"the peak of a single impact grows with the power {power:g} of E · NSF"
    real = (
        ""
        if np.ptp(nsf) > 0 or nsf[0] == 1.0
        else f", so without softening (NSF = 1) it would be {nsf[0] ** -power:.3g} times as high"
    )
    return f"{words}: {grows}{real}; that of a portion changes less, as harder impacts are shorter and coincide less."


def summarize_stiffness(run: Run) -> str:
    """E and NSF, without which a peak has no meaning, and the exponent with which the peak of one
    impact grows with them.
    """
    scenes = list_stiffness_scenes(run)
    scene, words = scenes[0], f"E = {_describe_moduli(scenes)}, NSF = {_describe_softening(scenes)}"
    if "law" in run.info:  # one of a user's own
        return words
    power = {0.5: "sqrt(E NSF)"}.get(
        STIFFNESS_EXPONENTS[scene.contact.law],
        f"(E NSF)^{STIFFNESS_EXPONENTS[scene.contact.law]:g}",
    )
    return f"{words}: of one impact they scale with {power}{_describe_yield(scene)}"


def list_stiffness_scenes(run: Run) -> list[Scene]:
    """The scene of a run, or the scenes of the runs of an ensemble if their moduli or their softening
    differ, without their other parameters.
    """
    scene = parse_scene(run.scene, "the file's scene")
    rows = {
        key: values
        for key, values in run.parameters.items()
        if key.endswith(("youngs_modulus", "numerical_softening"))
    }
    if not rows:
        return [scene]
    return [
        scene.replace(
            keep_modulus_ranges(scene, {key: each[k].item() for key, each in rows.items()})
        )
        for k in range(run.run_count or 1)
    ]


def describe_peak_factors(scene: Scene) -> str:
    """E and NSF behind the peaks of a scene, and the factor by which one impact would be harder
    with the product's own modulus.
    """
    words = f"E = {_describe_moduli([scene])}, NSF = {_describe_softening([scene])}"
    factors = find_peak_factors(scene)
    if factors is None:
        return f"{words}, {_describe_assumed_modulus(scene)}"
    times = f"{factors[0]:.3g} to {factors[1]:.3g} times as high"
    return f"{words}; with a modulus of {_describe_modulus_ranges(scene)} and NSF = 1 one impact is {times}"


def _describe_assumed_modulus(scene: Scene) -> str:
    """Words for a scene whose range of the modulus is not known."""
    more = 2 ** STIFFNESS_EXPONENTS[scene.contact.law]
    key = "material.youngs_modulus_range is not given"
    return (
        f"an assumed modulus ({key}): with twice the modulus one impact is {more:.3g} times as high"
    )


def _describe_modulus_ranges(scene: Scene) -> str:
    """The ranges of the moduli of the pieces, where all are known."""
    table = build_material_table(scene)
    bounds = [find_modulus_range(scene, table.names[k]) for k in np.flatnonzero(~table.is_wall)]
    return ", ".join(
        dict.fromkeys(
            f"{format_si(b[0], 'Pa')} to {format_si(b[1], 'Pa')}" for b in bounds if b is not None
        )
    )


def find_peak_factors(scene: Scene) -> tuple[float, float] | None:
    """Factors on the peak of one impact with the least and with the greatest modulus that the
    product may have.

    Both are without softening, which makes the simulated modulus E NSF: (E_product / (E NSF))^p,
    with moduli in series with those of the walls and p from ``STIFFNESS_EXPONENTS``. None: the
    range of a material is not known (material.youngs_modulus_range).
    """
    table, nsf, power = (
        build_material_table(scene),
        scene.material.numerical_softening,
        STIFFNESS_EXPONENTS[scene.contact.law],
    )
    walls = table.youngs_modulus[table.is_wall]
    walls = walls if len(walls) else np.array([np.inf])
    in_series = lambda e: 1 / (1 / e + 1 / walls)
    found = []
    for k in np.flatnonzero(~table.is_wall):
        bounds = find_modulus_range(scene, table.names[k])
        if bounds is None:
            return None
        found += [
            (in_series(e) / (nsf * in_series(table.youngs_modulus[k]))) ** power for e in bounds
        ]
    return float(np.min(found)), float(np.max(found))


def find_peak_band(run: Run) -> np.ndarray | None:
    """``find_peak_factors`` of a run, [2, 1], or of the runs of an ensemble, [2, R], by the modulus
    of each; also None for a contact law of the user.
    """
    if "law" in run.info:
        return None
    found = [find_peak_factors(scene) for scene in list_stiffness_scenes(run)]
    known = [factors for factors in found if factors is not None]
    if len(known) < len(found):
        return None
    runs = run.run_count or 1
    return np.broadcast_to(np.array(known).T, (2, runs))


def describe_peak_band(run: Run, peaks: Sequence[float] | np.ndarray) -> str:
    """The band of the peaks (kg) of a run or an ensemble for the known range of the modulus, in
    words."""
    scene, factors = parse_scene(run.scene, "the file's scene"), find_peak_band(run)
    if "law" in run.info:
        return "the peak rests on the stiffness of the contact law that was given"
    if factors is None:
        return f"the peak rests on {_describe_assumed_modulus(scene)}"
    softened = "" if scene.material.numerical_softening == 1 else " without softening (NSF = 1)"
    which = "the peak" if np.size(peaks) == 1 else "the median peak"
    low, high = np.median(factors * np.asarray(peaks), axis=1)
    product = f"a modulus of {_describe_modulus_ranges(scene)}{softened}{_describe_yield(scene)}"
    return f"band of {which}: {low:.3g} to {high:.3g} kg, as of one impact with {product}"


def _describe_yield(scene: Scene) -> str:
    """Words for a law whose pieces yield, behind what follows from the modulus alone."""
    return ", unless pieces yield" if scene.contact.law in YIELDING_LAWS else ""


def find_softened_modulus(scene: Scene) -> float:
    """The greatest E NSF (Pa) of the pieces of a scene."""
    table = build_material_table(scene)
    return float(table.youngs_modulus[~table.is_wall].max() * scene.material.numerical_softening)


def _describe_moduli(scenes: Sequence[Scene]) -> str:
    """Young's moduli of the materials of pieces, of one scene or of several that differ in them."""
    tables = [build_material_table(scene) for scene in scenes]
    moduli = zip(*(table.youngs_modulus[~table.is_wall].tolist() for table in tables), strict=True)
    return ", ".join(
        dict.fromkeys(_describe_ends([format_si(e, "Pa") for e in sorted(of)]) for of in moduli)
    )


def _describe_softening(scenes: Sequence[Scene]) -> str:
    """The softening of one scene, or of several that differ in it."""
    return _describe_ends(
        [f"{factor:g}" for factor in sorted(one.material.numerical_softening for one in scenes)]
    )


def _describe_ends(values: Sequence[str]) -> str:
    """A value, or the ends of several in order."""
    low, high = values[0], values[-1]
    return low if low == high else f"{low} to {high} (each run has its own)"


def portion_weights(run: Run) -> np.ndarray:
    """Mass (kg) of all pieces of each run of an ensemble, [K], or of a single run, [1]. Raises
    SceneError.
    """
    rows = run.info.get("piece_masses")
    if not rows:
        own = compute_masses(*_pieces_and_materials(parse_scene(run.scene, "the file's scene")))
        return np.broadcast_to(own.sum(), run.piece_counts.shape)
    lists = rows if isinstance(rows[0], list) else [rows] * len(run.piece_counts)
    return np.array(
        [
            row[0] * count if len(row) == 1 else sum(row)
            for row, count in zip(lists, run.piece_counts, strict=True)
        ]
    )


def describe_portions(run: Run) -> str | None:
    """Numbers of pieces and weights of the runs of an ensemble, in words; None: they are equal.
    Raises SceneError.
    """
    grams = 1e3 * portion_weights(run)
    if np.ptp(grams) <= ROUNDING * grams.max():
        return None
    return f"{describe_piece_count(run)}, {_format_range(grams)} g"


def describe_piece_count(run: Run) -> str:
    """The number of pieces of a run, or the smallest and the largest of an ensemble, in words."""
    low, high = int(run.piece_counts.min()), int(run.piece_counts.max())
    number = f"{low} to {high}" if low < high else str(high)
    return f"{number} piece{'s' if high != 1 else ''}"


def describe_portion(scene: Scene) -> str | None:
    """The mass of a portion beside its target weight, in words; None: it is not made by weight.
    Raises SceneError.
    """
    if scene.piece or scene.portion is None or scene.portion.count is not None:
        return None
    goods, table = _pieces_and_materials(scene)
    number = goods.numbers[0]
    mass = 1e3 * compute_masses(goods, table)[:number]
    pieces = f"{number} piece{'s' if number != 1 else ''}"
    return f"{1e3 * scene.portion.target_weight:g} g asked, {pieces} = {mass.sum():.4g} g ({_format_range(mass)} g each)"


def describe_stickiness(scene: Scene) -> list[str]:
    """Describe the stickiness of each material: pull-off force over the mean weight of a piece.
    Raises SceneError.
    """
    goods, table = _pieces_and_materials(scene)
    rows, weight = (
        find_piece_rows(table, goods.materials),
        compute_masses(goods, table) * float(np.linalg.norm(scene.run.gravity)),
    )
    said = []
    for k in sorted(set(rows.tolist())):
        walls = table.pull_off[k, table.is_wall]
        each = {
            "on pieces": table.pull_off[k, k],
            "on walls": float(walls.max()) if len(walls) else 0.0,
        }
        own = float(weight[rows == k].mean())
        words = [
            f"{pull / own:.3g} times the weight of a piece {where}"
            for where, pull in each.items()
            if pull > 0 and own > 0
        ]
        if words:
            said.append(f"stickiness of {table.names[k]}: pull-off is {', '.join(words)}")
    return said


def describe_fills(scene: Scene) -> list[str]:
    """Describe how full the portion makes each bucket. scene: with its STL files read. Raises
    SceneError.
    """
    buckets = scene.feed_bucket or scene.weigh_bucket
    return (
        [str(fill) for fill in list_bucket_fills(scene, build_piece_set(scene))]
        if buckets and scene.portion
        else []
    )


def _pieces_and_materials(scene: Scene) -> tuple[PieceSet, MaterialTable]:
    return build_piece_set(scene), build_material_table(scene)


def _product_facts(scene: Scene) -> Facts:
    goods, table = _pieces_and_materials(scene)
    mass = compute_masses(goods, table)
    kinds = [(shape.name, name) for shape, name in zip(goods.shapes, goods.materials, strict=True)]
    size = np.array([1e3 * principal_extents(shape) for shape in goods.shapes])
    facts: Facts = []
    for kind in dict.fromkeys(kinds):
        of = np.array([k == kind for k in kinds])
        edges = (
            " × ".join(_format_range(axis) for axis in size[of].T)
            if kind[0] != "sphere"
            else f"⌀ {_format_range(size[of][:, 0])}"
        )
        words = f"{edges} mm, {_format_range(1e3 * mass[of])} g each" + (
            f", of {kind[1]}" if kind[1] else ""
        )
        facts.append((f"{of.sum()} × {kind[0]}", words))
    asked = scene.portion and scene.portion.count is None and scene.feeder is None
    wish = f"; {1e3 * scene.portion.target_weight:g} g asked for" if asked and scene.portion else ""
    facts.append(
        (
            "together",
            f"{len(mass)} piece{'s' if len(mass) != 1 else ''}, {1e3 * mass.sum():.4g} g{wish}",
        )
    )
    rows, density = (
        find_piece_rows(table, goods.materials),
        compute_densities(table, goods.materials, goods.densities),
    )
    return facts + [
        _material_fact(table, k, density[rows == k])
        for k in range(len(table.names))
        if (rows == k).any()
    ]


def _material_fact(table: MaterialTable, k: int, densities: np.ndarray) -> tuple[str, str]:
    """Name and properties of a material of pieces with these densities (kg/m3); ranges where walls
    differ.
    """
    walls = np.flatnonzero(table.is_wall)
    words = f"{_format_range(densities)} kg/m³, E = {format_si(table.youngs_modulus[k], 'Pa')}, ε = {table.restitution[k, k]:g}"
    on_walls = f", {_format_range(table.friction[k, walls])} on walls" if len(walls) else ""
    return (
        f"material {table.names[k]}",
        f"{words}, μ = {table.friction[k, k]:g} between pieces{on_walls}",
    )


def _scene_facts(scene: Scene, run: Run) -> Facts:
    facts: Facts = [("name", scene.name)]
    if scene.feeder:
        pan = f"pan of {1e3 * scene.feeder.length:g} × {1e3 * scene.feeder.width:g} mm"
        pan = pan if scene.feeder.panels is None else scene.feeder.note or "panels as given"
        facts.append(("feeder", f"{pan}, {scene.feeder.frequency:g} Hz"))
    for name, bucket in (("feed bucket", scene.feed_bucket), ("weigh bucket", scene.weigh_bucket)):
        if bucket and bucket.panels:
            facts.append((name, bucket.note or "panels as given"))
        elif bucket:
            mouth = " × ".join(f"{1e3 * edge:g}" for edge in bucket.opening_size)
            flaps = f"flaps {bucket.flap_angle_deg:g}° steep"
            facts.append(
                (name, f"mouth {mouth} mm, walls {1e3 * bucket.wall_height:g} mm high, {flaps}")
            )
    if scene.feed_bucket and scene.weigh_bucket:
        facts.append(
            ("drop", f"{1e3 * scene.drop.height:g} mm between the lower edges of their flaps")
        )
    facts += [("fill level", said) for said in describe_fills(scene)[-1:]]
    heap = describe_heap(run)
    facts += [] if heap is None else [("heap", heap)]
    facts.append(("wall groups", ", ".join(run.header.groups) or "none"))
    if any(run.header.gravity):
        facts.append(("gravity", f"{np.linalg.norm(run.header.gravity):g} m/s²"))
    return facts


def _computation_facts(scene: Scene, run: Run) -> Facts:
    seeds = run.seed if isinstance(run.seed, tuple) else (run.seed,)
    runs = "" if run.run_count is None else f"{run.run_count} runs, "
    facts = [
        ("contact law", f"{scene.contact.law}, NSF = {scene.material.numerical_softening:g}"),
        ("time step", f"{1e6 * run.dt:.4g} µs"),
        ("sample time", f"{1e6 * run.sample:.4g} µs"),
        ("duration", f"{run.time[-1]:.4g} s from the release"),
        ("runs", f"{runs}seed {seeds[0]}" + (f" to {seeds[-1]}" if len(seeds) > 1 else "")),
        *((key, format_values(values)) for key, values in run.parameters.items()),
        ("precision", {"f32": "single", "f64": "double"}[run.precision]),
        ("program", f"dem_jax {run.version}"),
    ]
    return facts


def format_values(values: np.ndarray) -> str:
    """The values of a parameter, one for each run, in few words."""
    if values.ndim > 1 or values.dtype.kind not in "iuf":
        return f"{len(values)} values"
    return f"{values.min():.4g} to {values.max():.4g} ({len(np.unique(values))} values)"


def _format_range(values: Sequence[float] | np.ndarray) -> str:
    """One value, or the least and the largest."""
    low, high = f"{np.min(values):.4g}", f"{np.max(values):.4g}"
    return low if low == high else f"{low} to {high}"


def format_si(value: float, unit: str) -> str:
    """A value with k, M or G before its unit."""
    for factor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.4g} {prefix}{unit}"
    return f"{value:.4g} {unit}"
