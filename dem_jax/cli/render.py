"""python -m dem_jax render"""

from pathlib import Path
from typing import Any

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, Parser, create_command, parse_instants


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "render",
        render_run,
        "Draw the scene with its pieces: animation, picture or film strip.",
        now="export --to gif, mp4 or png",
    )
    result_files.add_arguments(made)
    kind = made.add_mutually_exclusive_group()
    kind.add_argument("--gif", action="store_true", help="an animation (default)")
    kind.add_argument("--png", action="store_true", help="a picture of the end")
    add_instants(kind)
    made.add_argument(
        "--out",
        metavar="FILE",
        help="default: the file's name .gif (.mp4 is an animation too), or -scene.png",
    )
    add_view(made)


def add_instants(kind: Any) -> None:
    """Add the arguments that choose the instants of a picture. kind: a mutually exclusive group."""
    kind.add_argument("--at", type=float, metavar="S", help="a picture of the time S (s)")
    kind.add_argument(
        "--strip",
        type=parse_instants,
        metavar="auto|N|T,T,...",
        help="a film strip: auto: start, approach, first contact, peak force and rest; or N instants; or these times (s)",
    )


def add_view(made: Parser) -> None:
    """Add the arguments for the view and the colours of the pieces."""
    made.add_argument(
        "--colour",
        choices=["speed", "piece"],
        default="speed",
        help="of the pieces (default: speed)",
    )
    made.add_argument(
        "--azimuth",
        type=float,
        default=25.0,
        metavar="DEG",
        help="of the eye about z (default: 25)",
    )
    made.add_argument(
        "--elevation", type=float, default=14.0, metavar="DEG", help="of the eye (default: 14)"
    )


def render_run(args: Args) -> None:
    """Draw a run of a file."""
    from dem_jax.visualization.instants import find_impact_instants
    from dem_jax.visualization.rendering import Camera
    from dem_jax.visualization.rendering import render_frames as draw

    run, bodies = result_files.load_run_bodies(args)
    still = args.png or args.at is not None or args.strip is not None
    path = Path(args.file)
    out = args.out or (
        path.with_name(f"{path.stem}-scene.png") if still else path.with_suffix(".gif")
    )
    result_files.output_path(out, [args.file])
    camera = Camera(args.azimuth, args.elevation)
    strip, labels = args.strip, []
    if strip == "auto":
        story = find_impact_instants(run)
        strip, labels = [instant.time for instant in story], [instant.label for instant in story]
    print(
        draw(
            run.pieces,
            *bodies,
            out,
            at=args.at,
            strip=strip,
            camera=camera,
            colour=args.colour,
            labels=labels,
        )
    )
