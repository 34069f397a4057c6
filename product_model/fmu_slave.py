"""The Python program of a functional mock-up unit of `product_model.fmu`: pythonfmu copies this
file into it."""

import atexit
import ctypes
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pythonfmu import (
    Boolean,
    DefaultExperiment,
    Fmi2Causality,
    Fmi2Slave,
    Fmi2Variability,
    Integer,
    Real,
)

LONGEST = 2.0  # s: until when a tool simulates by default
SLACK = 1e-6  # of a sample: by how much a step may be off


def released_once(library: Path) -> None:
    """Let pythonfmu's library for Linux, if it is loaded from there, release Python before the
    process ends.

    By itself (0.7.0) it releases Python twice as the process ends: the static pointer is destroyed,
    then set to nothing by the library's destructor, which writes into memory that is free by then
    and sometimes aborts the process.
    """
    if sys.platform.startswith("linux") and sys.orig_argv:  # a process of Python itself, which runs
        # functions registered here
        with suppress(OSError):
            atexit.register(
                ctypes.CDLL(str(library), os.RTLD_NOW | os.RTLD_NOLOAD).finalizePythonInterpreter
            )


class ProductModel(Fmi2Slave):  # type: ignore[misc]  # pythonfmu has no types
    """A portion that falls at the start, and another at each rising edge of `release`."""

    author = "product-impact"
    description = "Product impact force of portions of piece goods (Profe, Kostetzer and Ament, SIMULTECH 2023)"

    def __init__(self, **kwargs: Any) -> None:
        from product_model.inputs import INPUTS, LEAVES, OUTPUTS

        super().__init__(**kwargs)
        released_once(
            Path(os.path.realpath(self.resources)).parent
            / "binaries"
            / "linux64"
            / "libpythonfmu-export.so"
        )
        self.inputs = json.loads((Path(self.resources) / "inputs.json").read_text(encoding="utf-8"))
        self.default_experiment = DefaultExperiment(
            start_time=0.0, stop_time=LONGEST, step_size=self.inputs["sample"]
        )
        self.seed, self.pieces = self.inputs.pop("seed"), self.inputs["pieces"]
        self.release, self.force, self.pif_kg = False, 0.0, 0.0
        self._held, self._fallen = False, 0
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        rows = {row.name: f"{row.symbol} ({row.unit}): {row.meaning}" for row in INPUTS}
        for name in LEAVES:
            setattr(self, name, self.inputs[name])
            self.register_variable(Real(name, description=rows[name], **fixed))
        self.register_variable(Integer("pieces", description=rows["pieces"], **fixed))
        self.register_variable(Integer("seed", description="of the random numbers", **fixed))
        words = "a rising edge lets the next portion fall into the emptied bucket"
        edge = {"causality": Fmi2Causality.input, "variability": Fmi2Variability.discrete}
        self.register_variable(Boolean("release", description=words, **edge))
        said = {
            name: f"({row.unit}): {row.meaning}, mean over the step"
            for row in OUTPUTS
            for name in row.name.split(", ")
        }
        said["pif_kg"] = said["pif_kg"].replace("(kg, g)", "(kg)")
        for name in ("force", "pif_kg"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.output, description=said[name])
            )

    def exit_initialization_mode(self) -> None:
        """The first portion begins to fall."""
        self._fallen, self._held = 0, bool(self.release)
        self._let_fall()

    def _let_fall(self) -> None:
        from product_model import parameters, stream
        from product_model.inputs import LEAVES

        own = {name: getattr(self, name) for name in (*LEAVES, "pieces")}
        begun = stream.start(parameters(**self.inputs | own), self.seed + self._fallen)
        self._bin, self._level, self._excess = (
            np.asarray(x) for x in (begun.bin, begun.level, begun.excess)
        )
        self._sample, self._fallen = 0, self._fallen + 1

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance by a whole number of samples, as `product_model.stream.step` does, in numpy, as a
        tool waits for each step.

        Raises ValueError, which ends the tool's run, for a step that is no multiple.
        """
        samples = round(step_size / self.inputs["sample"])
        if samples < 1 or abs(step_size / self.inputs["sample"] - samples) > SLACK * samples:
            raise ValueError(
                f"step = {step_size:g} s: allowed: a multiple of the sample time, {self.inputs['sample']:g} s"
            )
        if self.release and not self._held:
            self._let_fall()
        self._held = bool(self.release)
        # passed before each sample
        edges = np.searchsorted(self._bin, self._sample + np.arange(-1, samples), side="right")
        before, after = edges[:-1], edges[1:]
        self.force = float(
            (self._level[before] + (self._excess[after] - self._excess[before])).mean()
        )
        self.pif_kg = self.force / self.gravity
        self._sample += samples
        return True
