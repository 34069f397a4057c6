"""The C files of the Product Model as a library that Python calls."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from product_model import parameters
from product_model.c_export import FIELDS, REALS, SOURCES
from product_model.extended import ADDED, SHAPES
from product_model.fmu_compiled import find_compiler

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
FORMS = ("rectangular", "interval-mean", "smooth")
CAPACITY = 400  # pieces
IMPACTS = 16  # of a piece in the extended model
SIZE = 1 << 18  # bytes; more than a state of 800 edges and 6400 pulses has

needs_compiler = pytest.mark.skipif(
    find_compiler() is None, reason="no C compiler: cc, gcc or clang, or CC in the environment"
)


class Values(ctypes.Structure):
    """product_model_parameters."""

    _fields_ = [(name, ctypes.c_double) for name in FIELDS] + [
        ("pieces", ctypes.c_int32),
        ("form", ctypes.c_int32),
    ]


class LandingValues(ctypes.Structure):
    """product_model_landings."""

    _fields_ = [(name, ctypes.c_double) for name in ADDED] + [
        ("shape", ctypes.c_int32),
        ("landings", ctypes.c_int32),
        ("impacts", ctypes.c_int32 * IMPACTS),
    ]


class ExtendedValues(ctypes.Structure):
    """product_model_parameters of a library with room for impacts."""

    _fields_ = [*Values._fields_, ("landings", LandingValues)]


def values_of(params):
    """The struct of these `Parameters`; a library without room for impacts reads its beginning."""
    numbers = [float(getattr(params, name)) for name in FIELDS]
    numbers += [params.pieces or 0, FORMS.index(params.form)]
    own = params.landings
    if own is None:
        return ExtendedValues(*numbers)
    room = ctypes.c_int32 * IMPACTS
    impacts = room(*own.impacts[:IMPACTS])
    added = [float(value) for value in own.values().values()]
    return ExtendedValues(
        *numbers, LandingValues(*added, SHAPES.index(own.shape), len(own.impacts), impacts)
    )


def compile_c(folder, *arguments):
    """Compile in `folder` with all warnings as errors."""
    subprocess.run([find_compiler(), *STRICT, *arguments, "-lm"], cwd=folder, check=True)


class Library:
    """The functions of product_model.h in one precision. impacts: room for them, 0 for the paper's
    model.
    """

    def __init__(self, folder, precision, impacts=0):
        for name in ("product_model.c", "product_model.h"):
            shutil.copy(SOURCES / name, folder)
        name = f"{precision}.so"
        options = [
            "-O2",
            "-shared",
            "-fPIC",
            f"-DPRODUCT_MODEL_REAL={REALS[precision]}",
            f"-DPRODUCT_MODEL_MAX_PIECES={CAPACITY}",
            f"-DPRODUCT_MODEL_MAX_IMPACTS={impacts}",
        ]
        compile_c(folder, *options, "product_model.c", "-o", name)
        self.functions = ctypes.CDLL(str(folder / name))
        real = {"f32": ctypes.c_float, "f64": ctypes.c_double}[precision]
        self.functions.product_model_step.restype = real
        self.functions.product_model_step.argtypes = [ctypes.c_void_p, real]
        self.functions.product_model_start.argtypes = [
            ctypes.c_void_p,
            ctypes.c_void_p,
            ctypes.c_uint32,
            ctypes.c_double,
        ]

    def start(self, params, seed, target=0.0):
        """(state, error code) of a stream. params: `Parameters`."""
        state = ctypes.create_string_buffer(SIZE)
        values = values_of(params)
        return state, self.functions.product_model_start(state, ctypes.byref(values), seed, target)

    def start_with_key(self, params, key):
        """State of a stream of a key [2] uint32."""
        state = ctypes.create_string_buffer(SIZE)
        values = values_of(params)
        words = (ctypes.c_uint32 * 2)(*(int(word) for word in key))
        assert (
            self.functions.product_model_start_with_key(
                state, ctypes.byref(values), words, ctypes.c_double(0.0)
            )
            == 0
        )
        return state

    def forces(self, state, steps):
        """Force of each of the time steps (s)."""
        return np.array([self.functions.product_model_step(state, step) for step in steps])

    def trace(self, params, seed, samples):
        """Force [samples] (N) of a portion."""
        state, error = self.start(params, seed)
        assert error == 0
        return self.forces(state, np.full(samples, params.sample))

    def split_key(self, key, index):
        """The key of a number."""
        old, new = (ctypes.c_uint32 * 2)(*(int(word) for word in key)), (ctypes.c_uint32 * 2)()
        self.functions.product_model_split_key(old, ctypes.c_uint32(index), new)
        return list(new)


def short(**changes):
    """Inputs of a short trace whose program does not depend on the drop heights."""
    return parameters(**{"pieces": 7, "m_piece": 4e-3, "sample": 1e-3, "duration": 0.3} | changes)
