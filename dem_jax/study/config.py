"""Configuration of a study: TOML, validated."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from dem_jax.errors import SceneError
from dem_jax.runner.uncertain_draws import hold_portion
from dem_jax.scene import Scene, load_scene
from dem_jax.scene.former_keys import accept_study
from dem_jax.scene.messages import format_error
from dem_jax.scene.overrides import check_varied_keys
from dem_jax.scene.sections.base import Positive, Section, as_tuple
from dem_jax.study.outputs import OUTPUTS

RMSE_OUTPUTS = ("rmse", "rmse_model")  # g, of traces: with those of another point, with the Product
# Model's
STOCK_FOLDER = Path(__file__).parent.parent / "studies"
Names = Annotated[tuple[str, ...], BeforeValidator(as_tuple)]
Numbers = Annotated[tuple[Any, ...], BeforeValidator(as_tuple)]


class StudyParameter(Section):
    """A key of the scene that varies: values, or a range."""

    values: Numbers | None = Field(None, description="all that it takes")
    low: float | None = Field(None, description="of a range")
    high: float | None = None
    log: bool = Field(
        False, description="whether a range is divided, or drawn from, by its logarithm"
    )
    label: str | None = Field(
        None, description="name and unit in tables and figures; unset: the key"
    )

    @model_validator(mode="after")
    def _says_one_thing(self) -> "StudyParameter":
        is_range = self.low is not None and self.high is not None
        if is_range == (self.values is not None) or (self.low is None) != (self.high is None):
            raise ValueError("values, low, high: allowed: values, or both low and high")
        if self.values is not None and not self.values:
            raise ValueError("values = []: allowed: at least one")
        if (
            self.low is not None
            and self.high is not None
            and not (self.low < self.high and (self.low > 0 or not self.log))
        ):
            raise ValueError(
                f"low = {self.low:g}, high = {self.high:g}: allowed: low < high, of log both > 0"
            )
        return self


class ReferenceValue(Section):
    """A reference value of another author, for comparison with the study's own."""

    output: str
    low: float
    high: float
    source: str = Field(description="where it says so")
    at: dict[str, Any] = Field(
        {}, description="key -> value of the points that it is of; none: all"
    )


class ProductModelSection(Section):
    """The Product Model beside the drops (product_model): its heights are measured above the closed
    flaps.
    """

    impact_time: Positive = Field(500e-6, description="s, that an impact lasts; the paper's")
    gamma_low: Positive = Field(description="m, least spread of the heights")
    gamma_high: Positive = Field(description="m")
    height: Positive = Field(description="m, mean")


class Study(Section):
    """A study. Keys of the scene are dotted, in quotes: [parameter."drop.height"]."""

    name: str = Field(pattern=r"^[\w.-]+$")
    title: str
    scene: str = Field(description="a stock scene's name, or a .toml file")
    set: dict[str, Any] = Field({}, description="keys of the scene that are changed for all points")
    design: Literal["grid", "latin-hypercube", "sobol"] = Field(
        "grid", description="how points are chosen"
    )
    points: int = Field(
        5, ge=1, le=100_000, description="of a range in a grid, or of the whole of another design"
    )
    design_seed: int = Field(0, ge=0, description="of a design that is drawn")
    seeds: int = Field(8, ge=1, le=100_000, description="drops at each point")
    seed: int = Field(
        0,
        ge=0,
        description="the first of them; each point has the same, with uncertain = true its own",
    )
    parameter: dict[str, StudyParameter] = {}
    uncertain: bool = Field(
        False,
        description="the uncertain numbers of the scene are the parameters, of a Sobol design",
    )
    outputs: Names = ("peak", "peak_1ms", "peak_10ms", "first_at_rest", "time_to_rest", "settled")
    traces: bool = Field(False, description="keep the force over time of each drop, and draw it")
    span: Positive | None = Field(
        None, description="s of traces that are drawn, from the first force; unset: all"
    )
    compare: dict[str, Any] = Field(
        {},
        description="key -> value of the point with whose traces those of the others are compared, seed by seed: rmse",
    )
    heap: dict[str, Any] = Field(
        {}, description="keys of the scene with which portions settle, whatever their point says"
    )
    model: ProductModelSection | None = None
    reference: Annotated[tuple[ReferenceValue, ...], BeforeValidator(as_tuple)] = ()
    draft: bool = Field(
        False,
        description="twice the default step, unless the study or its scene says how long it is; unset with --quick: true",
    )
    quick: dict[str, Any] = Field({}, description="what is otherwise with --quick")
    folder: str = Field(".", exclude=True)

    @model_validator(mode="after")
    def _knows_its_names(self) -> "Study":
        for name in self.outputs:
            if name not in OUTPUTS:
                raise ValueError(
                    f"outputs: {name!r}: no such output; allowed: {', '.join(OUTPUTS)}"
                )
        for row in self.reference:
            if row.output not in (*self.outputs, *RMSE_OUTPUTS):
                raise ValueError(
                    f"reference.output = {row.output!r}: allowed: one of outputs, {', '.join(RMSE_OUTPUTS)}"
                )
        for key in (*self.compare, *(key for row in self.reference for key in row.at)):
            if key not in self.parameter:
                raise ValueError(
                    f"{key!r} in compare or reference.at: allowed: a parameter of the study"
                )
        if self.uncertain and any(row.values is not None for row in self.parameter.values()):
            raise ValueError("uncertain = true: allowed without parameters")
        if (self.model is not None or self.compare) and not self.traces:
            raise ValueError("model, compare: allowed with traces = true")
        return self

    def base_scene(self) -> Scene:
        """The scene with the changes that hold at all points, and what stays of its portion if
        numbers are uncertain.

        Raises SceneError.
        """
        beside = Path(self.folder) / self.scene
        changes = {"run.frame_interval": 0.0} | self.set
        scene = load_scene(beside if beside.is_file() else self.scene, changes)
        check_varied_keys(scene, self.parameter, f"study {self.name}: {scene.name}")
        varies = any(key.startswith(("run.time_step", "run.accuracy")) for key in self.parameter)
        if (
            self.draft
            and not varies
            and scene.run.time_step == "auto"
            and scene.run.accuracy is None
        ):
            scene = scene.replace({"run.accuracy": "draft"})
        return hold_portion(scene) if self.uncertain else scene

    def member_seed(self, member: int) -> int:
        """The seed of a drop: the same at all points, unless the study asks for the shares of
        chance and of numbers.
        """
        return self.seed + (member if self.uncertain else member % self.seeds)

    def with_scene(self, scene: str) -> "Study":
        """The same study of another scene: a stock scene or a .toml file, relative to the working
        folder.
        """
        return self.model_copy(
            update={"scene": scene, "name": f"{self.name}-{Path(scene).stem}", "folder": "."}
        )

    def to_toml(self) -> str:
        """The study as TOML text, from which ``load_study`` reads the same study."""
        return tomli_w.dumps(self.model_dump(exclude_none=True, exclude={"folder", "quick"}))


def stock_studies() -> dict[str, str]:
    """Names of the studies that come with dem_jax and their titles."""
    return {
        path.stem: tomllib.loads(path.read_text(encoding="utf-8"))["title"]
        for path in sorted(STOCK_FOLDER.glob("*.toml"))
    }


def load_study(source: str | Path, quick: bool = False) -> Study:
    """A stock study by name, or a TOML file by path. quick: apply the changes of its [quick].
    Raises SceneError.
    """
    stock, path = STOCK_FOLDER / f"{source}.toml", Path(source)
    if stock.is_file() and path.suffix != ".toml":
        path = stock
    if not path.is_file():
        raise SceneError(
            f"study {str(source)!r}: no such file, nor one of the stock studies ({', '.join(stock_studies())})"
        )
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, OSError, RecursionError) as error:
        raise SceneError(f"study {path}: cannot be read: {error}; allowed: TOML") from error
    return validate_study({"name": path.stem} | tree, path, quick)


def validate_study(tree: dict[str, Any], source: str | Path, quick: bool = False) -> Study:
    """The study of a tree of plain values. Raises SceneError."""
    folder = str(Path(source).parent)
    tree = accept_study(tree, str(source))
    try:
        if quick:
            Study.model_validate(tree | {"folder": folder})
            tree = _merge_tables({"draft": True} | tree, tree.get("quick", {}))
        return Study.model_validate(tree | {"folder": folder})
    except ValidationError as error:
        raise SceneError(f"study {source}: {format_error(error, tree, Study)}") from error


def _merge_tables(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merge tables key by key; other values, and each parameter as a whole, are replaced."""
    out = dict(below)
    for key, item in above.items():
        out[key] = (
            below.get(key, {}) | item
            if isinstance(item, dict) and isinstance(below.get(key, {}), dict)
            else item
        )
    return out
