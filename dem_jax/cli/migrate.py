"""python -m dem_jax migrate"""

from pathlib import Path

from dem_jax.cli.arguments import Args, Commands, create_command
from dem_jax.errors import SceneError


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "migrate",
        migrate_files,
        "Rewrite the former keys of scenes, products, buckets and studies; comments stay.",
    )
    made.add_argument("files", nargs="+", metavar="FILE.toml", help="rewritten where they are")
    made.add_argument(
        "--dry-run", action="store_true", help="print what would change, and write nothing"
    )


def migrate_files(args: Args) -> None:
    """Rewrite each file, none if one cannot be rewritten. Raises SceneError and RecordError."""
    from dem_jax.io.atomic_files import write_atomically
    from dem_jax.scene.migration import migrate_text

    found = []
    for name in args.files:
        try:
            text = Path(name).read_bytes().decode("utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise SceneError(
                f"{name} cannot be read ({type(error).__name__}); allowed: a TOML text file"
            ) from error
        found.append((name, *migrate_text(text, name)))
    for name, text, renamed in found:
        if renamed and not args.dry_run:
            write_atomically(name, text.encode())
        print(f"{name}: {'nothing to rename' if not renamed else ''}".rstrip())
        for former, now in renamed:
            print(f"  {former} -> {now}")
