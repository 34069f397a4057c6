"""All commands together, and what the exit code is."""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from dem_jax import process
from dem_jax.cli import (
    app,
    buckets,
    collisions,
    ensemble,
    export,
    gltf,
    measure,
    plot,
    posterior,
    products,
    render,
    report,
    run,
    scenes,
    study,
    vtk,
    weigh,
)
from dem_jax.cli.arguments import BAD_INPUT, Parser, one_line
from dem_jax.errors import PlatformError, RecordError, SceneError, SimulationError

COMMANDS = (
    *(run, ensemble, study, posterior, scenes, products, buckets, measure),
    *(plot, report, export, render, gltf, vtk, weigh, collisions, app),
)
FAILED, INTERRUPTED = 1, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the exit code: 0, 1 for a run that went wrong, 2 for bad input (one line on stderr).

    argv: None: of this process, which then is the command's own: a signal ends it within a second (``process``).
    """
    process.open_closed_streams()
    if argv is None:
        process.begin()
    try:
        with process.unwinding():
            code = _run(argv)
    except KeyboardInterrupt:
        if argv is None:
            process.end()
        return _fail(INTERRUPTED, process.ending_said())
    if argv is None:
        process.finish()
    return code


def _run(argv: Sequence[str] | None) -> int:
    try:
        args = parser().parse_args(argv)
        args.action(args)
        sys.stdout.flush()
        return 0
    except (SceneError, RecordError, PlatformError) as error:
        return _fail(BAD_INPUT, error)
    except SimulationError as error:
        where = f"; earlier results are in {error.path}" if error.path else "; nothing was recorded before"
        return _fail(FAILED, f"{error}{where}")
    except BrokenPipeError:  # of `| head`
        _mute()
        return 0
    except OSError as error:
        _mute()
        return _fail(BAD_INPUT, f"{error.filename or _place_of_error()}: {error.strerror or error}")
    except MemoryError as error:
        return _fail(FAILED, f"there is not enough memory ({error or 'none was left'}); allowed: fewer runs, pieces or samples")
    except (RuntimeError, AssertionError):
        if (platform := _platform_missing()) is None:
            raise
        return _fail(BAD_INPUT, platform)


def _place_of_error() -> str:
    """Where an error happened that names no file."""
    try:
        os.getcwd()
    except OSError:
        return "the working folder was removed"
    return "output"


def _platform_missing() -> PlatformError | None:
    """That JAX was asked for a platform that it does not have, which what it is used for first trips over."""
    if "jax" in sys.modules:
        from dem_jax import compiling

        try:
            compiling.check_platform()
        except PlatformError as error:
            return error
    return None


def parser() -> Parser:
    """The command line."""
    top = Parser(prog="dem_jax", description="Product impact force of a combination scale (discrete element method).")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return top


def _mute() -> None:
    """What was printed and not written yet goes nowhere: Python would try again at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(code: int, message: object) -> int:
    print(f"dem_jax: {one_line(message)}", file=sys.stderr)
    return code
