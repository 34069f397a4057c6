"""Command line: python -m dem_jax run | ensemble | scenes | plot | render | vtk. Heavy imports wait until needed."""

import argparse
import os
import sys
from pathlib import Path

from dem_jax.errors import RecordError, SceneError, SimulationError

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


def main(argv=None) -> int:
    """Run a command; the exit code: 0, 1 for a run that went wrong, 2 for bad input (one line on stderr)."""
    try:
        args = parser().parse_args(argv)
        return args.action(args) or 0
    except (SceneError, RecordError) as error:
        return _fail(BAD_INPUT, error)
    except SimulationError as error:
        where = f"; what was computed before is in {error.path}" if error.path else "; nothing was recorded before"
        return _fail(FAILED, f"{error}{where}")
    except KeyboardInterrupt:
        return _fail(INTERRUPTED, "interrupted; python -m dem_jax run --resume FILE goes on with a run")
    except BrokenPipeError:  # of `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _fail(code, message):
    print(f"dem_jax: {_one_line(message)}", file=sys.stderr)
    return code


def _one_line(message):
    return " ".join(str(message).split())


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message):
        self.exit(BAD_INPUT, f"{self.prog}: {_one_line(message)} (see --help)\n")


def parser() -> Parser:
    """The command line."""
    top = Parser(prog="dem_jax", description="Product impact force of a combination scale (discrete element method).")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(commands)
    _add_ensemble(commands)
    _add_scenes(commands)
    _add_plot(commands)
    _add_render(commands)
    _add_vtk(commands)
    return top


def _command(commands, name, action, text):
    command = commands.add_parser(name, help=text, description=text)
    command.set_defaults(action=action)
    return command


def _add_setup(command, scene_optional=False):
    command.add_argument(
        "scene", nargs="?" if scene_optional else None, metavar="SCENE", help="a stock scene's name, or a .toml file"
    )
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help='change the scene, such as --set material.restitution=0.3 (see "dem_jax scenes NAME" for all keys)',
    )  # fmt: skip
    command.add_argument("--seed", type=_seed, default=0, help="of the arrangement of a portion (default: 0)")
    command.add_argument("--duration", type=float, metavar="S", help="s from the release; as --set run.duration=S")
    command.add_argument("--out", metavar="FILE", help="HDF5 file to write (default: the scene's name .h5)")
    command.add_argument("--overwrite", action="store_true", help="replace an existing file")
    command.add_argument("--no-plot", action="store_true", help="do not draw the figure beside the file")
    command.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_run(commands):
    command = _command(commands, "run", run, "Simulate a scene: an HDF5 file, a figure and a summary.")
    _add_setup(command, scene_optional=True)
    command.add_argument("--resume", metavar="FILE", help="go on with the run in a file instead of a scene")


def _add_ensemble(commands):
    command = _command(commands, "ensemble", ensemble, "Simulate a scene with many seeds at once.")
    _add_setup(command)
    command.add_argument("--runs", type=_positive, default=64, metavar="K", help="number of runs (default: 64)")


def _add_scenes(commands):
    command = _command(commands, "scenes", scenes, "List the stock scenes, or print one with all its keys.")
    command.add_argument("name", nargs="?", metavar="SCENE", help="print this scene as TOML: every key, unit and value")


def _add_plot(commands):
    command = _command(commands, "plot", plot, "Draw product impact force and settled mass over time.")
    command.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    command.add_argument("--out", metavar="FILE", help=".png, .pdf or .svg (default: the file's name .png)")
    command.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    command.add_argument("--block", help="block of the settled mass (default: wb, or the first)")
    command.add_argument("--start", type=float, metavar="S", help="s, where the time axis begins")
    command.add_argument("--end", type=float, metavar="S", help="s, where it ends")


def _add_render(commands):
    command = _command(commands, "render", render, "Draw the scene with its pieces: animation, picture or film strip.")
    _add_stored(command)
    kind = command.add_mutually_exclusive_group()
    kind.add_argument("--gif", action="store_true", help="an animation (default)")
    kind.add_argument("--png", action="store_true", help="a picture of the end")
    kind.add_argument("--at", type=float, metavar="S", help="a picture of the time S (s)")
    kind.add_argument(
        "--strip", type=_strip, metavar="N|T,T,...", help="a film strip: of N instants, or of these times (s)"
    )
    command.add_argument("--out", metavar="FILE", help="default: the file's name .gif, or -scene.png")
    command.add_argument("--colour", choices=["speed", "piece"], default="speed", help="of the pieces (default: speed)")
    command.add_argument("--azimuth", type=float, default=25.0, metavar="DEG", help="of the eye about z (default: 25)")
    command.add_argument("--elevation", type=float, default=14.0, metavar="DEG", help="of the eye (default: 14)")


def _add_vtk(commands):
    command = _command(commands, "vtk", vtk, "Export the stored poses for ParaView.")
    _add_stored(command)
    command.add_argument("--out", metavar="FOLDER", help="default: the file's name -vtk")


def _add_stored(command):
    command.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    command.add_argument("--run", type=_seed, default=0, metavar="K", help="which run of an ensemble (default: 0)")


def _positive(text):
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: a whole number of at least 1")
    return int(text)


def _seed(text):
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: a whole number of at least 0")
    return int(text)


def _strip(text):
    try:
        return int(text) if text.isdecimal() else [float(t) for t in text.split(",")]
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r}: allowed: a number of instants, or times (s) with commas"
        ) from error


# --- commands ---


def run(args):
    """python -m dem_jax run"""
    if (args.scene is None) == (args.resume is None):
        raise SceneError("run: allowed: either a SCENE or --resume FILE")
    if args.resume and (args.settings or args.out or args.seed):
        raise SceneError("run --resume: allowed beside it: --duration, --no-plot, --quiet; the rest is in the file")
    _use_cache()
    if args.resume:
        from dem_jax.drive.run import resume

        return _finish(resume(args.resume, args.duration, progress=not args.quiet), Path(args.resume), args)
    scene, out = _scene_and_target(args, "")
    from dem_jax.drive.run import simulate

    return _finish(simulate(scene, args.seed, out, args.overwrite, progress=not args.quiet), out, args)


def ensemble(args):
    """python -m dem_jax ensemble"""
    _use_cache()
    scene, out = _scene_and_target(args, "-ensemble")
    from dem_jax.drive.ensemble import ensemble as together

    done = together(scene, args.runs, args.seed, out, args.overwrite, progress=not args.quiet)
    return _finish(done, out, args)


def scenes(args):
    """python -m dem_jax scenes"""
    from dem_jax.scene import described, load_scene, stock_scenes

    if args.name:
        print(described(load_scene(args.name)), end="")
        return
    known = stock_scenes()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")


def plot(args):
    """python -m dem_jax plot"""
    from dem_jax.show.plot import plot_run
    from dem_jax.store.record import load_run

    out = args.out or Path(args.file).with_suffix(".png")
    print(plot_run(load_run(args.file), out, args.group, args.block, args.start, args.end))


def render(args):
    """python -m dem_jax render"""
    from dem_jax.show.render import Camera
    from dem_jax.show.render import render as draw

    run, bodies = _stored(args)
    still = args.png or args.at is not None or args.strip is not None
    path = Path(args.file)
    out = args.out or (path.with_name(f"{path.stem}-scene.png") if still else path.with_suffix(".gif"))
    camera = Camera(args.azimuth, args.elevation)
    print(draw(run.pieces, *bodies, out, at=args.at, strip=args.strip, camera=camera, colour=args.colour))


def vtk(args):
    """python -m dem_jax vtk"""
    from dem_jax.show.vtk import export_vtk

    run, (shapes, walls, wall_pose) = _stored(args)
    if run.pieces is None:
        raise RecordError(f"{args.file}: the run has no frames; set run.frames to the time between them (s)")
    path = Path(args.file)
    for made in export_vtk(run.pieces, shapes, args.out or path.with_name(f"{path.stem}-vtk"), walls, wall_pose):
        print(made)


def _stored(args):
    """A run of a file, and what drawing.bodies_of finds of its scene."""
    from dem_jax.show.drawing import bodies_of
    from dem_jax.store.record import load_run

    found = load_run(args.file)
    if found.run_count is not None:
        found = found.member(args.run)
    elif args.run:
        raise RecordError(f"--run {args.run}: {args.file} holds a single run")
    return found, bodies_of(found)


def _scene_and_target(args, suffix):
    from dem_jax.scene import load_scene, parse_setting
    from dem_jax.store.record import check_target

    changes = dict(parse_setting(text) for text in args.settings)
    if args.duration is not None:
        changes["run.duration"] = args.duration
    scene = load_scene(args.scene, changes)
    out = Path(args.out or f"{scene.name}{suffix}.h5")
    check_target(out, args.overwrite)
    return scene, out


def _finish(done, out, args):
    """Draw the figure and print the summary."""
    from dem_jax.show.summary import summary

    files = [out]
    if not args.no_plot and done.force:
        from dem_jax.show.plot import plot_run

        files.append(plot_run(done, out.with_suffix(".png")))
    for line in summary(done):
        print(line)
    print(f"wrote {', '.join(map(str, files))}")


def _use_cache():
    """Keep compiled programs in the user's cache folder, so that a second start need not compile.

    JAX_COMPILATION_CACHE_DIR names another folder.
    """
    import jax

    if not jax.config.jax_compilation_cache_dir:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(base) / "dem_jax" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


if __name__ == "__main__":
    sys.exit(main())
