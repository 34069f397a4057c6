"""Checks of output paths."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from product_model.inputs import BadInput


def check_target(
    key: str,
    path: str | PathLike[str],
    suffixes: Sequence[str],
    allowed: str,
    overwrite: bool = False,
) -> Path:
    """`path` if a file may be written there, else `BadInput`: another suffix, missing folder, or an
    existing file that must not be replaced. key: the argument that names it; allowed: the suffixes
    in words.
    """
    path = Path(path)
    if path.suffix not in suffixes:
        raise BadInput(f"{key} = {path}: must end in {allowed}")
    if not path.parent.is_dir():
        raise BadInput(f"{key} = {path}: the folder does not exist")
    if path.exists() and not overwrite:
        raise BadInput(f"{key} = {path}: exists; give another name, or --overwrite to replace it")
    return path
