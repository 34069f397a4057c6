"""python -m dem_jax posterior"""

from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(
        commands, "posterior", posterior, "What is likely of a study's parameters, by its references; of several studies together."
    )
    made.add_argument("files", nargs="+", metavar="FILE", help="files of studies of the same points")


def posterior(args: Args) -> None:
    """Print the posterior of the parameters."""
    from dem_jax.study import file
    from dem_jax.study.posterior import text

    for line in text([file.load(name) for name in args.files]):
        print(line)
