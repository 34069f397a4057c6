"""python -m dem_jax study"""

from pathlib import Path

from dem_jax.cli import simulating
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "study", study, "Conduct a study: drops at many points of parameters, with a table and a figure.")
    made.add_argument("study", nargs="?", metavar="STUDY", help="a stock study's name, or a .toml file; without: a list")
    made.add_argument("--scene", metavar="SCENE", help="a stock scene or a .toml file in the place of the study's")
    made.add_argument("--quick", action="store_true", help="few drops, as the study's [quick] says")
    made.add_argument("--out", metavar="FILE", help="HDF5 file, gone on with if it is there (default: the study's name .h5)")
    made.add_argument("--overwrite", action="store_true", help="begin anew")
    made.add_argument("--no-plot", action="store_true", help="do not draw the figure beside the file")
    made.add_argument("--quiet", action="store_true", help="no progress bar")


def study(args: Args) -> None:
    """Conduct a study, print its table, draw its figure."""
    from dem_jax.study.table import load_study, stock_studies

    if args.study is None:
        for name, title in stock_studies().items():
            print(f"{name:<16} {title}")
        return
    table = load_study(args.study, args.quick)
    if args.scene is not None:
        table = table.of_scene(args.scene)
    simulating.use_cache()
    from dem_jax.study import conduct, results

    out = Path(args.out or f"{table.name}{'-quick' if args.quick else ''}.h5")
    found = conduct.study(table, out, args.overwrite, progress=not args.quiet)
    for line in results.text(found):
        print(line)
    files = [out, results.write_csv(found, out.with_suffix(".csv"))]
    if not args.no_plot:
        from dem_jax.study.figure import plot_study

        files.append(plot_study(found, out.with_suffix(".png")))
    print(f"wrote {', '.join(map(str, files))}")
