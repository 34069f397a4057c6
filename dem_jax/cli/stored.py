"""What render and vtk share: a run of a file, and its bodies."""

from typing import TYPE_CHECKING, Any

from dem_jax.cli.arguments import Args, Parser, whole
from dem_jax.errors import RecordError

if TYPE_CHECKING:
    from dem_jax.store.record import Run


def add_arguments(command: Parser) -> None:
    """The arguments of a command that draws a run."""
    command.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    command.add_argument("--run", type=whole, default=0, metavar="K", help="which run of an ensemble (default: 0)")


def stored(args: Args) -> tuple["Run", tuple[Any, Any, Any]]:
    """A run of a file, and what drawing.bodies_of finds of its scene. Raises RecordError."""
    from dem_jax.show.drawing import bodies_of
    from dem_jax.store.record import load_run

    found = load_run(args.file)
    if found.run_count is not None:
        found = found.member(args.run)
    elif args.run:
        raise RecordError(f"--run {args.run}: {args.file} holds a single run")
    return found, bodies_of(found)
