"""python -m dem_jax vtk"""

from pathlib import Path

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command
from dem_jax.errors import RecordError


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "vtk", vtk, "Export the stored poses for ParaView.")
    stored.add_arguments(made)
    made.add_argument("--out", metavar="FOLDER", help="default: the file's name -vtk")


def vtk(args: Args) -> None:
    """Export a run of a file."""
    from dem_jax.show.vtk import export_vtk

    run, (shapes, walls, wall_pose) = stored.stored(args)
    if run.pieces is None:
        raise RecordError(f"{args.file}: the run has no frames; set run.frames to the time between them (s)")
    path = Path(args.file)
    folder = stored.target(args.out or path.with_name(f"{path.stem}-vtk"), [args.file], folder=True)
    for made in export_vtk(run.pieces, shapes, folder, walls, wall_pose):
        print(made)
