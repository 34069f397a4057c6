"""All problems, by family."""

from collections.abc import Callable, Iterable

from dem_jax.validation import chain, chung_ooi, classics, measured_impacts, poured, squeeze, statics
from dem_jax.validation.problem import Problem

FAMILIES: dict[str, Callable[[], Iterable[Problem]]] = {
    "single pieces": lambda: [classics.landing(), classics.corner(), classics.spinning(), classics.turning()],
    **{f"Chung and Ooi, {law}": lambda law=law: chung_ooi.problems(law) for law in chung_ooi.LAWS},  # type: ignore[misc]
    "rest": lambda: [statics.tower(), statics.groove("sphere"), statics.groove("cuboid")],
    "rows": lambda: [chain.cradle()],
    "walls that close": lambda: [squeeze.jaws(), squeeze.flaps()],
    "measured impacts": lambda: [
        measured_impacts.potato(), measured_impacts.tablet(), *map(measured_impacts.fruit, ("walton-braun", "hertz-mindlin")),
    ],
    "packings": lambda: [poured.poured(4, 8), poured.poured(7, 4, 1.2)],
}


def problems(families: Iterable[str] = FAMILIES) -> list[Problem]:
    """Of these families."""
    return [problem for family in families for problem in FAMILIES[family]()]
