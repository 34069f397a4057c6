"""python -m dem_jax run"""

from pathlib import Path

from dem_jax.cli import simulating
from dem_jax.cli.arguments import Args, Commands, command, quantities
from dem_jax.errors import SceneError


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "run", run, "Simulate a scene: an HDF5 file, a figure and a summary.")
    made.more = lambda: f"quantities in the file, sampled every run.sample:\n{quantities()}"
    simulating.add_arguments(made, scene_optional=True)
    made.add_argument("--resume", metavar="FILE", help="continue the run in a file")


def run(args: Args) -> None:
    """Simulate a scene, or go on with a file."""
    if (args.scene is None) == (args.resume is None):
        raise SceneError("run: allowed: either a SCENE or --resume FILE")
    if args.resume and (args.settings or args.out or args.seed or args.record_rate is not None):
        raise SceneError("run --resume: allowed beside it: --duration, --no-plot, --quiet; the rest is in the file")
    simulating.use_cache()
    progress = not args.quiet
    if args.resume:
        from dem_jax.drive.interface import resume

        out = Path(args.resume)
        if not args.no_plot:
            simulating.check_beside(out, ".png")
        done = resume(out, args.duration, progress)
    else:
        scene, out = simulating.scene_and_target(args, "")
        from dem_jax.drive.interface import simulate

        done = simulate(scene, args.seed, out, args.overwrite, progress)
    simulating.finish(done, out, args)
