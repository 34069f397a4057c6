"""python -m dem_jax run"""

from pathlib import Path

from dem_jax.cli import simulation_options
from dem_jax.cli.arguments import Args, Commands, create_command, quantity_table
from dem_jax.cluster.compile_cache import use_cache
from dem_jax.errors import SceneError


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands, "run", run_scene, "Simulate a scene: an HDF5 file, a figure and a summary."
    )
    made.more = lambda: (
        f"quantities in the file, sampled every run.sample_interval:\n{quantity_table()}"
    )
    simulation_options.add_arguments(made, scene_optional=True)
    made.add_argument("--resume", metavar="FILE", help="continue the run in a file")


def run_scene(args: Args) -> None:
    """Simulate a scene, or resume a file."""
    if (args.scene is None) == (args.resume is None):
        raise SceneError("run: allowed: either a SCENE or --resume FILE")
    if args.resume and (args.settings or args.out or args.seed or args.record_rate is not None):
        raise SceneError(
            "run --resume: allowed beside it: --duration, --no-plot, --quiet; the rest is in the file"
        )
    use_cache()
    progress = not args.quiet
    if args.resume:
        from dem_jax.runner.interface import resume

        out = Path(args.resume)
        if not args.no_plot:
            simulation_options.check_beside(out, ".png")
        done = resume(out, args.duration, progress)
    else:
        scene, out = simulation_options.load_scene_and_target(args, "")
        from dem_jax.runner.interface import run_job
        from dem_jax.runner.settled_ahead import take_job

        job = take_job(scene, args.seed)
        if not args.no_plot:
            simulation_options.import_figure_early()
        done = run_job(job, out, args.overwrite, progress)
    simulation_options.finish_run(done, out, args)
