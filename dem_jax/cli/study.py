"""python -m dem_jax study"""

from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax.cli import posterior, simulation_options
from dem_jax.cli.arguments import Args, Commands, create_command
from dem_jax.errors import SceneError

if TYPE_CHECKING:
    from dem_jax.study.config import Study

ALL_STUDIES = "all"  # the stock studies
REWEIGHT = "reweight"  # the parameters of studies that are done


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
    made.add_argument("--overwrite", action="store_true", help="start again")
    made.add_argument(
        "--no-plot", action="store_true", help="do not draw the figure beside the file"
    )
    made.add_argument("--quiet", action="store_true", help="no progress bar")


def _study_files(files: list[str]) -> list[str]:
    if not files:
        raise SceneError("study reweight: no file; allowed: files of studies of the same points")
    return files


def run_studies(args: Args) -> None:
    """Conduct studies one after the other; for each, print the table and draw the figure."""
    from dem_jax.study.config import load_study, stock_studies

    if not args.study:
        for name, title in stock_studies().items():
            print(f"{name:<16} {title}")
        return
    if args.study[0] == REWEIGHT:
        posterior.print_posterior(Args(files=_study_files(args.study[1:])))
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
    simulation_options.use_cache()
    took = 0.0
    for table in tables:
        took += _run_one_study(table, args)
        if len(tables) > 1:
            print()
    if len(tables) > 1:
        print(f"{len(tables)} studies, {took:.0f} s")


def _run_one_study(table: "Study", args: Args) -> float:
    """Conduct one study; returns its time (s), including that before it was resumed."""
    from dem_jax.study import analysis, study_runner

    out = Path(args.out or f"{table.name}{'-quick' if args.quick else ''}.h5")
    simulation_options.check_beside(out, ".csv", *([] if args.no_plot else [".png"]))
    found = study_runner.run_study(table, out, args.overwrite, progress=not args.quiet)
    for line in analysis.describe_results(found):
        print(line)
    files = [out, analysis.write_csv(found, out.with_suffix(".csv"))]
    if not args.no_plot:
        from dem_jax.study.study_figure import plot_study

        files.append(plot_study(found, out.with_suffix(".png")))
    print(f"wrote {', '.join(map(str, files))}")
    return found.elapsed
