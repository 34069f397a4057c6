"""python -m dem_jax vtk"""

from pathlib import Path

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, create_command
from dem_jax.errors import RecordError


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "vtk",
        export_frames,
        "Export the stored poses for ParaView.",
        now="export --to vtk",
    )
    result_files.add_arguments(made)
    made.add_argument("--out", metavar="FOLDER", help="default: the file's name -vtk")


def export_frames(args: Args) -> None:
    """Export a run of a file."""
    from dem_jax.visualization.vtk_export import export_vtk

    run, (shapes, walls, wall_pose) = result_files.load_run_bodies(args)
    if run.pieces is None:
        raise RecordError(
            f"{args.file}: the run has no frames; set run.frame_interval to the time between them (s)"
        )
    path = Path(args.file)
    folder = result_files.output_path(
        args.out or path.with_name(f"{path.stem}-vtk"), [args.file], folder=True
    )
    for made in export_vtk(run.pieces, shapes, folder, walls, wall_pose):
        print(made)
