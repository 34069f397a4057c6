"""weigher.json: an estimator of the weight as text, with the unit of each number."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from product_model.inputs import BadInput
from product_model.program import temporary_file
from product_model.weigher import CHECKS, Weigher

VERSION = 3  # of the file
DIGITS = 7  # significant, of numbers of tables
UNITS = {
    "interval": "s",
    "omega": "1/s",
    "delta": "1/s",
    "mass": "g",
    "kick": "g",
    "kick_rate": "g s",
    "load_rate": "g s",
    "white": "g",
    "line_innovation": "g",
    "drift": "g",
    "level": "g",
    "weight": "g",
    "least": "g",
    "most": "g",
    "impulse": "s",
    "shapes": "g s",
    "residual": "g s",
    "pulse": "g s",
    "filter_sd": "g",
}
ROWS = ("impulse", "residual", "landed", "pulse", "widening", "filter_sd")  # [N]
WHOLE = ("settled",)
POSITIVE = (
    "interval",
    "omega",
    "mass",
    "white",
    "level",
    "weight",
    "threshold",
    "residual",
    "widening",
    "check_sd",
    "filter_sd",
)


def save_weigher(weigher: Weigher, path: str | Path, about: dict[str, Any] | None = None) -> None:
    """Write an estimator; about: how it was made, for people. Raises `BadInput` where the file
    cannot be written."""
    values = {
        field.name: np.asarray(getattr(weigher, field.name)).tolist() for field in fields(weigher)
    }
    rounded = {name: _rounded(value) for name, value in values.items()}
    content = {"weigher": VERSION, "about": about or {}, "units": UNITS, **rounded}
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items()]
    try:
        with temporary_file(Path(path)) as part:
            part.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror or error})") from None


def load_weigher(path: str | Path) -> Weigher:
    """The estimator in a file. Raises `BadInput` with one line that names the key and what is
    allowed."""
    content = _content(path)
    names = [field.name for field in fields(Weigher)]
    if missing := [name for name in names if name not in content]:
        raise BadInput(f"{path}: lacks {', '.join(missing)}")
    values: dict[str, Any] = {}
    for name in names:
        try:
            values[name] = np.asarray(content[name], np.int32 if name in WHOLE else np.float64)
        except (TypeError, ValueError):
            raise BadInput(f"{path}: {name}: allowed: numbers, all rows of equal length") from None
        if not np.isfinite(values[name]).all():
            raise BadInput(f"{path}: {name}: allowed: finite numbers")
        if name in POSITIVE and not (values[name] > 0).all():
            raise BadInput(f"{path}: {name}: allowed: numbers above 0")
    _check_shapes(path, values)
    return Weigher(**values)


def _content(path: str | Path) -> dict[str, Any]:
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise BadInput(f"{path}: is no JSON file ({error})") from None
    version = content.get("weigher") if isinstance(content, dict) else None
    if version != VERSION:
        raise BadInput(
            f"{path}: weigher = {version!r}: allowed: {VERSION}, a file that calibrate weigher of this "
            "version wrote; learn the product again"
        )
    return content


def _check_shapes(path: str | Path, values: dict[str, np.ndarray]) -> None:
    rows = len(values["impulse"]) if values["impulse"].ndim else 0
    shapes, sections = values["shapes"], values["sections"]
    allowed: dict[str, tuple[int, ...]] = dict.fromkeys(ROWS, (rows,)) | {
        "shapes": (rows, shapes.shape[1] if shapes.ndim == 2 else 0),
        "check_mean": (rows, CHECKS),
        "check_sd": (rows, CHECKS),
        "threshold": (CHECKS,),
        "line": (2,),
        "sections": (len(sections) if sections.ndim else 0, 6),
    }
    for name, value in values.items():
        wanted = allowed.get(name, ())
        if value.shape != wanted or not all(wanted):
            raise BadInput(
                f"{path}: {name}: has {value.shape} numbers, allowed: {wanted}, at least one row"
            )


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return value if isinstance(value, int) else float(f"{value:.{DIGITS}g}")
