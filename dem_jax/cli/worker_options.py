"""Options of studies and ensembles: who computes, and which share."""

from typing import TYPE_CHECKING

from dem_jax.cli.arguments import Args, Parser, positive_int

if TYPE_CHECKING:
    from dem_jax.cluster.places import Place
    from dem_jax.cluster.shards import Shard


def add_arguments(command: Parser) -> None:
    """The arguments of a command whose work can be shared out."""
    command.add_argument(
        "--workers",
        type=positive_int,
        metavar="N",
        help="compute in N processes of this machine, by Dask; with --on: number of jobs",
    )
    command.add_argument(
        "--on",
        metavar="WHERE",
        help="compute elsewhere, by Dask: tcp://HOST:PORT of a running scheduler; slurm, pbs, sge, lsf, htcondor or oar; "
        "a .toml with the options of a site",
    )
    command.add_argument(
        "--shard",
        metavar="K/N",
        help="compute only the K-th of N shares, such as in a job array; join makes one file of them",
    )


def parse_options(args: Args) -> "tuple[Place | None, Shard | None]":
    """The place and the shard that were asked for. Raises SceneError."""
    from dem_jax.cluster.places import parse_place
    from dem_jax.cluster.shards import parse_shard

    shard = None if args.shard is None else parse_shard(args.shard)
    return parse_place(args.workers, args.on), shard


def shard_suffix(shard: "Shard | None") -> str:
    """Addition to the name of the file of a shard."""
    return "" if shard is None else f"-{shard.number}of{shard.total}"
