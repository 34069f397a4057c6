"""python -m dem_jax ensemble"""

from dem_jax.cli import simulating
from dem_jax.cli.arguments import Args, Commands, command, positive


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "ensemble", ensemble, "Simulate a scene with many seeds at once.")
    simulating.add_arguments(made)
    made.add_argument("--runs", type=positive, default=64, metavar="K", help="number of runs (default: 64)")


def ensemble(args: Args) -> None:
    """Simulate a scene with many seeds."""
    simulating.use_cache()
    scene, out = simulating.scene_and_target(args, "-ensemble")
    from dem_jax.drive import interface

    done = interface.ensemble(scene, args.runs, args.seed, out, args.overwrite, progress=not args.quiet)
    simulating.finish(done, out, args)
