"""python -m dem_jax posterior"""

from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(
        commands, "posterior", posterior, "Posterior of the parameters of one study or of several, given their reference values."
    )
    made.add_argument("files", nargs="+", metavar="FILE", help="files of studies of the same points")


def posterior(args: Args) -> None:
    """Print the posterior of the parameters."""
    from dem_jax.study import file
    from dem_jax.study.posterior import text

    for line in text([file.load(name) for name in args.files]):
        print(line)
