"""Products and buckets by name, or in a TOML file of the same form, laid over a scene by its keys
``product`` and ``bucket``.
"""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dem_jax.errors import SceneError
from dem_jax.scene.evidence import extract_scene_sections, read_states, select_state
from dem_jax.scene.former_keys import accept_tables
from dem_jax.scene.messages import shorten_value, suggest_choices
from dem_jax.scene.overrides import drop_overridden_keys
from dem_jax.scene.sections.contact import LAW_KEYS
from dem_jax.scene.sections.material import NamedMaterial
from dem_jax.scene.sections.piece import PRODUCT_KEYS, SPREAD_KEYS
from dem_jax.scene.tree_merging import (
    DEEPEST,
    Tree,
    drop_replaced_ranges,
    is_too_deep,
    merge_tables,
    overlay_scene,
)

PRODUCTS = Path(__file__).parent.parent / "products"
BUCKETS = Path(__file__).parent.parent / "buckets"
FORMER_NAMES = {  # of buckets, of a version that named them by what makers call such heads -> by
    # what they hold
    "0.5-litre": "0.9-litre",
    "1.6-litre": "2.9-litre",
    "1.6-litre-gentle": "2.7-litre-gentle",
    "1.6-litre-low": "1.9-litre-low",
    "3-litre": "5.4-litre",
    "5-litre": "9.1-litre",
}
BUCKET_SECTIONS = ("feed_bucket", "weigh_bucket")
LAWS_OF_PRODUCTS = ("densifying", "elastic-plastic")  # contact laws that belong to a product
KEYS_OF_LAWS = ("law", *(key for section, key in LAW_KEYS if section == "contact"))  # of [contact]
ONE_PIECE = {"portion.count": 1} | {f"portion.{key}": 0.0 for key in SPREAD_KEYS}  # changes of a
# scene
PRODUCT_SECTIONS = ("portion", "material", "pair", "contact", "evidence", "state")
FILE_SECTIONS = {PRODUCTS: PRODUCT_SECTIONS, BUCKETS: (*BUCKET_SECTIONS, "drop")}  # of a file of
# the user's


def list_products() -> dict[str, str]:
    """Names of the products and what each is (the first comment line of its file)."""
    return _list_first_comments(PRODUCTS)


def list_buckets() -> dict[str, str]:
    """Names of the buckets, by the litres that the weigh bucket holds to its brim, and what each is
    for (the first comment line of its file).
    """
    return _list_first_comments(BUCKETS)


def find_bucket_file(name: str) -> Path:
    """The file of a bucket by its name or its former name."""
    return BUCKETS / f"{FORMER_NAMES.get(name, name)}.toml"


def _list_first_comments(folder: Path) -> dict[str, str]:
    return {
        path.stem: path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        for path in sorted(folder.glob("*.toml"))
    }


def load_product(name: Any, source: str | Path, key: str = "product") -> Tree:
    """The tree of a product in one of its states, with its evidence.

    Args:
        name: of the library, or a file that ends in .toml; with ``:STATE`` the state of that name.
        source: begins the messages of errors.
        key: that names the product.

    Raises:
        SceneError: there is no such product, or it has no such state.
    """
    plain, state = _split_state(name)
    begin = f"{source}: {key} = {name!r}"
    tree = select_state(_load_named(PRODUCTS, key, plain, source), state, begin)
    for section in ("portion", "material", "contact"):
        if not isinstance(tree.get(section, {}), dict):
            raise SceneError(
                f"{begin}: {section} = {shorten_value(tree[section])}: allowed: a table [{section}]"
            )
    return tree


def list_product_states(name: str) -> list[str]:
    """Names of the further states of a product, [] where the name is of a state. Raises SceneError."""
    plain, state = _split_state(name)
    return (
        list(read_states(_load_named(PRODUCTS, "product", plain, "products"), f"product {plain}"))
        if state is None
        else []
    )


def _split_state(name: Any) -> tuple[Any, str | None]:
    """Product and state of ``PRODUCT:STATE``, else the name and None."""
    plain, colon, state = name.rpartition(":") if isinstance(name, str) else ("", "", "")
    return (plain, state) if colon and not state.endswith(".toml") else (name, None)


def apply_product(tree: Tree, name: Any, source: str | Path) -> Tree:
    """A scene's tree with the product in its portion: shape, sizes, [material], the contact law
    that it needs and the ranges of its numbers are the product's; how many there are and how they
    lie stays. Raises SceneError.
    """
    own = extract_scene_sections(load_product(name, source), f"product {name}")
    if tree.get("piece"):
        raise SceneError(
            f"{source}: product = {name!r}: allowed in a scene with a portion, this one lists its pieces"
        )
    contact = tree.get("contact")
    if isinstance(contact, dict) and contact.get("law") in LAWS_OF_PRODUCTS:  # which the product
        # before it needed
        tree = tree | {
            "contact": {key: item for key, item in contact.items() if key not in KEYS_OF_LAWS}
        }
    kept = {
        key: item
        for key, item in (tree.get("portion") or {}).items()
        if key not in (*PRODUCT_KEYS, "product")
    }
    rows = [row for row in _get_ranges(tree, source) if not _is_material_row(row)]
    return overlay_scene(
        tree | {"portion": kept, "uncertain": rows},
        own | {"uncertain": [*rows, *own.get("uncertain", [])]},
    )


def _get_ranges(tree: Tree, source: str | Path) -> list[Any]:
    """Rows of [[uncertain]]. Raises SceneError."""
    rows = tree.get("uncertain") or []
    if not isinstance(rows, list | tuple):
        raise SceneError(
            f"{source}: uncertain = {shorten_value(rows)}: allowed: tables [[uncertain]]"
        )
    return list(rows)


def _is_material_row(row: Any) -> bool:
    """Whether a row of [[uncertain]] is about a number of [material]."""
    return isinstance(row, dict) and str(row.get("key")).startswith("material.")


def apply_bucket(tree: Tree, name: Any, source: str | Path) -> Tree:
    """A scene's tree with the sizes of both buckets and the drop height; whether and when they open
    stays but for the time that it takes. Raises SceneError.
    """
    own = _load_named(
        BUCKETS, "bucket", FORMER_NAMES.get(name, name) if isinstance(name, str) else name, source
    )
    if not all(tree.get(key) for key in BUCKET_SECTIONS):
        raise SceneError(
            f"{source}: bucket = {name!r}: allowed in a scene with [feed_bucket] and [weigh_bucket]"
        )
    return overlay_scene(tree, drop_overridden_keys(own, {"cycle": tree.get("cycle")}))


LIBRARY_KEYS = {"product": apply_product, "bucket": apply_bucket}  # of a scene, which the sections
# of a file come after


def apply_library_keys(below: Tree, own: Tree, source: str | Path) -> Tree:
    """A tree with what the keys of ``LIBRARY_KEYS`` in another name, which are taken out of that,
    as are names of products in a mixture. Raises SceneError.
    """
    for key, lay in LIBRARY_KEYS.items():
        if (name := own.pop(key, None)) is not None:
            below = lay(below, name, source)
    portion = own.get("portion")
    rows = portion.get("product") if isinstance(portion, dict) else None
    named = (
        [row for row in rows if isinstance(row, dict) and "product" in row]
        if isinstance(rows, list | tuple)
        else []
    )
    if portion and rows and named:
        own.update(_mix_products(own, rows, source))
    return below


def _mix_products(own_tree: Tree, rows: Sequence[Any], source: str | Path) -> Tree:
    """Sections of a scene whose portion has rows that may name products.

    The keys of products lie beneath those of their rows, [material] has theirs by name,
    [[uncertain]] the ranges of their numbers. Softening is one for all materials: the largest of
    the products', so that none is softer than its own file says. So is the contact law: the one
    that a product needs, unless the scene sets it.
    """
    portion, material, own_ranges = (
        own_tree["portion"],
        own_tree.get("material"),
        _get_ranges(own_tree, source),
    )
    filled, materials, softening, ranges, contact = [], {}, [], list[Tree](), Tree()
    for n, row in enumerate(rows):
        if not isinstance(row, dict) or "product" not in row:
            filled.append(row)
            continue
        name = row["product"]
        product = extract_scene_sections(
            load_product(name, source, f"portion.product.{n}.product"), f"product {name}"
        )
        name = name.replace(":", "-")
        contact |= product.get("contact", {})
        filled.append({"material": name} | _fill_row(row, product.get("portion", {})))
        if filled[-1]["material"] == name:
            of_product = product.get("material", {})
            softening += (
                [of_product["numerical_softening"]] if "numerical_softening" in of_product else []
            )
            materials[name] = {
                key: item for key, item in of_product.items() if key in NamedMaterial.model_fields
            }
            for known in product.get("uncertain", []):
                key = known["key"].removeprefix("material.")
                ranges += (
                    [known | {"key": f"material.{name}.{key}"}] if key in materials[name] else []
                )
    given = material if isinstance(material, dict) else {}
    whole = merge_tables(
        {**({"numerical_softening": max(softening)} if softening else {}), **materials}, given
    )
    ranges = drop_replaced_ranges({"uncertain": ranges}, {"material": given})["uncertain"]
    sections = {
        "portion": {**portion, "product": filled},
        "material": whole if material is None or given else material,
    }
    law = {"contact": merge_tables({"contact": contact}, own_tree)["contact"]} if contact else {}
    return {**sections, **law, "uncertain": [*ranges, *own_ranges]}


def _fill_row(row: Tree, portion: Tree) -> Tree:
    """A row of a mixture on top of the portion of the product that it names; a shape of its own
    replaces the product's.
    """
    own = {key: item for key, item in row.items() if key != "product"}
    if "shape" in own:
        portion = {
            key: item
            for key, item in portion.items()
            if key in ("material", "piece_weight", *SPREAD_KEYS)
        }
    if any(own.get(key) for key in SPREAD_KEYS):
        portion = {key: item for key, item in portion.items() if key not in SPREAD_KEYS}
    return portion | own


def _load_named(folder: Path, key: str, name: Any, source: str | Path) -> Tree:
    """What is in a library's file, or in a file of the user's. Raises SceneError."""
    if isinstance(name, str) and name.endswith(".toml"):
        return read_library_file(_resolve_beside(source, name), key, FILE_SECTIONS[folder])
    known = [path.stem for path in sorted(folder.glob("*.toml"))]
    if name not in known:
        allowed = f"{suggest_choices(str(name), known)}, or a file that ends in .toml"
        raise SceneError(f"{source}: {key} = {name!r}: no such {key.split('.')[-1]}; {allowed}")
    return tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))


def _resolve_beside(source: str | Path, name: str) -> Path:
    """A file that a scene names: beside the scene's own file, if there is such a one, else in the
    working folder.
    """
    beside = Path(source).parent / name
    return beside if Path(source).suffix == ".toml" and beside.is_file() else Path(name)


def read_library_file(path: Path, key: str, sections: Sequence[str]) -> Tree:
    """The tree of a product or a bucket in a TOML file; STL files in it are beside it.

    Args:
        path: of the file.
        key: of the scene that names it, for messages.
        sections: that it may have.

    Returns:
        Section -> keys.

    Raises:
        SceneError: it cannot be read, or has another section.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        reason = (
            error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
        ) or type(error).__name__
        raise SceneError(f"{key} = {str(path)!r}: cannot be read as TOML ({reason})") from error
    if is_too_deep(tree):
        raise SceneError(
            f"{key} = {str(path)!r}: tables and lists are nested too deep; allowed: {DEEPEST} in each other"
        )
    stray = [name for name in tree if name not in sections]
    if stray or not tree:
        found = f"it has {stray[0]!r}" if stray else "it is empty"
        raise SceneError(
            f"{key} = {str(path)!r}: {found}; allowed: {', '.join(f'[{name}]' for name in sections)}"
        )
    tree = accept_tables(tree, str(path))
    return {name: _resolve_stl_paths(item, path.resolve().parent) for name, item in tree.items()}


def _resolve_stl_paths(item: Any, folder: Path, key: str = "") -> Any:
    """A tree with its STL files from the root; folder: where they are."""
    if isinstance(item, dict):
        return {name: _resolve_stl_paths(below, folder, name) for name, below in item.items()}
    if isinstance(item, list):
        return [_resolve_stl_paths(below, folder, key) for below in item]
    return str(folder / item) if key in ("stl", "flap_stl") and isinstance(item, str) else item
