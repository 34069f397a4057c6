"""Access to result files for the commands: one run of a file and its bodies, or the runs of several
files.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dem_jax.cli.arguments import Args, Parser, nonnegative_int
from dem_jax.errors import RecordError

if TYPE_CHECKING:
    from dem_jax.io.run_files import Run


def add_arguments(command: Parser) -> None:
    """The arguments of a command that draws a run."""
    command.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    command.add_argument(
        "--run",
        type=nonnegative_int,
        default=0,
        metavar="K",
        help="which run of an ensemble (default: 0)",
    )


def load_run_bodies(args: Args) -> tuple["Run", tuple[Any, Any, Any]]:
    """A run of a file, and its bodies from ``scene_geometry.load_bodies``. Raises RecordError."""
    from dem_jax.visualization.scene_geometry import load_bodies

    found = load_single_run(args)
    return found, load_bodies(found)


def load_single_run(args: Args) -> "Run":
    """The run of a file, or the requested one of an ensemble. Raises RecordError."""
    from dem_jax.io.run_files import load_run

    found = load_run(args.file)
    if found.run_count is not None:
        return found.member(args.run)
    if args.run:
        raise RecordError(f"--run {args.run}: {args.file} holds a single run")
    return found


def add_files(command: Parser) -> None:
    """The argument of a command that reads one file or several."""
    command.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="HDF5 file of a run or an ensemble; several are compared",
    )


def load_runs(files: Sequence[str]) -> tuple[list[str], list["Run"]]:
    """Short names of files, and their runs. Raises RecordError."""
    from dem_jax.io.run_files import load_run

    return short_names(files), [load_run(path) for path in files]


def is_study(files: Sequence[str]) -> bool:
    """Whether the file is that of a study. Raises RecordError for one among several."""
    from dem_jax.study import results_file

    studies = [name for name in files if results_file.is_study(name)]
    if studies and len(files) > 1:
        raise RecordError(f"{studies[0]} is a file of a study; allowed: a single file of a study")
    return bool(studies)


def short_names(files: Sequence[str]) -> list[str]:
    """Short names of files, without folders and endings where these names differ."""
    paths = [Path(file) for file in files]
    stems = [path.stem for path in paths]
    return stems if len(set(stems)) == len(stems) else [str(path.with_suffix("")) for path in paths]


def default_output_path(files: Sequence[str], suffix: str) -> Path:
    """The first file's name with another ending, beside it; for several files with "-compared" in
    it."""
    first = Path(files[0])
    return first.with_name(f"{first.stem}{'-compared' if len(files) > 1 else ''}{suffix}")


def output_path(out: str | Path, files: Sequence[str], folder: bool = False) -> Path:
    """The file, or folder, that a command writes, before it computes anything. Raises RecordError
    where it cannot be written or is one of the files that the command reads.
    """
    from dem_jax.io.run_files import check_writable

    for file in files:
        if Path(out).exists() and Path(file).exists() and Path(out).samefile(file):
            raise RecordError(f"--out {out} is the file that is read; allowed: another name")
    if not folder:
        check_writable(out)
    return Path(out)


def check_parts(
    names: Sequence[str], runs: Sequence["Run"], group: str | None, block: str | None = None
) -> None:
    """Raise RecordError, naming the flag, for a wall group or a block that a run does not have."""
    for name, run in zip(names, runs, strict=True):
        for flag, asked, has in (
            ("--group", group, run.force),
            ("--block", block, run.settled_mass),
        ):
            if asked is not None and asked not in has:
                raise RecordError(
                    f"{flag} {asked}: {name} has no such {flag[2:]}; allowed: {', '.join(has) or 'none'}"
                )
