"""Products and buckets by name, laid over a scene by its keys ``product`` and ``bucket``."""

import tomllib
from pathlib import Path
from typing import Any

from dem_jax.errors import SceneError
from dem_jax.scene.changes import Tree, merged
from dem_jax.scene.sections.pieces import OF_PRODUCT
from dem_jax.scene.words import choices

PRODUCTS = Path(__file__).parent.parent / "products"
BUCKETS = Path(__file__).parent.parent / "buckets"
OF_BUCKETS = ("feed_bucket", "weigh_bucket")


def products() -> dict[str, str]:
    """Names of the products and what each is (the first comment line of its file)."""
    return _listed(PRODUCTS)


def buckets() -> dict[str, str]:
    """Names of the buckets and what each is for (the first comment line of its file)."""
    return _listed(BUCKETS)


def _listed(folder: Path) -> dict[str, str]:
    return {path.stem: path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ") for path in sorted(folder.glob("*.toml"))}


def with_product(tree: Tree, name: Any, source: str | Path) -> Tree:
    """A scene's tree with the product in its portion: shape, sizes and [material] are the product's; how many there are and how
    they lie stays. Raises SceneError."""
    own = _named(PRODUCTS, "product", name, source)
    if tree.get("piece"):
        raise SceneError(f"{source}: product = {name!r}: allowed in a scene with a portion, this one lists its pieces")
    kept = {key: item for key, item in (tree.get("portion") or {}).items() if key not in (*OF_PRODUCT, "product")}
    return merged(tree | {"portion": kept}, own)


def with_bucket(tree: Tree, name: Any, source: str | Path) -> Tree:
    """A scene's tree with the sizes of both buckets and the drop height; whether and when they open stays but for the time that it
    takes. Raises SceneError."""
    own = _named(BUCKETS, "bucket", name, source)
    if not all(tree.get(key) for key in OF_BUCKETS):
        raise SceneError(f"{source}: bucket = {name!r}: allowed in a scene with [feed_bucket] and [weigh_bucket]")
    return merged(tree, own)


KEYS = {"product": with_product, "bucket": with_bucket}  # of a scene, which the sections of a file come after


def with_named(below: Tree, own: Tree, source: str | Path) -> Tree:
    """A tree with what the keys of ``KEYS`` in another name, which are taken out of that. Raises SceneError."""
    for key, lay in KEYS.items():
        if (name := own.pop(key, None)) is not None:
            below = lay(below, name, source)
    return below


def _named(folder: Path, key: str, name: Any, source: str | Path) -> Tree:
    """What is in a library's file. Raises SceneError."""
    known = list(_listed(folder))
    if name not in known:
        raise SceneError(f"{source}: {key} = {name!r}: no such {key}; {choices(str(name), known)}")
    return tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))
