"""python -m dem_jax ensemble"""

from dem_jax.cli import simulation_options
from dem_jax.cli.arguments import Args, Commands, create_command, positive_int


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands, "ensemble", run_ensemble, "Simulate a scene with many seeds at once."
    )
    simulation_options.add_arguments(made)
    made.add_argument(
        "--runs", type=positive_int, default=64, metavar="K", help="number of runs (default: 64)"
    )
    made.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUES", dest="varied",
        help="values of a key that the runs take in turn: portion.count=5:13 (whole numbers from 5 to 13), "
        "drop.height=0.2:0.3:0.05 (steps of 0.05), material.restitution=0.1,0.5; several keys: all combinations in turn",
    )  # fmt: skip
    words = "draw the numbers of the product from their ranges, anew for each run, and say how much of the bands is due to them"
    made.add_argument("--uncertain", action="store_true", help=words)


def run_ensemble(args: Args) -> None:
    """Simulate a scene with many seeds."""
    simulation_options.use_cache()
    scene, out = simulation_options.load_scene_and_target(args, "-ensemble")
    from dem_jax.cli.vary_option import parse_varied_keys
    from dem_jax.runner import interface

    parameters, progress = parse_varied_keys(args.varied, args.runs), not args.quiet
    done = interface.ensemble(
        scene,
        args.runs,
        args.seed,
        out,
        args.overwrite,
        progress,
        parameters=parameters,
        uncertain=args.uncertain,
    )
    simulation_options.finish_run(done, out, args)
