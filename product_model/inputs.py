"""The inputs of the Product Model (Fig. 7), their defaults with the source of each, and their
validation.
"""

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Annotated, Any, Literal

import jax
import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from product_model.errors import BadInput
from product_model.extended import ADDITIONS, Landings, check_landings, latest_end
from product_model.grid import Grid, grid_over
from product_model.model import GRAVITY, number_of_pieces

FORMS = ("rectangular", "interval-mean", "smooth")
DTYPES: dict[str, type[np.floating]] = {"f32": np.float32, "f64": np.float64}

_static = partial(field, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Parameters:
    """All inputs of the model. Leaves can be traced, mapped and differentiated; the other fields
    are static.

    Leaves, each a float or [] array: h_mean, gamma_low, gamma_high, dt_impact, m_piece, gravity.
    Units and sources of the defaults: `INPUTS`. `landings` None: the paper's model, else the
    additions of the extended one. `pieces` None: eq. 16 from m_target; `duration` None: until all
    but one in 10^4 pieces have landed in a portion that spreads like gamma_high.
    """

    h_mean: float | jax.Array = 0.25
    gamma_low: float | jax.Array = 0.02
    gamma_high: float | jax.Array = 0.06
    dt_impact: float | jax.Array = 500e-6
    m_piece: float | jax.Array = 5.832e-3
    gravity: float | jax.Array = GRAVITY
    landings: Landings | None = None
    m_target: float = _static(default=0.05)
    pieces: int | None = _static(default=None)
    sample: float = _static(default=30e-6)
    start: float = _static(default=0.0)
    duration: float | None = _static(default=None)
    form: str = _static(default="interval-mean")
    smooth_width: float = _static(default=50e-6)
    precision: str = _static(default="f64")

    def replace(self, **changes: Any) -> "Parameters":
        """A copy with `changes`."""
        return replace(self, **changes)


LEAVES = tuple(
    f.name for f in fields(Parameters) if not f.metadata.get("static") and f.name != "landings"
)


@dataclass(frozen=True)
class Input:
    """One row of the table of inputs: name in Python, symbol and unit, meaning, source of the
    default.
    """

    name: str
    symbol: str
    unit: str
    meaning: str
    source: str


INPUTS = (
    Input(
        "m_target", "m_target", "kg", "target weight of the portion", "paper, section 4.1 (50 g)"
    ),
    Input(
        "m_piece", "m_p", "kg", "weight of one piece", "paper, section 4 (marshmallow at SF = 1)"
    ),
    Input("pieces", "n", "1", "number of pieces", "eq. 16, rounded, unless given"),
    Input("dt_impact", "Δt_impact", "s", "length of the pulse of one piece", "paper, section 4.3"),
    Input("sample", "Δt_sample", "s", "sample time", "paper, section 4.2"),
    Input(
        "h_mean",
        "h_mean",
        "m",
        "mean drop height",
        "assumed; the paper's force levels fit 0.2-0.3 m",
    ),
    Input("gamma_low", "γ_limit,low", "m", "lower limit of σ_height", "assumed; not in the paper"),
    Input(
        "gamma_high",
        "γ_limit,high",
        "m",
        "upper (three-sigma) limit of σ_height",
        "assumed; not in the paper",
    ),
    Input("gravity", "g", "m/s²", "acceleration due to gravity", "paper, section 3.1"),
    Input("start", "", "s", "beginning of the trace after release", "chosen: the release"),
    Input("duration", "", "s", "length of the trace", "chosen: until the pieces have landed"),
    Input(
        "form",
        "",
        "",
        "rectangular, interval-mean or smooth",
        "chosen: means over Δt_sample, exact for every Δt_impact",
    ),
    Input(
        "smooth_width",
        "τ",
        "s",
        "width of the smooth form's Gaussian",
        "chosen: a tenth of the default Δt_impact",
    ),
    Input("precision", "", "", "f32 or f64", "chosen"),
)

OUTPUTS = (
    Input("time", "t", "s", "sample times after release", "grid"),
    Input("force", "F", "N", "total impact force", "eq. 15"),
    Input("pif_kg, pif_g", "PIF", "kg, g", "product impact force as a weight", "eq. 24"),
    Input("settled_mass", "Σ F_static/g", "kg", "mass whose pulse is over", "Fig. 6"),
)


MOST_SEED = 2**31 - 1


def checked_seed(seed: Any, most: int = MOST_SEED) -> int:
    """The seed as a plain number. Raises `BadInput` unless it is a whole number from 0 to the
    largest allowed.
    """
    is_whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not is_whole or not 0 <= seed <= most:
        raise BadInput(f"seed = {seed!r}: must be a whole number from 0 to {most}")
    return int(seed)


def _finite_or_none(value: float | None) -> float | None:
    if value is not None and not np.isfinite(value):
        raise ValueError("must be finite")
    return value


_Positive = Annotated[float, Field(gt=0), AfterValidator(_finite_or_none)]
_Natural = Annotated[int, Field(ge=1)]
_NonNegative = Annotated[float, Field(ge=0), AfterValidator(_finite_or_none)]


class _Checked(BaseModel):
    model_config = ConfigDict(extra="forbid")
    h_mean: _Positive
    gamma_low: _NonNegative
    gamma_high: _NonNegative
    dt_impact: _Positive
    m_piece: _Positive
    gravity: _Positive
    m_target: _Positive
    pieces: _Natural | None
    sample: _Positive
    start: float
    duration: _Positive | None
    form: Literal["rectangular", "interval-mean", "smooth"]
    smooth_width: _Positive
    precision: Literal["f32", "f64"]

    @model_validator(mode="after")
    def _ordered(self) -> "_Checked":
        if self.gamma_high < self.gamma_low:
            raise ValueError(
                f"gamma_high = {self.gamma_high:g} m: must be at least gamma_low = {self.gamma_low:g} m"
            )
        if self.pieces is None and self.m_target / self.m_piece > 1e7:
            raise ValueError(
                f"m_target = {self.m_target:g} kg: more than 10^7 pieces of m_piece = {self.m_piece:g} kg"
            )
        return self


def one_line(error: ValidationError) -> str:
    """The first error of `error` as one line: name = value: allowed values."""
    first = error.errors()[0]
    message = first["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if not first["loc"]:
        return message
    name = str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        return f"{name}: unknown; known are {', '.join(_Checked.model_fields)}"
    unit = next((row.unit for row in INPUTS if row.name == name and row.unit not in ("", "1")), "")
    return f"{name} = {first['input']}: {message}" + (f" ({unit})" if unit else "")


def check(params: Parameters) -> Parameters:
    """`params`, or `BadInput` with one line. Traced leaves have no value yet and are not checked."""
    values = {f.name: getattr(params, f.name) for f in fields(params) if f.name != "landings"}
    if params.landings is not None:
        check_landings(params.landings)
    traced = {name for name in LEAVES if isinstance(values[name], jax.core.Tracer)}
    if traced:
        known = {name: value for name, value in values.items() if name not in traced}
        values = {name: getattr(Parameters, name) for name in values} | known
        values["gamma_high"] = max(values["gamma_low"], values["gamma_high"])
    try:
        _Checked(**{name: _plain(value) for name, value in values.items()})
    except ValidationError as error:
        raise BadInput(one_line(error)) from None
    return params


def parameters(**values: Any) -> Parameters:
    """Checked `Parameters` from keywords; raises `BadInput` (unknown name, wrong type or range)."""
    unknown = sorted(set(values) - {f.name for f in fields(Parameters)})
    if unknown:
        raise BadInput(
            f"{unknown[0]}: unknown; known are {', '.join(f.name for f in fields(Parameters))}"
        )
    return check(Parameters(**values))


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") and getattr(value, "ndim", 1) == 0 else value


def count_pieces(params: Parameters) -> int:
    """Number of pieces n: as given, else eq. 16. Under jit, grad or vmap over m_piece it must be
    given.
    """
    if params.pieces is not None:
        return params.pieces
    if isinstance(params.m_piece, jax.core.Tracer):
        raise BadInput(
            "pieces: must be given where m_piece is traced (eq. 16 fixes the shape of the arrays)"
        )
    return number_of_pieces(params.m_target, float(params.m_piece))


def build_grid(params: Parameters) -> Grid:
    """The sample times. Under jit, grad or vmap over the drop heights the duration must be given."""
    if params.duration is not None:
        return grid_over(params.start, params.duration, params.sample)
    leaves = (params.h_mean, params.gamma_high, params.dt_impact, params.gravity)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        raise BadInput(
            "duration: must be given where h_mean, gamma_high, dt_impact or gravity is traced"
        )
    h_mean, gamma_high, dt_impact, gravity = (float(leaf) for leaf in leaves)
    fall = (2.0 * (h_mean + 4.0 * gamma_high) / gravity) ** 0.5
    last = fall + dt_impact
    if params.landings is not None:
        last = latest_end(_known(params.landings), fall, dt_impact, gravity)
    return grid_over(params.start, max(last + 0.01 - params.start, params.sample), params.sample)


def _known(landings: Landings) -> dict[str, float]:
    """The numbers of `landings`; raises `BadInput` where one is traced."""
    if any(isinstance(value, jax.core.Tracer) for value in landings.values().values()):
        raise BadInput("duration: must be given where landings are traced")
    return {name: float(value) for name, value in landings.values().items()}


def table() -> str:
    """Inputs and outputs of the model as in Fig. 7, with the default of each input and its source:
    a Markdown table.
    """
    defaults = {f.name: f.default for f in fields(Parameters)}
    rows = [
        "| input | symbol | unit | default | meaning | source of the default |",
        "|---|---|---|---|---|---|",
    ]
    for row in INPUTS:
        default = "" if defaults[row.name] is None else str(defaults[row.name])
        rows.append(
            f"| {row.name} | {row.symbol} | {row.unit} | {default} | {row.meaning} | {row.source} |"
        )
    rows += [
        "",
        "| addition of the extended model | unit | default | range | meaning |",
        "|---|---|---|---|---|",
    ]
    for added in ADDITIONS:
        default, allowed = getattr(Landings, added.name), f"{added.low:g} to {added.high:g}"
        rows.append(f"| {added.name} | {added.unit} | {default:g} | {allowed} | {added.meaning} |")
    rows += ["", "| output | symbol | unit | meaning | source |", "|---|---|---|---|---|"]
    rows += [
        f"| {row.name} | {row.symbol} | {row.unit} | {row.meaning} | {row.source} |"
        for row in OUTPUTS
    ]
    return "\n".join(rows)
