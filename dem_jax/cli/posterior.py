"""python -m dem_jax posterior"""

from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "posterior",
        print_posterior,
        "Posterior of the parameters of one study or of several, given their reference values.",
        now="study reweight",
    )
    made.add_argument(
        "files", nargs="+", metavar="FILE", help="files of studies of the same points"
    )


def print_posterior(args: Args) -> None:
    """Print the posterior of the parameters."""
    from dem_jax.study import results_file
    from dem_jax.study.reweighting import describe_posterior

    for line in describe_posterior([results_file.load_results(name) for name in args.files]):
        print(line)
