"""Options that run and ensemble share: the scene and its changes, the file to write, and the lines
at the end.
"""

import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax import process
from dem_jax.cli.arguments import Args, Parser, nonnegative_int
from dem_jax.errors import RecordError, SceneError

if TYPE_CHECKING:
    from dem_jax.io.run_files import Run
    from dem_jax.scene import Scene

HDF5 = (".h5", ".hdf5", ".hdf")  # endings of a file of results


def add_arguments(command: Parser, scene_optional: bool = False) -> None:
    """The arguments of a command that simulates a scene."""
    command.add_argument(
        "scene",
        nargs="?" if scene_optional else None,
        metavar="SCENE",
        help="a stock scene's name, or a .toml file",
    )
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help='change the scene, such as --set material.restitution=0.3 (see "dem_jax scenes NAME" for all keys)',
    )  # fmt: skip
    command.add_argument(
        "--seed",
        type=nonnegative_int,
        default=0,
        help="of the arrangement of a portion (default: 0)",
    )
    command.add_argument(
        "--duration", type=float, metavar="S", help="s from the release; as --set run.duration=S"
    )
    command.add_argument(
        "--record-rate", type=float, metavar="HZ",
        help="samples per second instead of run.sample_interval, without poses: at 1000, as of a scale, files are a twentieth in size",
    )  # fmt: skip
    command.add_argument(
        "--out", metavar="FILE", help="HDF5 file to write (default: the scene's name .h5)"
    )
    command.add_argument("--overwrite", action="store_true", help="replace an existing file")
    command.add_argument(
        "--no-plot", action="store_true", help="do not draw the figure beside the file"
    )
    command.add_argument("--quiet", action="store_true", help="no progress bar")


def load_scene_and_target(args: Args, suffix: str) -> tuple["Scene", Path]:
    """The scene with its changes, and the file to write. suffix: of the file's name. Raises
    SceneError and RecordError.
    """
    from dem_jax.scene import load_scene, parse_setting

    changes = dict(parse_setting(text) for text in args.settings)
    if args.duration is not None:
        changes["run.duration"] = args.duration
    if args.record_rate is not None:
        if not 0 < args.record_rate < 1e9:
            raise SceneError(
                f"--record-rate {args.record_rate:g}: allowed: a number above 0 and below 1e9 (1/s)"
            )
        changes = {"run.sample_interval": 1 / args.record_rate, "run.frame_interval": 0.0} | changes
    check_ending(args.out)
    scene = load_scene(args.scene, changes)
    out = Path(args.out or f"{scene.name}{suffix}.h5")
    check_target(out, args.overwrite)
    if not args.no_plot:
        check_beside(out, ".png")
    return scene, out


def check_target(out: Path, overwrite: bool) -> None:
    """Raise RecordError for a file of results that exists and is not to be replaced, or cannot be
    written.
    """
    from dem_jax.io.run_files import check_destination

    check_destination(out, overwrite, "another name by --out, or --overwrite to replace it")


def check_ending(out: str | None) -> None:
    """Raise RecordError for a file of results with another ending."""
    if out and Path(out).suffix.lower() not in HDF5:
        instead = "python -m dem_jax export makes .csv and .xlsx of them"
        raise RecordError(
            f"--out {out}: results are HDF5; allowed: a name that ends in {', '.join(HDF5)}; {instead}"
        )


def check_beside(out: Path, *endings: str) -> None:
    """Raise RecordError unless files with these endings can be written beside a file of results,
    under its name.
    """
    from dem_jax.io.run_files import check_writable

    for ending in endings:
        check_writable(out.with_suffix(ending))


def finish_run(done: "Run", out: Path, args: Args) -> None:
    """Draw the figure and print the summary. An interrupt says that the results are whole."""
    with process.save_on_interrupt(lambda: f"all results are in {out}"):
        _finish_run(done, out, args)


def _finish_run(done: "Run", out: Path, args: Args) -> None:
    from dem_jax.visualization.cycle_metrics import describe_cycles
    from dem_jax.visualization.summary import summarize_run

    files, problem = [out], None
    if not args.no_plot and done.force:
        from dem_jax.visualization.run_figure import plot_run

        try:
            files.append(plot_run(done, out.with_suffix(".png")))
        except RecordError as error:
            problem = error
    for line in (*summarize_run(done), *describe_cycles(done)):
        print(line)
    print(f"wrote {', '.join(map(str, files))}")
    if problem is not None:
        raise RecordError(f"{problem}; the run is whole: python -m dem_jax plot {out} draws it")


def import_figure_early() -> None:
    """Import what draws a figure in another thread: it takes a second, which passes unnoticed while
    XLA computes steps.
    """

    def import_figure() -> None:
        with suppress(ImportError):  # as drawing will say
            import matplotlib.backends.backend_agg
            import matplotlib.figure  # noqa: F401

    threading.Thread(target=import_figure, daemon=True).start()
