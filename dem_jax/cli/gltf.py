"""python -m dem_jax gltf"""

from pathlib import Path

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "gltf", gltf, "Write the drop as a 3-D model that moves (glTF), for viewers, Blender and slides.")
    stored.add_arguments(made)
    made.add_argument("--out", metavar="FILE", help=".glb (default: the file's name .glb)")


def gltf(args: Args) -> None:
    """Write a run of a file."""
    from dem_jax.show.gltf import write_gltf

    run = stored.single(args)
    print(write_gltf(run, stored.target(args.out or Path(args.file).with_suffix(".glb"), [args.file])))
