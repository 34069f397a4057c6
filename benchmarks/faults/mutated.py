"""Files that something has changed: scenes, studies, meshes, tables and results, each by one of
several mutations.

What may come of one is what the file says, with all numbers finite, or one line of an error of
ours; never another error, a hang, a process that takes all memory, or numbers that nobody wrote:
the series of a damaged file of results are those that were saved.
"""

import re
import traceback
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import dem_jax
from calibrate.errors import BadInput as BadFit
from dem_jax.errors import RecordError, SceneError
from product_model.inputs import BadInput

OURS = (SceneError, RecordError, BadFit, BadInput)
KINDS = (
    "toml",
    "study",
    "stl of a wall",
    "stl of a piece",
    "csv of a motion",
    "csv of forces",
    "hdf5",
    "hdf5 of the model",
)
GOOD = ("accepted", "one line")
TOKENS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "1e-308",
    "-0.0",
    "2147483648",
    "1e400",
    '""',
    "[]",
    "{}",
    "true",
    "\x00",
    "é",
)
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


class Case(NamedTuple):
    """A file to be mutated; folder: where it may be written and where the files of results are."""

    kind: str
    seed: int
    folder: str

    def __str__(self) -> str:
        return f"{self.kind}, {self.seed}"


def outcome(case: Case) -> tuple[str, str]:
    """What came of a case, and the words of it."""
    random = np.random.default_rng(case.seed)
    folder = Path(case.folder)
    originals = seeds(case.kind, case.folder)
    name, content = originals[random.integers(len(originals))]
    path = folder / f"mutated{Path(name).suffix}"
    path.write_bytes(mutated(content, random))
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            wrong = READERS[case.kind](path, name)
    except OURS as error:
        lines = str(error).splitlines()
        return ("one line", lines[0]) if len(lines) == 1 else ("many lines", str(error)[:300])
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        where = [
            f"{Path(f.filename).name}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)
        ]
        return "traceback", f"{type(error).__name__} at {' '.join(where[-3:])}: {str(error)[:200]}"
    return ("nonsense", wrong) if wrong else ("accepted", "")


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """A file with one to three mutations."""
    for _ in range(random.integers(1, 4)):
        content = MUTATIONS[random.integers(len(MUTATIONS))](content, random)
    return content


def _span(content: bytes, random: np.random.Generator) -> tuple[int, int]:
    """Where a part of up to 64 bytes begins and ends."""
    start = int(random.integers(max(1, len(content))))
    return start, start + int(random.integers(1, 65))


def _flip(content: bytes, random: np.random.Generator) -> bytes:
    out = bytearray(content)
    for _ in range(random.integers(1, 9) if out else 0):
        out[random.integers(len(out))] ^= 1 << int(random.integers(8))
    return bytes(out)


def _cut(content: bytes, random: np.random.Generator) -> bytes:
    start, end = _span(content, random)
    return content[:start] + content[end:]


def _truncate(content: bytes, random: np.random.Generator) -> bytes:
    return content[: random.integers(len(content) + 1)]


def _repeat(content: bytes, random: np.random.Generator) -> bytes:
    start, end = _span(content, random)
    return content[:end] + content[start:end] * int(random.integers(1, 50)) + content[end:]


def _insert(content: bytes, random: np.random.Generator) -> bytes:
    at = int(random.integers(len(content) + 1))
    return content[:at] + random.bytes(int(random.integers(1, 32))) + content[at:]


def _number(content: bytes, random: np.random.Generator) -> bytes:
    """Another word in the place of a number."""
    found = list(NUMBER.finditer(content[:200_000]))
    if not found:
        return content
    one = found[random.integers(len(found))]
    word = (
        TOKENS[random.integers(len(TOKENS))].encode()
        if random.random() < 0.7
        else found[random.integers(len(found))].group()
    )
    return content[: one.start()] + word + content[one.end() :]


def _lines(content: bytes, random: np.random.Generator) -> bytes:
    """Two lines in each other's place."""
    rows = content.split(b"\n")
    a, b = random.integers(len(rows), size=2)
    rows[a], rows[b] = rows[b], rows[a]
    return b"\n".join(rows)


MUTATIONS: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    _flip, _cut, _truncate, _repeat, _insert, _number, _number, _lines,
)  # fmt: skip


@cache
def seeds(kind: str, folder: str) -> list[tuple[str, bytes]]:
    """Files of a kind as they should be: name and content."""
    package = Path(dem_jax.__file__).parent
    if kind == "toml":
        return [(p.name, p.read_bytes()) for p in sorted((package / "scenes").glob("*.toml"))] + [
            ("all.toml", _everything())
        ]
    if kind == "study":
        return [(p.name, p.read_bytes()) for p in sorted((package / "studies").glob("*.toml"))]
    if kind.startswith("stl"):
        return _meshes()
    if kind == "csv of a motion":
        time = np.linspace(0, 0.1, 11)
        rows = "\n".join(f"{t:.3f},{60 * t:.4f},{0.01 * t:.5f}" for t in time)
        return [("motion.csv", f"time,angle_deg,x\n{rows}\n".encode())]
    if kind == "csv of forces":
        time = 0.0025 * np.arange(200)
        force = 0.5 * (1 - np.exp(-time / 0.05))
        plain = "time (s),F1 (N),F2 (N)\n" + "\n".join(
            f"{t:.4f},{f:.5f},{1.1 * f:.5f}" for t, f in zip(time, force, strict=True)
        )
        rows = "\n".join(
            f"{1e3 * t:.1f};{100 * f:.3f}".replace(".", ",")
            for t, f in zip(time, force, strict=True)
        )
        german = f"Zeit [ms];Kraft [g]\n{rows}"
        return [("plain.csv", plain.encode()), ("german.csv", german.encode())]
    name = {"hdf5": "run*.h5", "hdf5 of the model": "model*.h5"}[kind]
    return [(p.name, p.read_bytes()) for p in sorted(Path(folder).glob(name))]


def _everything() -> bytes:
    """A scene with as many sections as go together."""
    return b"""base = "weighing-station"
[material]
restitution = 0.3
[material.gummy]
density = 1300.0
youngs_modulus = 2e7
[[pair]]
of = ["gummy", "wall"]
restitution = 0.5
[portion]
target_weight = 0.1
share_by = "weight"
[[portion.product]]
shape = "sphere"
radius = 0.008
material = "gummy"
size_spread = 0.1
share = 2
[[portion.product]]
shape = "prism"
sides = 5
radius = 0.01
height = 0.02
[cycle]
period = 1.3
wb = { opens = [0.0, 0.08], closes = [0.1, 0.19] }
fb = { opens = [0.08, 0.16], closes = [0.26, 0.35] }
lf = [0.35, 1.05]
[run]
duration = 3.9
on_escape = "warn"
"""


@cache
def _meshes() -> list[tuple[str, bytes]]:
    """A closed box, binary and as text."""
    import trimesh

    box = trimesh.creation.box((30.0, 20.0, 10.0))
    ball = trimesh.creation.icosphere(1, 15.0)
    return [
        ("box.stl", box.export(file_type="stl")),
        ("ball.stl", ball.export(file_type="stl")),
        ("text.stl", box.export(file_type="stl_ascii").encode()),
    ]


# --- reading, and what is silently wrong with what was read; None: nothing ---


def _toml(path: Path, _: str) -> str | None:
    scene = dem_jax.load_scene(path)
    again = dem_jax.load_scene(path)
    numbers = list(_numbers(scene.model_dump()))
    if not np.isfinite(numbers).all():
        return "a number that is not finite"
    return None if again.to_toml() == scene.to_toml() else "two readings differ"


def _numbers(tree: Any) -> Any:
    """All real numbers of a tree of plain values."""
    if isinstance(tree, dict):
        tree = list(tree.values())
    if isinstance(tree, list | tuple):
        for item in tree:
            yield from _numbers(item)
    elif isinstance(tree, float):
        yield tree


def _study(path: Path, _: str) -> str | None:
    from dem_jax.study.config import load_study

    scenes = [load_study(path, quick).base_scene() for quick in (False, True)]  # which checks what
    # is set
    numbers = [x for scene in scenes for x in _numbers(scene.model_dump())]
    return None if np.isfinite(numbers).all() else "a number that is not finite"


def _wall(path: Path, _: str) -> str | None:
    from dem_jax.assembly import system

    wall = [{"group": "plate", "stl": path.name, "unit": 1e-3}]
    scene = (
        dem_jax.load_scene("plate-drop")
        .replace(wall=wall, region=[])
        .model_copy(update={"folder": str(path.parent)})
    )
    panels = [row.corners for row in system.inline_files(scene).wall]
    return (
        None
        if panels and np.isfinite(np.concatenate(panels)).all()
        else "panels that are not finite, or none"
    )


def _piece(path: Path, _: str) -> str | None:
    from dem_jax.shapes import read_hull_shape

    shape = read_hull_shape(path, 1e-3)
    return (
        None
        if np.isfinite(shape.vertices).all() and shape.volume > 0
        else "a body that is not finite"
    )


def _motion(path: Path, _: str) -> str | None:
    from dem_jax.assembly import system

    motion = [{"group": "plate", "table": path.name}]
    scene = (
        dem_jax.load_scene("plate-drop")
        .replace(motion=motion)
        .model_copy(update={"folder": str(path.parent)})
    )
    row = system.inline_files(scene).motion[0]
    values = [row.times or (), row.angles_deg or (), *(row.displacements or ())]
    if not all(np.isfinite(v).all() for v in values):
        return "rows that are not finite"
    return None if (np.diff(row.times or ()) > 0).all() else "times that do not rise"


def _forces(path: Path, _: str) -> str | None:
    from calibrate.targets import read

    for found in read(path, m_piece=0.005, pieces=10):
        if not (
            np.isfinite(found.time).all()
            and np.isfinite(found.force).all()
            and (np.diff(found.time) > 0).all()
        ):
            return "rows that are not finite, or times that do not rise"
    return None


def _results(path: Path, name: str) -> str | None:
    from dem_jax.io import run_files

    run = run_files.load_run(path)
    wrong = _unlike(
        run_files.collect_series(run), run_files.collect_series(_saved(str(path.parent / name)))
    )
    if wrong:
        return wrong
    try:
        run_files.load_restart(path)
    except RecordError as error:
        return None if len(str(error).splitlines()) == 1 else "many lines"
    return None


@cache
def _saved(path: str) -> Any:
    return dem_jax.load_run(path)


def _unlike(found: dict[str, np.ndarray], saved: dict[str, np.ndarray]) -> str | None:
    """Which series has other numbers than were saved."""
    for name in found.keys() & saved.keys():
        if found[name].shape != saved[name].shape or not np.array_equal(
            found[name], saved[name], equal_nan=True
        ):
            return f"{name} is not what was saved"
    return None


def _model(path: Path, name: str) -> str | None:
    from dem_jax.weighing.traces import load_trace

    (found, _), (saved, _) = load_trace(path), load_trace(path.parent / name)
    return _unlike(
        {"weight": found.weight, "time": found.time}, {"weight": saved.weight, "time": saved.time}
    )


READERS: dict[str, Callable[[Path, str], str | None]] = dict(
    zip(KINDS, (_toml, _study, _wall, _piece, _motion, _forces, _results, _model), strict=True)
)
