"""The extended model of a product that was never simulated: parameters as smooth functions of the
drop.

Each parameter has a coordinate u (`coordinates`), and

    u = u_stock + scaling of the physics + sum_k b_k x_k

The physics scales lengths with the piece, lengths of pulses with the time of contact sqrt(m / (E
L)), times between impacts with L over the speed of impact, and the release with the opening time of
the flaps. x_k are logarithms of dimensionless conditions of the drop, their products, and
restitution and friction; the b_k are learnt from ensembles of simulated drops
(`calibrate.transfer_fit`) and shipped as a table with a version.

The drop height h_mean follows from the momentum of the portion, which scatters by one or two
percent only and is the most certain number of a drop: pieces that start at rest bring the momentum
of a free fall of the drop height, shortened by the time for which the opening flaps still bear
them. The logarithm of this lost time over the opening time is a polynomial of the second degree in
the conditions of the feed bucket, and h_mean is the height from which the model's portions bring
it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from product_model.coordinates import NAMES, to_coordinates, to_parameter, to_values
from product_model.errors import BadInput
from product_model.extended import ADDED, Landings, choose_impacts, release_times
from product_model.fall import drop_heights, sigma_height
from product_model.fitted import NINETY, Fitted

TABLE = Path(__file__).parent / "transfer.json"
FORMAT = 1  # of the table
SCALED = tuple(name for name in NAMES if name != "h_mean")  # learnt as coordinates
WIDEST = 1.0  # standard deviation in coordinates: no interval reaches beyond a factor of 5.2 to
# either side
PORTIONS = 256  # whose mean momentum decides the drop height
MOST_LOST = 0.7  # share of the fall that the opening flaps may take, far beyond the design's
ROUNDING = 1e-5  # of the ends of conditions in a table
STEPS = 8  # of the solution for it; each leaves less than a tenth of the error


@dataclass(frozen=True)
class DropConditions:
    """Conditions of the fall of a portion from a feed bucket into a weigh bucket, SI.

    m_piece: (kg) mean weight of a piece
    pieces: number of pieces
    density: (kg/m3) of the pieces
    modulus: (Pa) Young's modulus of the pieces as it is used, softening included
    restitution, friction_wall: of pieces on the bucket
    friction_piece: of pieces on each other
    elongation: diameter of the smallest sphere around a piece over that of a sphere of its volume,
    1 for a sphere
    drop_height: (m) between the flaps of both buckets
    opening_time: (s) of the flaps of the feed bucket
    gravity: (m/s2)
    """

    m_piece: float
    pieces: int
    density: float
    modulus: float
    restitution: float
    friction_wall: float
    friction_piece: float
    elongation: float
    drop_height: float
    opening_time: float
    gravity: float = 9.81

    @property
    def length(self) -> float:
        """(m) cube root of the volume of a piece."""
        return float((self.m_piece / self.density) ** (1.0 / 3.0))

    @property
    def contact_time(self) -> float:
        """(s) sqrt(m / (E L)), to which the time of contact of a piece with a linear spring is
        proportional.
        """
        return float(np.sqrt(self.m_piece / (self.modulus * self.length)))

    @property
    def fall_time(self) -> float:
        """(s) of a free fall from rest through the drop height."""
        return float(np.sqrt(2.0 * self.drop_height / self.gravity))

    @property
    def speed(self) -> float:
        """(m/s) of the impact after it."""
        return self.gravity * self.fall_time


STOCK = DropConditions(5.832e-3, 9, 300.0, 1e6, 0.1, 0.3, 0.7, 1.76, 0.31, 0.16)
STOCK_VALUES = Landings().values() | {
    "dt_impact": 690e-6,
    "gamma_low": 5e-3,
    "gamma_high": 18e-3,
    "h_mean": 0.31,
    "pulse_exponent": 1.0,
}


def scale_parameters(drop: DropConditions) -> dict[str, float]:
    """Coordinates of the parameters of the stock scene, scaled to `drop` by the physics alone;
    h_mean becomes the drop height.
    """
    length = drop.length / STOCK.length
    contact = drop.contact_time / STOCK.contact_time
    passing = length * STOCK.speed / drop.speed
    factors = {
        **dict.fromkeys(("dt_impact", "late_duration"), contact),
        **dict.fromkeys(("gamma_low", "gamma_high", "slump_depth"), length),
        "impact_delay": passing,
        "release_time": drop.opening_time / STOCK.opening_time,
        "h_mean": drop.drop_height / STOCK.drop_height,
    }
    values = {name: factors.get(name, 1.0) * STOCK_VALUES[name] for name in NAMES}
    with jax.enable_x64(True):
        return {name: float(u) for name, u in to_coordinates(values).items()}


def measure_conditions(drop: DropConditions) -> dict[str, float]:
    """Name -> dimensionless condition of a drop: 0 for the stock scene, where it is a logarithm."""
    return {
        "pieces": float(np.log(drop.pieces / STOCK.pieces)),
        "length": float(np.log(drop.length / STOCK.length)),
        "contact time": float(np.log(drop.contact_time / STOCK.contact_time)),
        "drop height": float(np.log(drop.drop_height / STOCK.drop_height)),
        "opening time": float(np.log(drop.opening_time / STOCK.opening_time)),
        "elongation": float(np.log(drop.elongation / STOCK.elongation)),
        "restitution": drop.restitution,
        "friction on the bucket": drop.friction_wall,
        "friction between pieces": drop.friction_piece,
    }


SHOWN = {  # condition -> of a value of it, in the units of a scene
    "pieces": lambda x: f"{STOCK.pieces * np.exp(x):.3g} pieces",
    "length": lambda x: f"{1e3 * STOCK.length * np.exp(x):.3g} mm",
    "contact time": lambda x: f"{1e3 * STOCK.contact_time * np.exp(x):.3g} ms",
    "drop height": lambda x: f"{1e3 * STOCK.drop_height * np.exp(x):.3g} mm",
    "opening time": lambda x: f"{1e3 * STOCK.opening_time * np.exp(x):.3g} ms",
    "elongation": lambda x: f"{STOCK.elongation * np.exp(x):.3g}",
}


@dataclass(frozen=True)
class Coefficients:
    """Coefficients of the terms.

    scaled: name of SCALED -> [1 + terms]. lost_time: [1 + lost_terms] for the logarithm of the lost
    time.
    """

    scaled: dict[str, list[float]]
    lost_time: list[float]


@dataclass(frozen=True)
class TransferTable:
    """Learnt transfer from conditions to parameters.

    version: of the table
    conditions: name -> [centre, width, least, greatest] of each in the design
    terms, lost_terms: names of conditions, or two of them joined by " x "
    coefficients: of the terms
    groups: coefficients learnt without a group of ensembles each (jackknife)
    lost_error: standard deviation of the logarithm of the lost time of ensembles that were left out
    errors: name of an output -> {"median", "nine_tenths"} of its relative error for products
    outside the training set
    """

    version: str
    conditions: dict[str, list[float]]
    terms: list[str]
    lost_terms: list[str]
    coefficients: Coefficients
    groups: list[Coefficients] = field(default_factory=list)
    lost_error: float = 0.0
    errors: dict[str, dict[str, float]] = field(default_factory=dict)

    def row(self, drop: DropConditions, terms: Sequence[str]) -> np.ndarray:
        """[1 + terms] factors of the coefficients."""
        found = measure_conditions(drop)
        centred = {
            name: (found[name] - centre) / width
            for name, (centre, width, *_) in self.conditions.items()
        }
        return np.array(
            [1.0, *(np.prod([centred[part] for part in t.split(" x ")]) for t in terms)]
        )

    def outside(self, drop: DropConditions) -> list[str]:
        """Conditions of `drop` outside the range of the training set, in words."""
        lines = []
        for name, value in measure_conditions(drop).items():
            low, high = self.conditions[name][2:]
            if not low - ROUNDING <= value <= high + ROUNDING:
                shown = SHOWN.get(name, lambda x: f"{x:.3g}")
                lines.append(f"{name} = {shown(value)}: learnt from {shown(low)} to {shown(high)}")
        return lines

    def lost_time(self, drop: DropConditions, of: Coefficients, shift: float = 0.0) -> float:
        """Time (s) by which the opening flaps shorten the fall of a portion. shift: of its
        logarithm.
        """
        logarithm = float(self.row(drop, self.lost_terms) @ np.asarray(of.lost_time)) + shift
        return float(min(drop.opening_time * np.exp(logarithm), MOST_LOST * drop.fall_time))

    def coordinates(
        self, drop: DropConditions, of: Coefficients, shift: float = 0.0
    ) -> dict[str, float]:
        """Coordinates of the parameters at coefficients. shift: of the logarithm of the lost time."""
        row, start = self.row(drop, self.terms), scale_parameters(drop)
        u = start | {
            name: start[name] + float(row @ np.asarray(of.scaled[name])) for name in SCALED
        }
        with jax.enable_x64(True):
            values = to_values({name: jnp.asarray(x, jnp.float64) for name, x in u.items()})
            random = np.random.default_rng(13)
            shape = (PORTIONS, drop.pieces)
            normal, v, release = (
                random.standard_normal(PORTIONS),
                random.uniform(-1, 1, shape),
                random.standard_normal(shape),
            )
            fall = drop.fall_time - self.lost_time(drop, of, shift)
            height = solve_height(values, fall, drop.gravity, normal, v, release)
            return u | {"h_mean": float(np.log(height))}


@partial(jax.jit, static_argnames=("gravity",))
def solve_height(
    values: Mapping[str, Any], fall_time: Any, gravity: float, normal: Any, v: Any, release: Any
) -> jax.Array:
    """The mean drop height (m) at which the mean momentum of portions is that of a fall from rest
    for a given time.

    A piece that is released at r gives g (T - r - dt_impact) times its mass until a time T at which
    it is at rest (`extended`), so that the portion brings g (first impact - mean r - dt_impact)
    beyond its weight after the first impact.

    Args:
        values: parameters; h_mean is where the solution begins.
        fall_time: (s)
        gravity: (m/s2)
        normal, v, release: [portions], [portions, pieces], [portions, pieces] random numbers of the
            portions: normal, uniform on (-1, 1), normal.
    """
    extended = Landings(**{name: values[name] for name in ADDED})
    sigma = sigma_height(values["gamma_low"], values["gamma_high"], normal)
    released = jax.vmap(lambda z: release_times(extended, z)[0])(release)

    def brought(height: jax.Array) -> jax.Array:
        heights = jax.vmap(lambda s, row: drop_heights(height, s, row)[0])(sigma, v)
        first = jnp.min(released + jnp.sqrt(2.0 * heights / gravity), axis=1)
        return jnp.mean(first - jnp.mean(released, axis=1)) - values["dt_impact"]

    def better(_: int, height: jax.Array) -> jax.Array:
        fall = jnp.sqrt(2.0 * height / gravity) + fall_time - brought(height)
        return 0.5 * gravity * jnp.maximum(fall, 0.05 * fall_time) ** 2

    return jax.lax.fori_loop(0, STEPS, better, jnp.asarray(values["h_mean"]))


@cache
def shipped_table() -> TransferTable:
    """The table of this version of the package."""
    return read_table(TABLE)


def read_table(path: str | Path) -> TransferTable:
    """The table of a file. Raises `BadInput`."""
    try:
        tree = json.loads(Path(path).read_text(encoding="utf-8"))
        if tree.pop("format") != FORMAT:
            raise ValueError(f"of another format than {FORMAT}")
        of = [Coefficients(**each) for each in (tree.pop("coefficients"), *tree.pop("groups"))]
        return TransferTable(**tree, coefficients=of[0], groups=of[1:])
    except OSError as error:
        raise BadInput(f"table = {path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise BadInput(f"table = {path}: not a table of transfer ({error})") from None


def write_table(path: str | Path, table: TransferTable) -> None:
    """Write a table, one line for each of its rows."""
    tree = {"format": FORMAT} | asdict(table)
    Path(path).write_text(_format_tree(tree) + "\n", encoding="utf-8")


def _format_tree(tree: Any, indent: str = "") -> str:
    """JSON text with one line for each list of numbers or words, numbers in six digits."""
    if isinstance(tree, dict) and tree:
        rows = [
            f"{indent} {json.dumps(key)}: {_format_tree(value, indent + ' ')}"
            for key, value in tree.items()
        ]
        return "{\n" + ",\n".join(rows) + f"\n{indent}}}"
    if isinstance(tree, list) and tree and isinstance(tree[0], dict):
        return "[" + ", ".join(_format_tree(value, indent + " ") for value in tree) + "]"
    if isinstance(tree, list):
        return "[" + ", ".join(_format_tree(value) for value in tree) + "]"
    return f"{tree:.6g}" if isinstance(tree, float) else json.dumps(tree)


def predict_parameters(drop: DropConditions, table: TransferTable | None = None) -> Fitted:
    """The parameters of the extended model for a drop, with intervals.

    Args:
        drop: its conditions.
        table: the learnt table. Default: the one of this package.

    Returns:
        Values, and 90 % intervals: from the uncertainty of the learnt coefficients (jackknife over
        groups of ensembles), for h_mean also from the error of the polynomial for the lost time of
        other ensembles, at most a factor of 5.2 to either side. For a drop outside of the design
        (`TransferTable.outside`) they are extrapolated.
    """
    table = table or shipped_table()
    u = table.coordinates(drop, table.coefficients)
    sd = _uncertainty(u, [table.coordinates(drop, of) for of in table.groups])
    later = table.coordinates(drop, table.coefficients, table.lost_error)
    sd["h_mean"] = float(np.hypot(sd["h_mean"], later["h_mean"] - u["h_mean"]))
    with jax.enable_x64(True):
        values = {name: float(value) for name, value in to_values(u).items()}
        sides = [
            {name: float(to_parameter(name, u[name] + k * sd[name])) for name in NAMES}
            for k in (-NINETY, NINETY)
        ]
    for side in sides:
        side["gamma_high"] += values["gamma_low"]
    low, high = sides
    values |= {name: min(max(values[name], low[name]), high[name]) for name in NAMES}  # rounding
    impacts = choose_impacts(drop.pieces)
    return Fitted(
        value=values,
        low=low,
        high=high,
        m_piece=drop.m_piece,
        pieces=drop.pieces,
        landings=Landings(impacts=impacts).replace(**{name: values[name] for name in ADDED}),
    )


ERROR_WORDS = {
    "peak_1ms": "peak of 1 ms",
    "peak_10ms": "peak of 10 ms",
    "landing_time": "time to land",
}
ERROR_WORDS |= {"cell_peak": "peak of a load cell of 40 Hz"}


def describe_prediction(drop: DropConditions, table: TransferTable | None = None) -> list[str]:
    """The source of the predicted parameters and their errors, and the conditions of the drop
    outside the design, in words."""
    table = table or shipped_table()
    errors = ", ".join(
        f"{ERROR_WORDS.get(name, name)} {100 * of['median']:.0f} % (nine tenths: {100 * of['nine_tenths']:.0f} %)"
        for name, of in table.errors.items()
    )
    lines = [
        f"predicted by table {table.version}; errors for products that it does not know: {errors}"
    ]
    return lines + [f"outside of what was learnt: {line}" for line in table.outside(drop)]


def _uncertainty(u: dict[str, float], others: list[dict[str, float]]) -> dict[str, float]:
    """Standard deviation of each coordinate, by those without a group of ensembles (jackknife)."""
    count = len(others)
    spread = {name: sum((other[name] - u[name]) ** 2 for other in others) for name in u}
    found = {
        name: float(np.sqrt((count - 1) / count * s)) if count else 0.0
        for name, s in spread.items()
    }
    return {name: min(sd, WIDEST) for name, sd in found.items()}
