"""Ensembles whose runs have different numbers of the product, drawn from the ranges within which
they are known.
"""

from typing import Any

from dem_jax.assembly.piece_arrays import count_portion_pieces, make_portion_shapes
from dem_jax.scene import Scene
from dem_jax.scene.ranges import draw_values, select_uncertain_rows


def draw_uncertain_numbers(
    scene: Scene, runs: int, seed: int, given: dict[str, Any]
) -> tuple[Scene, dict[str, list[Any]]]:
    """The scene with the portions of ``hold_portion``, and values of its uncertain numbers for each
    run.

    Args:
        scene: with ``[[uncertain]]``.
        runs: number of runs.
        seed: of the draws.
        given: key -> values for each run, which are not drawn.

    Raises:
        SceneError: the scene has no uncertain number beside those given.
    """
    rows = select_uncertain_rows(scene, tuple(given))
    return hold_portion(scene), given | draw_values(rows, runs, seed)


def hold_portion(scene: Scene) -> Scene:
    """The scene with what stays of its portion if densities differ: the weight of a portion of one
    product, which then has more or fewer pieces, and else the number of pieces of each product.

    Raises SceneError.
    """
    portion = scene.portion
    if portion is None or not (portion.product or scene.inlet or scene.outlet):
        return scene
    counts = count_portion_pieces(scene, portion, make_portion_shapes(scene))[0]
    changes: dict[str, Any] = {"portion.count": sum(counts)}
    if portion.product:
        changes["portion.share_by"] = "count"
        changes |= {f"portion.product.{n}.share": float(count) for n, count in enumerate(counts)}
    return scene.replace(changes)
