"""Keys of a scene that cannot act beside another key, or without one: which they are, and what
overrides them.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple

from pydantic import BaseModel

from dem_jax.errors import SceneError
from dem_jax.scene.toml_text import format_value

Tree = dict[str, Any]
BUCKETS = ("weigh_bucket", "feed_bucket")
SIZE_KEYS = ("opening_size", "wall_height", "flap_angle_deg", "panel_overlap")  # of a bucket
# of its flaps
FLAP_TIME_KEYS = ("opening_start", "opening_time", "hold_time", "closing_time", "period")
PAN_KEYS = ("length", "width", "wall_height")
VIBRATION_KEYS = ("start", "duration", "period")


class Override(NamedTuple):
    """Keys that cannot act where another one has some value.

    by, keys: dotted, of a scene. holds: whether a value of ``by`` overrides. why: in words, to
    follow "cannot act".
    """

    overriding_key: str
    keys: tuple[str, ...]
    holds: Callable[[Any], bool]
    why: str


def _is_absent(item: Any) -> bool:
    return item is None


def _prefix_keys(section: str, names: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"{section}.{name}" for name in names)


def _size_overrides(section: str, sizes: tuple[str, ...]) -> list[Override]:
    """What overrides the sizes of a bucket or a feeder."""
    return [
        Override(f"{section}.{by}", sizes, bool, f"beside {section}.{by}, which has its own sizes")
        for by in ("stl", "panels")
    ]


def _bucket_overrides(section: str) -> list[Override]:
    """What overrides keys of a bucket."""
    sizes, times = _prefix_keys(section, SIZE_KEYS), _prefix_keys(section, FLAP_TIME_KEYS)
    return [
        *_size_overrides(section, sizes),
        Override(
            f"{section}.opening_angle_deg",
            times,
            lambda a: a == 0,
            f"beside {section}.opening_angle_deg = 0: it stays shut",
        ),
        Override("cycle", times, bool, "beside [cycle], which says when buckets open"),
        Override(section, ("drop.height",), _is_absent, f"without [{section}]"),
    ]


OVERRIDES = (
    *(row for section in BUCKETS for row in _bucket_overrides(section)),
    *_size_overrides("feeder", _prefix_keys("feeder", PAN_KEYS)),
    Override(
        "cycle.lf",
        _prefix_keys("feeder", VIBRATION_KEYS),
        bool,
        "beside cycle.lf, which says when the feeder vibrates",
    ),
    Override("piece", ("portion",), bool, "beside [[piece]]: these are all pieces"),
    Override("portion.count", ("portion.target_weight",), bool, "beside portion.count"),
    Override(
        "portion.arrangement",
        ("portion.settling_time",),
        lambda name: name == "scattered",
        'beside portion.arrangement = "scattered"',
    ),
    Override(
        "portion.product",
        ("portion.share_by",),
        lambda rows: rows == (),
        "without [[portion.product]]",
    ),
    Override(
        "run.until_settled",
        ("run.settled_time",),
        lambda ends: ends is False,
        "without run.until_settled = true",
    ),
)
# Of two keys that say the same thing in two ways, that of the scene on top holds: the one below is
# dropped.
ALTERNATIVES = (
    Override("portion.target_weight", ("portion.count",), bool, "beside portion.target_weight"),
    Override(
        "portion.size_spread", ("portion.piece_weight_spread",), bool, "beside portion.size_spread"
    ),
    Override(
        "portion.piece_weight_spread",
        ("portion.size_spread",),
        bool,
        "beside portion.piece_weight_spread",
    ),
)


def drop_overridden_keys(below: Tree, above: Tree) -> Tree:
    """The tree below without the keys that those of the tree on top leave without effect."""
    for row in (*OVERRIDES, *ALTERNATIVES):
        item, said = _find_value(above, row.overriding_key)
        if said and row.holds(item):
            for key in row.keys:
                below = below if _find_value(above, key)[1] else _drop_key(below, key.split("."))
    return below


def drop_inactive_keys(tree: Tree) -> Tree:
    """The tree of a whole scene, such as an earlier version stored, without the keys that cannot
    act.
    """
    for row in OVERRIDES:
        item, said = _find_value(tree, row.overriding_key)
        if said and row.holds(item):
            for key in row.keys:
                tree = _drop_key(tree, key.split("."))
    return tree


def find_inactive_keys(scene: BaseModel, keys: Iterable[str] | None = None) -> Iterator[str]:
    """What is wrong, in words, of each key that cannot act; keys: of these, else of all that are
    not at their defaults.
    """
    given = None if keys is None else set(keys)
    replaced = {
        key for row in ALTERNATIVES if given and row.overriding_key in given for key in row.keys
    } - (given or set())
    for row in OVERRIDES:
        concerned = [
            key for key in row.keys if given is None or any(_is_within(own, key) for own in given)
        ]
        if (
            not concerned
            or row.overriding_key in replaced
            or not row.holds(_find_value(scene, row.overriding_key)[0])
        ):
            continue
        for key in concerned:
            item, said = _find_value(scene, key)
            is_set = given is not None or said and item != _default_value(scene, key)
            if item is not None and is_set:
                shown = "" if isinstance(item, BaseModel) else f" = {format_value(item)}"
                yield f"{key}{shown}: cannot act {row.why}; allowed: to leave it out"


def check_varied_keys(scene: BaseModel, keys: Iterable[str], source: str) -> None:
    """Raise SceneError for a key that is to vary and cannot act in a scene; source: begins the
    message.
    """
    for wrong in find_inactive_keys(scene, keys):
        raise SceneError(f"{source}: {wrong}")


def _find_value(tree: Any, key: str) -> tuple[Any, bool]:
    """The value of a dotted key in a tree or a scene, and whether there is that key."""
    for part in _split_key(key):
        below = tree.__dict__ if isinstance(tree, BaseModel) else tree  # of a section: its fields
        if not isinstance(below, dict) or part not in below:
            return None, False
        tree = below[part]
    return tree, True


@lru_cache(1024)
def _split_key(key: str) -> tuple[str, ...]:
    return tuple(key.split("."))


def _is_within(key: str, section: str) -> bool:
    """Whether a dotted key is another one, or in it."""
    return key == section or key.startswith(f"{section}.")


def nest_keys(changes: Tree) -> Tree:
    """The tree of dotted keys; of several in one table all, of one within a value of another the
    last.
    """
    tree: Tree = {}
    for key, item in changes.items():
        table, *below = key.split(".")
        if below:
            own = tree[table] if isinstance(tree.get(table), dict) else {}
            tree[table] = own | nest_keys({".".join(below): item})
        else:
            tree[table] = item
    return tree


def _default_value(scene: BaseModel, key: str) -> Any:
    """The default of a dotted key."""
    section, _, name = key.rpartition(".")
    owner = _find_value(scene, section)[0] if section else scene
    return type(owner).model_fields[name].default


def _drop_key(tree: Any, keys: list[str]) -> Any:
    """The tree without a key, copied where it changes."""
    if not isinstance(tree, dict) or keys[0] not in tree:
        return tree
    if len(keys) == 1:
        return {name: item for name, item in tree.items() if name != keys[0]}
    return tree | {keys[0]: _drop_key(tree[keys[0]], keys[1:])}
