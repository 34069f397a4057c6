"""The XML files of a functional mock-up unit that is compiled from C, for FMI 2.0 and 3.0."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

from product_model.c_export import FIELDS
from product_model.extended import ADDITIONS
from product_model.inputs import INPUTS, LEAVES, Input, Parameters, count_pieces
from product_model.record import version

IDENTIFIER = "product_model"
DESCRIPTION = (
    "Product impact force of portions of piece goods (Profe, Kostetzer and Ament, SIMULTECH 2023)"
)
LONGEST = 2.0  # s: until when a tool simulates by default
UNITS = {
    "m": {"m": 1},
    "s": {"s": 1},
    "kg": {"kg": 1},
    "m/s2": {"m": 1, "s": -2},
    "1": {},
    "N": {"kg": 1, "m": 1, "s": -2},
    "g": {"kg": 1},
}
FACTORS = {"g": 1e-3}  # to the base units, where it is not 1
PIECES, SEED, RELEASE, FORCE, PIF_KG, TIME = range(1000, 1006)  # value references as in c/unit.h
LANDINGS = 100  # that of the first addition of the extended model
SOURCE_NAMES = {"2": ("product_model.c", "fmi2.c"), "3": ("product_model.c", "fmi3.c")}
TYPES = {
    "2": {"real": "Real", "integer": "Integer", "boolean": "Boolean"},
    "3": {"real": "Float64", "integer": "Int32", "boolean": "Boolean"},
}


@dataclass(frozen=True)
class UnitKind:
    """Kind of a unit.

    identifier: name of the model and its library. description: in words. sources: for each version
    of the standard, the C files to compile."""

    identifier: str
    description: str
    sources: dict[str, tuple[str, str]]


MODEL = UnitKind(IDENTIFIER, DESCRIPTION, SOURCE_NAMES)


@dataclass(frozen=True)
class Variable:
    """A variable of the unit.

    kind: real, integer or boolean; start: initial value as text, None for an output; minimum: least
    value, None if there is none.
    """

    name: str
    reference: int
    kind: str
    causality: str
    variability: str
    description: str
    unit: str | None = None
    start: str | None = None
    minimum: str | None = None


def list_variables(params: Parameters, seed: int) -> list[Variable]:
    """The variables of a unit of these inputs."""
    rows = {row.name: row for row in INPUTS}
    span = "at the end of the step" if params.form == "rectangular" else "mean over the step"
    target = f"{rows['m_target'].meaning}, from which the number of pieces follows (eq. 16); 0: `pieces` pieces"
    release = "a rising edge lets the next portion fall"
    return [
        *(
            _real_parameter(rows[name], rows[name].meaning, float(getattr(params, name)))
            for name in LEAVES
        ),
        *_landing_parameters(params),
        _real_parameter(rows["m_target"], target, 0.0),
        _integer_parameter(
            "pieces", PIECES, "tunable", rows["pieces"].meaning, count_pieces(params), 1
        ),
        _integer_parameter("seed", SEED, "fixed", "seed of the random numbers", seed, 0),
        Variable("release", RELEASE, "boolean", "input", "discrete", release, start="false"),
        _output("force", FORCE, f"total impact force, {span}", "N"),
        _output("pif_kg", PIF_KG, f"product impact force as a weight, {span}", "kg"),
    ]


def _real_parameter(row: Input, description: str, start: float) -> Variable:
    unit, number = row.unit.replace("²", "2"), FIELDS.index(row.name)
    return Variable(
        row.name, number, "real", "parameter", "tunable", description, unit, repr(start), "0"
    )


def _landing_parameters(params: Parameters) -> list[Variable]:
    """The additions of the extended model, none for the paper's model."""
    if params.landings is None:
        return []
    fixed = ("real", "parameter", "tunable")
    return [
        Variable(
            row.name, LANDINGS + k, *fixed, row.meaning, row.unit, repr(float(value)), repr(row.low)
        )
        for k, (row, value) in enumerate(
            zip(ADDITIONS, params.landings.values().values(), strict=True)
        )
    ]


def _integer_parameter(
    name: str, reference: int, variability: str, description: str, start: int, least: int
) -> Variable:
    return Variable(
        name,
        reference,
        "integer",
        "parameter",
        variability,
        description,
        None,
        str(start),
        str(least),
    )


def _output(name: str, reference: int, description: str, unit: str) -> Variable:
    return Variable(name, reference, "real", "output", "continuous", description, unit)


def describe_model(
    fmi: str, kind: UnitKind, variables: list[Variable], step: float, token: str
) -> bytes:
    """modelDescription.xml of a unit of FMI 2.0 or 3.0. step: (s) default step; token: the token
    that the library contains.
    """
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{fmi}.0",
            "modelName": kind.identifier,
            {"2": "guid", "3": "instantiationToken"}[fmi]: token,
            "description": kind.description,
            "version": version(),
            "generationTool": f"product-impact {version()}",
        },
    )
    if fmi == "2":
        root.set("numberOfEventIndicators", "0")
    can = {
        "2": ("canGetAndSetFMUstate", "canSerializeFMUstate"),
        "3": ("canGetAndSetFMUState", "canSerializeFMUState"),
    }[fmi]
    simulation = {
        "modelIdentifier": kind.identifier,
        "canHandleVariableCommunicationStepSize": "true",
    } | dict.fromkeys(can, "true")
    element = ET.SubElement(root, "CoSimulation", simulation)
    if fmi == "2":
        files = ET.SubElement(element, "SourceFiles")
        for name in kind.sources[fmi]:
            ET.SubElement(files, "File", name=name)
    _add_units(root, {variable.unit for variable in variables} | {"s"})
    ET.SubElement(
        root, "DefaultExperiment", startTime="0.0", stopTime=repr(LONGEST), stepSize=repr(step)
    )
    (_add_variables_2 if fmi == "2" else _add_variables_3)(root, variables)
    return _as_bytes(root)


def describe_build(kind: UnitKind) -> bytes:
    """sources/buildDescription.xml of FMI 3.0."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=kind.identifier)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in kind.sources["3"]:
        ET.SubElement(files, "SourceFile", name=name)
    return _as_bytes(root)


def _add_units(root: ET.Element, used: set[str | None]) -> None:
    units = ET.SubElement(root, "UnitDefinitions")
    for name, exponents in UNITS.items():
        if name not in used:
            continue
        unit = ET.SubElement(units, "Unit", name=name)
        factor = {"factor": repr(FACTORS[name])} if name in FACTORS else {}
        powers = {base: str(power) for base, power in exponents.items()}
        ET.SubElement(unit, "BaseUnit", powers | factor)


def _attributes(variable: Variable) -> dict[str, str]:
    """Attributes of the type: unit, least and initial value."""
    named = {"unit": variable.unit, "min": variable.minimum, "start": variable.start}
    return {name: value for name, value in named.items() if value is not None}


def _common(variable: Variable, fmi: str) -> dict[str, str]:
    common = {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "description": variable.description,
    }
    common |= {"causality": variable.causality, "variability": variable.variability}
    if variable.causality in ("parameter", "output"):
        common["initial"] = "exact" if variable.causality == "parameter" else "calculated"
    return common


def _add_variables_2(root: ET.Element, variables: list[Variable]) -> None:
    listed = ET.SubElement(root, "ModelVariables")
    for variable in variables:
        scalar = ET.SubElement(listed, "ScalarVariable", _common(variable, "2"))
        ET.SubElement(scalar, TYPES["2"][variable.kind], _attributes(variable))
    structure = ET.SubElement(root, "ModelStructure")
    for tag in ("Outputs", "InitialUnknowns"):
        unknowns = ET.SubElement(structure, tag)
        for index, variable in enumerate(variables, 1):
            if variable.causality == "output":
                ET.SubElement(unknowns, "Unknown", index=str(index))


def _add_variables_3(root: ET.Element, variables: list[Variable]) -> None:
    listed = ET.SubElement(root, "ModelVariables")
    ET.SubElement(
        listed,
        "Float64",
        {
            "name": "time",
            "valueReference": str(TIME),
            "causality": "independent",
            "variability": "continuous",
            "unit": "s",
        },
    )
    for variable in variables:
        ET.SubElement(
            listed, TYPES["3"][variable.kind], _common(variable, "3") | _attributes(variable)
        )
    structure = ET.SubElement(root, "ModelStructure")
    for tag in ("Output", "InitialUnknown"):
        for variable in variables:
            if variable.causality == "output":
                ET.SubElement(structure, tag, valueReference=str(variable.reference))


def _as_bytes(root: ET.Element) -> bytes:
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="utf-8") + b"\n"
