"""python -m dem_jax study"""

from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax.cli import posterior, simulation_options, worker_options
from dem_jax.cli.arguments import Args, Commands, create_command
from dem_jax.cluster.compile_cache import use_cache
from dem_jax.errors import RecordError, SceneError, TaskError

if TYPE_CHECKING:
    from dem_jax.study.config import Study
    from dem_jax.study.results_file import StudyResults

ALL_STUDIES = "all"  # the stock studies
REWEIGHT = "reweight"  # the parameters of studies that are done
JOIN = "join"  # the files of shards


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "study",
        run_studies,
        "Conduct studies: drops at many points of parameters, with a table and a figure.",
    )
    words = (
        "a stock study's name, or a .toml file; several one after the other; all: every stock study;"
        " reweight FILES: the posterior of their parameters, given their reference values;"
        " join FILES: the files of shards as one;"
        " without: a list"
    )
    made.add_argument("study", nargs="*", metavar="STUDY", help=words)
    made.add_argument(
        "--scene", metavar="SCENE", help="a stock scene or a .toml file in the place of the study's"
    )
    made.add_argument("--quick", action="store_true", help="few drops, as the study's [quick] says")
    made.add_argument(
        "--out",
        metavar="FILE",
        help="HDF5 file; an existing one is continued (default: the study's name .h5)",
    )
    worker_options.add_arguments(made)
    made.add_argument("--overwrite", action="store_true", help="start again")
    made.add_argument(
        "--no-plot", action="store_true", help="do not draw the figure beside the file"
    )
    made.add_argument("--quiet", action="store_true", help="no progress bar")


def _study_files(action: str, files: list[str]) -> list[str]:
    if not files:
        raise SceneError(f"study {action}: no file; allowed: files of studies of the same points")
    return files


def run_studies(args: Args) -> None:
    """Conduct studies one after the other; for each, print the table and draw the figure."""
    from dem_jax.study.config import load_study, stock_studies

    if not args.study:
        for name, title in stock_studies().items():
            print(f"{name:<16} {title}")
        return
    if args.study[0] == REWEIGHT:
        posterior.print_posterior(Args(files=_study_files(REWEIGHT, args.study[1:])))
        return
    if args.study[0] == JOIN:
        _join_files(_study_files(JOIN, args.study[1:]), args)
        return
    names = [
        name
        for asked in args.study
        for name in (stock_studies() if asked == ALL_STUDIES else [asked])
    ]
    if args.out is not None and len(names) > 1:
        raise SceneError(f"--out {args.out}: {len(names)} studies; allowed: of one by itself")
    simulation_options.check_ending(args.out)
    tables = [load_study(name, args.quick) for name in names]
    named = [table.name for table in tables]
    if twice := [name for name in named if named.count(name) > 1]:
        raise SceneError(
            f"study {' '.join(args.study)}: {twice[0]!r} twice, in one file; allowed: each name once"
        )
    if args.scene is not None:
        tables = [table.with_scene(args.scene) for table in tables]
    use_cache()
    took = 0.0
    for table in tables:
        took += _run_one_study(table, args)
        if len(tables) > 1:
            print()
    if len(tables) > 1:
        print(f"{len(tables)} studies, {took:.0f} s")


def _run_one_study(table: "Study", args: Args) -> float:
    """Conduct one study; returns its time (s), including that before it was resumed."""
    from dem_jax.study import study_runner

    place, shard = worker_options.parse_options(args)
    suffix = f"{'-quick' if args.quick else ''}{worker_options.shard_suffix(shard)}"
    out = Path(args.out or f"{table.name}{suffix}.h5")
    _check_beside(out, args)
    shown = not args.quiet
    found = study_runner.run_study(
        table, out, args.overwrite, progress=shown, place=place, shard=shard
    )
    if shard is not None:
        done = int((found.state != 0).sum())
        print(f"{done} of {len(found.state)} drops are in {out}, shard {shard} of {table.name}")
        return found.elapsed
    _print_results(found, out, args)
    return found.elapsed


def _check_beside(out: Path, args: Args) -> None:
    simulation_options.check_beside(out, ".csv", *([] if args.no_plot else [".png"]))


def _join_files(files: list[str], args: Args) -> None:
    """Join the files of shards into one."""
    from dem_jax.io.run_files import check_destination, lock_file, read_fingerprint
    from dem_jax.study import results_file, shard_join

    simulation_options.check_ending(args.out)
    whole = shard_join.join_shards(files)
    out = Path(args.out or f"{whole.study.name}.h5")
    if any(out.exists() and out.samefile(file) for file in files):
        raise RecordError(f"--out {out} is one of the files that are joined; allowed: another name")
    check_destination(out, args.overwrite)
    _check_beside(out, args)
    with lock_file(out):
        results_file.save_results(whole, out, read_fingerprint(out))
    if missing := shard_join.describe_missing(whole, files):
        raise TaskError(
            f"{missing}; {out} has the others, and the study's command with --out {out} computes them"
        )
    _print_results(whole, out, args)


def _print_results(found: "StudyResults", out: Path, args: Args) -> None:
    """Print the table of a study, and write its table of drops and its figure."""
    from dem_jax.study import analysis

    for line in analysis.describe_results(found):
        print(line)
    files = [out, analysis.write_csv(found, out.with_suffix(".csv"))]
    if not args.no_plot:
        from dem_jax.study.study_figure import plot_study

        files.append(plot_study(found, out.with_suffix(".png")))
    print(f"wrote {', '.join(map(str, files))}")
