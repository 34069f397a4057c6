"""python -m dem_jax ensemble"""

from pathlib import Path

from dem_jax.cli import simulation_options, worker_options
from dem_jax.cli.arguments import Args, Commands, create_command, positive_int
from dem_jax.cluster.compile_cache import use_cache
from dem_jax.errors import RecordError, SceneError

JOIN = "join"  # the files of shards


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands, "ensemble", run_ensemble, "Simulate a scene with many seeds at once."
    )
    simulation_options.add_arguments(made)
    made.add_argument(
        "files", nargs="*", metavar="FILES", help="with join for SCENE: the files of all shards"
    )
    made.add_argument(
        "--runs", type=positive_int, default=64, metavar="K", help="number of runs (default: 64)"
    )
    made.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUES", dest="varied",
        help="values of a key that the runs take in turn: portion.count=5:13 (whole numbers from 5 to 13), "
        "drop.height=0.2:0.3:0.05 (steps of 0.05), material.restitution=0.1,0.5; several keys: all combinations in turn",
    )  # fmt: skip
    worker_options.add_arguments(made)
    words = "draw the numbers of the product from their ranges, anew for each run, and say how much of the bands is due to them"
    made.add_argument("--uncertain", action="store_true", help=words)


def run_ensemble(args: Args) -> None:
    """Simulate a scene with many seeds, or join the files of shards."""
    if args.scene == JOIN:
        _join_files(args)
        return
    if args.files:
        raise SceneError(f"{args.files[0]}: allowed: one scene, or join FILES")
    use_cache()
    place, shard = worker_options.parse_options(args)
    suffix = f"-ensemble{worker_options.shard_suffix(shard)}"
    scene, out = simulation_options.load_scene_and_target(args, suffix)
    from dem_jax.cli.vary_option import parse_varied_keys
    from dem_jax.runner import interface, shared_ensemble
    from dem_jax.runner.ensemble_plan import plan_ensemble

    parameters, progress = parse_varied_keys(args.varied, args.runs), not args.quiet
    if place is None and shard is None:
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
    else:
        plan = plan_ensemble(scene, args.runs, args.seed, parameters, args.uncertain)
        if place is not None:
            done = shared_ensemble.run_on_workers(plan, place, shard, out, args.overwrite, progress)
        else:
            assert shard is not None  # as the condition above says
            done = shared_ensemble.run_shard(plan, shard, out, args.overwrite, progress)
    simulation_options.finish_run(done, out, args)


def _join_files(args: Args) -> None:
    """Join the files of shards into one."""
    from dem_jax.io.run_files import load_run
    from dem_jax.runner.ensemble_parts import format_ranges, join_parts, part_range

    if not args.files:
        raise SceneError("ensemble join: no file; allowed: files of --shard K/N")
    if args.out is None:
        raise SceneError(
            "ensemble join: --out is not given; allowed: --out FILE, the whole ensemble"
        )
    simulation_options.check_ending(args.out)
    out = Path(args.out)
    simulation_options.check_target(out, args.overwrite)
    whole = join_parts(args.files, [load_run(path) for path in args.files])
    if "part" in whole.info:
        total, held = whole.info["part"]["total"], part_range(whole)
        missing = [r for r in (range(held.start), range(held.stop, total)) if r]
        raise RecordError(
            f"runs {format_ranges(missing)} of {total} are missing; allowed: the files of all shards"
        )
    whole.save(out, args.overwrite)
    simulation_options.finish_run(whole, out, args)
