"""python -m dem_jax export"""

from collections.abc import Callable
from pathlib import Path

from dem_jax.cli import gltf, render, result_files, vtk
from dem_jax.cli.arguments import Args, Commands, create_command
from dem_jax.errors import RecordError

FORMATS = ("csv", "xlsx", "gif", "mp4", "png", "glb", "vtk")


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "export",
        export_file,
        "Write a run or an ensemble for other programs: tables, animations, pictures, 3-D models.",
    )
    result_files.add_arguments(made)
    made.add_argument(
        "--to",
        choices=FORMATS,
        help="csv, xlsx: the plotted series; gif, mp4: an animation; png: a picture; glb: a 3-D"
        " model that moves; vtk: a folder for ParaView (default: by the ending of --out, else csv)",
    )
    made.add_argument("--out", metavar="FILE", help="default: the file's name with that ending")
    made.add_argument("--group", help="of tables: wall group (default: wb_flaps, or the first)")
    made.add_argument(
        "--block", help="of tables: block of the settled mass (default: wb, or the first)"
    )
    render.add_instants(made.add_mutually_exclusive_group())
    render.add_view(made)


def export_file(args: Args) -> None:
    """Write a file in the requested format. Raises RecordError."""
    form = args.to or _format_of(args)
    if form != "vtk" and args.out is not None and Path(args.out).suffix != f".{form}":
        raise RecordError(
            f"--out {args.out}: allowed with --to {form}: a name that ends in .{form}"
        )
    if form != "png" and (args.at is not None or args.strip is not None):
        raise RecordError(f"--at and --strip: {form} has no instants; allowed: --to png")
    _exporter(form)(args)


def _format_of(args: Args) -> str:
    """The format by the ending of the output."""
    if args.out is None:
        return "csv" if args.at is None and args.strip is None else "png"
    ending = Path(args.out).suffix.removeprefix(".")
    if ending not in FORMATS or ending == "vtk":
        allowed = ", ".join(f".{form}" for form in FORMATS if form != "vtk")
        raise RecordError(f"--out {args.out} must end in one of: {allowed}; or --to vtk")
    return ending


def _exporter(form: str) -> Callable[[Args], None]:
    """The function that writes a format."""
    if form == "glb":
        return gltf.export_gltf
    if form == "vtk":
        return vtk.export_frames
    return _export_tables if form in ("csv", "xlsx") else _draw(form)


def _draw(form: str) -> Callable[[Args], None]:
    """The function that draws an animation or a picture."""

    def draw(args: Args) -> None:
        still, path = form == "png", Path(args.file)
        out = args.out or (None if still else path.with_suffix(f".{form}"))
        render.render_run(Args(**vars(args) | {"png": still, "out": out}))

    return draw


def _export_tables(args: Args) -> None:
    """Write the series of all runs of a file."""
    from dem_jax.visualization import table_export as tables

    if args.run:
        raise RecordError(f"--run {args.run}: tables have all runs; allowed: without --run")
    names, (run,) = result_files.load_runs([args.file])
    result_files.check_parts(names, [run], args.group, args.block)
    ending = f".{args.to or 'csv'}"
    out = result_files.output_path(
        args.out or result_files.default_output_path([args.file], ending), [args.file]
    )
    for path in tables.export_tables(run, out, args.group, args.block):
        print(path)
