"""The entry point of all commands, and its exit code."""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from dem_jax import deprecation, process
from dem_jax.cli import (
    app,
    buckets,
    check,
    collisions,
    ensemble,
    export,
    gltf,
    listing,
    measure,
    migrate,
    plot,
    posterior,
    products,
    render,
    report,
    run,
    scenes,
    study,
    vtk,
    warm,
    weigh,
)
from dem_jax.cli.arguments import BAD_INPUT, Parser, join_lines
from dem_jax.errors import PlatformError, RecordError, SceneError, SimulationError, TaskError

COMMANDS = (
    run,
    ensemble,
    study,
    listing,
    check,
    measure,
    migrate,
    plot,
    report,
    export,
    weigh,
    app,
    warm,
)
FORMER_COMMANDS = (scenes, products, buckets, render, gltf, vtk, collisions, posterior)
RUN_FAILED, INTERRUPTED = 1, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0, 1 for a failed run, 2 for bad input (one line on
    stderr).

    argv: None: the arguments of this process, which then belongs to the command: a signal ends it
    within a second (``process``).
    """
    process.open_closed_streams()
    if argv is None:
        process.install_signal_handlers()
    try:
        with process.allow_interrupt():
            code = _run_command(argv)
    except KeyboardInterrupt:
        if argv is None:
            process.end_process()
        return _report_failure(INTERRUPTED, process.describe_interrupt())
    if argv is None:
        process.end_signal_handling()
    return code


def _run_command(argv: Sequence[str] | None) -> int:
    try:
        args = build_parser().parse_args(argv)
        with deprecation.print_notes():
            args.action(args)
        sys.stdout.flush()
        return 0
    except (SceneError, RecordError, PlatformError) as error:
        return _report_failure(BAD_INPUT, error)
    except SimulationError as error:
        where = (
            f"; earlier results are in {error.path}"
            if error.path
            else "; nothing was recorded before"
        )
        return _report_failure(RUN_FAILED, f"{error}{where}")
    except TaskError as error:
        print(error.trace, end="", file=sys.stderr)
        return _report_failure(RUN_FAILED, error)
    except BrokenPipeError:  # of `| head`
        _mute_output()
        return 0
    except OSError as error:
        _mute_output()
        return _report_failure(
            BAD_INPUT, f"{error.filename or _locate_error()}: {error.strerror or error}"
        )
    except MemoryError as error:
        return _report_failure(
            RUN_FAILED,
            f"there is not enough memory ({error or 'none was left'}); allowed: fewer runs, pieces or samples",
        )
    except (RuntimeError, AssertionError):
        if (platform := _find_missing_platform()) is None:
            raise
        return _report_failure(BAD_INPUT, platform)


def _locate_error() -> str:
    """Place of an operating-system error that names no file."""
    try:
        os.getcwd()
    except OSError:
        return "the working folder was removed"
    return "output"


def _find_missing_platform() -> PlatformError | None:
    """The error of a requested platform that JAX does not have; None: it has it.

    Without this check the first use of JAX would fail on it.
    """
    if "jax" in sys.modules:
        from dem_jax import xla_flags

        try:
            xla_flags.check_platform()
        except PlatformError as error:
            return error
    return None


def build_parser() -> Parser:
    """The command line."""
    top = Parser(
        prog="dem_jax",
        description="Product impact force of a combination scale (discrete element method).",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in (*COMMANDS, *FORMER_COMMANDS):
        command.add_command(commands)
    return top


def _mute_output() -> None:
    """Discard printed text that is not written yet; Python would try again at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _report_failure(code: int, message: object) -> int:
    print(f"dem_jax: {join_lines(message)}", file=sys.stderr)
    return code
