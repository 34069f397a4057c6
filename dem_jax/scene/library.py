"""Products by name: shape and material of a portion, laid over a scene by its key ``product``."""

import tomllib
from pathlib import Path
from typing import Any

from dem_jax.errors import SceneError
from dem_jax.scene.changes import Tree, merged
from dem_jax.scene.sections.pieces import OF_PRODUCT
from dem_jax.scene.words import choices

PRODUCTS = Path(__file__).parent.parent / "products"


def products() -> dict[str, str]:
    """Names of the products and what each is (the first comment line of its file)."""
    return {path.stem: path.read_text().splitlines()[0].lstrip("# ") for path in sorted(PRODUCTS.glob("*.toml"))}


def with_product(tree: Tree, name: Any, source: str | Path) -> Tree:
    """A scene's tree with the product in its portion: shape, sizes and [material] are the product's; how many there are and how
    they lie stays. Raises SceneError."""
    known = products()
    if name not in known:
        raise SceneError(f"{source}: product = {name!r}: no such product; {choices(str(name), list(known))}")
    if tree.get("piece"):
        raise SceneError(f"{source}: product = {name!r}: allowed in a scene with a portion, this one lists its pieces")
    own = tomllib.loads((PRODUCTS / f"{name}.toml").read_text())
    kept = {key: item for key, item in (tree.get("portion") or {}).items() if key not in (*OF_PRODUCT, "product")}
    return merged(tree | {"portion": kept}, own)
