"""python -m dem_jax app"""

from dem_jax import process
from dem_jax.cli.arguments import Args, Commands, create_command, nonnegative_int


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "Open the app in a browser: product, bucket, drop, comparison, weighing and model by clicks."
    made = create_command(commands, "app", app, text)
    made.add_argument(
        "folder",
        nargs="?",
        default=".",
        metavar="FOLDER",
        help="holds all scenes and results (default: here)",
    )
    made.add_argument(
        "--port", type=nonnegative_int, default=0, help="of 127.0.0.1 (default: a free one)"
    )
    made.add_argument("--no-browser", action="store_true", help="print the address only")


def app(args: Args) -> None:
    """Serve the app until it is interrupted."""
    from dem_jax.app.folder import Folder
    from dem_jax.app.start import start_app

    folder = Folder(args.folder)
    process.end_signal_handling()  # the server has signals of its own, and ends the processes that
    # it started
    start_app(folder, args.port, not args.no_browser)
