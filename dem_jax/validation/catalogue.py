"""All problems, by family."""

from collections.abc import Callable, Iterable
from functools import partial

from dem_jax.validation import (
    chung_ooi,
    classics,
    measured_impacts,
    pouring,
    sphere_row,
    squeeze,
    statics,
)
from dem_jax.validation.problem import Problem

FAMILIES: dict[str, Callable[[], Iterable[Problem]]] = {
    "single pieces": lambda: [
        classics.landing_problem(),
        classics.corner_problem(),
        classics.spinning_problem(),
        classics.turning_problem(),
    ],
    **{f"Chung and Ooi, {law}": partial(chung_ooi.build_problems, law) for law in chung_ooi.LAWS},
    "rest": lambda: [
        statics.tower_problem(),
        statics.groove_problem("sphere"),
        statics.groove_problem("cuboid"),
    ],
    "rows": lambda: [sphere_row.cradle_problem()],
    "walls that close": lambda: [squeeze.jaws_problem(), squeeze.flaps_problem()],
    "measured impacts": lambda: [
        measured_impacts.potato_problem(),
        measured_impacts.tablet_problem(),
        *map(measured_impacts.fruit_problem, ("walton-braun", "hertz-mindlin")),
    ],
    "packings": lambda: [pouring.pouring_problem(4, 8), pouring.pouring_problem(7, 4, 1.2)],
}


def list_problems(families: Iterable[str] = FAMILIES) -> list[Problem]:
    """The problems of these families."""
    return [problem for family in families for problem in FAMILIES[family]()]
