"""python -m dem_jax gltf"""

from pathlib import Path

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "gltf",
        export_gltf,
        "Write the drop as a 3-D model that moves (glTF), for viewers, Blender and slides.",
        now="export --to glb",
    )
    result_files.add_arguments(made)
    made.add_argument("--out", metavar="FILE", help=".glb (default: the file's name .glb)")


def export_gltf(args: Args) -> None:
    """Write a run of a file."""
    from dem_jax.visualization.gltf_export import write_gltf

    run = result_files.load_single_run(args)
    print(
        write_gltf(
            run,
            result_files.output_path(args.out or Path(args.file).with_suffix(".glb"), [args.file]),
        )
    )
