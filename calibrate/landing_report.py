"""The fit of the extended model as text."""

from typing import TYPE_CHECKING

from product_model.extended import ADDITIONS

if TYPE_CHECKING:
    from calibrate.landing_fit import LandingFit

UNITS = {"s": ("us", 1e6), "m": ("mm", 1e3), "1": ("", 1.0)}
LENGTHS = ("gamma_low", "gamma_high", "h_mean")


def report_landings(result: "LandingFit") -> str:
    """Report of a fit: parameters with 90 % intervals, the judgement of each model by traces kept
    out, and the differences.
    """
    units = (
        {"dt_impact": "s"} | dict.fromkeys(LENGTHS, "m") | {row.name: row.unit for row in ADDITIONS}
    )
    lines = [f"model: {result.model}", "parameter               value         90 % interval"]
    for name, row in result.parameters.items():
        unit, factor = UNITS[units[name]]
        value, low, high = (f"{factor * row[key]:.4g}" for key in ("value", "low", "high"))
        kept = "" if row["free"] else "   not in this model"
        lines.append(f"{name:<16}{value:>13} {unit:<3}{low:>9} ... {high:<9}{kept}".rstrip())
    return "\n".join([*lines, *(f"- {line}" for line in result.statements)])
