"""Command line: `python -m product_model simulate ...`, `stream ...`, `fmu ...`, `c ...`, `weigh
...` and `table`.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from product_model.inputs import DTYPES, FORMS, BadInput, Parameters, checked_seed, table
from product_model.program import QuietStream, run_program, set_open_line, temporary_file
from product_model.weigh_command import add_weigh_command, weigh

if TYPE_CHECKING:
    import numpy as np

    from product_model.fitted import Fitted
    from product_model.monte_carlo import Summary
    from product_model.portion import Trace
    from product_model.weigher import Weigher


class _Parser(argparse.ArgumentParser):
    """Parser that reports an error in one line and exits with code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


BLOCK_BYTES = 2**28  # of memory for portions that are computed at a time

FLAGS = {
    "m_target": ("KG", float, "target weight of the portion"),
    "m_piece": ("KG", float, "weight of one piece"),
    "pieces": ("N", int, "number of pieces (default: eq. 16)"),
    "h_mean": ("M", float, "mean drop height"),
    "dt_impact": ("S", float, "length of the pulse of one piece"),
    "gamma_low": ("M", float, "lower limit of sigma_height"),
    "gamma_high": ("M", float, "upper (three-sigma) limit of sigma_height"),
    "sample": ("S", float, "sample time"),
    "start": ("S", float, "beginning of the trace after release"),
    "duration": ("S", float, "length of the trace (default: until the pieces have landed)"),
    "gravity": ("M/S2", float, "acceleration due to gravity"),
    "smooth_width": ("S", float, "width of the smooth form"),
}


FMU_TEXT = (
    "Write a functional mock-up unit for co-simulation. It is compiled from C, contains the library for this platform and the "
    "sources for others, and needs no Python. Without a C compiler a unit of FMI 2.0 is written that runs the Python beside it."
)
C_TEXT = (
    "Write a model as C99: product_model.h and product_model.c (no dependency, no allocated memory), its parameters "
    "(product_model_parameters.h), an example (main.c) and README.txt with the line that compiles it. --precision f32 computes in "
    "single precision."
)


WEIGHER_TEXT = (
    "weigher.json of calibrate weigher: its estimator of the weight instead of the Product Model"
)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="product_model", description="Impact-force curves of the Product Model")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)
    commands.add_parser("table", help="inputs and outputs of the model, defaults and their sources")
    simulate = commands.add_parser("simulate", help="random portions, written to a file")
    _add_inputs(simulate, FORMS)
    simulate.add_argument(
        "--draw",
        action="store_true",
        help="each portion with parameters of its own, drawn from the intervals of --fit or --product",
    )
    simulate.add_argument(
        "--runs", type=int, default=1, metavar="K", help="number of random portions (default 1)"
    )
    simulate.add_argument(
        "--out", default="trace.h5", metavar="FILE", help=".h5, .csv or .mat (default trace.h5)"
    )
    simulate.add_argument("--plot", metavar="FILE", help="also draw a figure (.png, .pdf or .svg)")
    simulate.add_argument(
        "--overwrite", "--force", action="store_true", help="replace files that exist"
    )
    streamed = commands.add_parser(
        "stream",
        help="one random portion sample by sample, as lines of a table on the standard output",
    )
    _add_inputs(streamed, FORMS[:2])
    unit = commands.add_parser(
        "fmu",
        help="a functional mock-up unit for Simulink, OpenModelica and the like",
        description=FMU_TEXT,
    )
    _add_inputs(unit, FORMS)
    unit.add_argument("out", metavar="OUT", help=".fmu")
    unit.add_argument(
        "--fmi",
        choices=("2", "3"),
        default="2",
        help="version of the standard: 2.0 or 3.0 (default 2)",
    )
    unit.add_argument(
        "--python",
        action="store_true",
        help="a unit that runs the Python beside it, instead of C (FMI 2.0)",
    )
    unit.add_argument("--overwrite", action="store_true", help="replace a file that exists")
    unit.add_argument("--weigher", metavar="FILE", help=WEIGHER_TEXT)
    sources = commands.add_parser(
        "c", help="C99 source files of a model, for any machine", description=C_TEXT
    )
    _add_inputs(sources, FORMS)
    sources.add_argument(
        "--out", default="product_model_c", metavar="DIR", help="folder (default product_model_c)"
    )
    sources.add_argument("--overwrite", action="store_true", help="replace files that exist")
    sources.add_argument("--weigher", metavar="FILE", help=WEIGHER_TEXT)
    add_weigh_command(commands)
    return parser


def _add_inputs(parser: argparse.ArgumentParser, forms: Sequence[str]) -> None:
    """Add the flags of all inputs; the value of a flag that is not given is None."""
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--fit",
        metavar="FILE",
        help="fit.json of `calibrate fit`: its parameters, unless given here",
    )
    source.add_argument(
        "--product",
        metavar="NAME|PRODUCT.toml",
        help="extended model of a product that need not be simulated, predicted from its properties",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="KEY=VALUE",
        help="with --product: change the scene, such as --set drop.height=0.25",
    )
    for name, (metavar, kind, text) in FLAGS.items():
        default = getattr(Parameters, name)
        shown = "" if default is None else f" (default {default:g})"
        flags = [f"--{name.replace('_', '-')}", *(["--target"] if name == "m_target" else [])]
        parser.add_argument(*flags, metavar=metavar, type=kind, help=text + shown)
    parser.add_argument(
        "--form",
        choices=forms,
        default=Parameters.form,
        help=f"pulse form (default {Parameters.form})",
    )
    parser.add_argument(
        "--precision", choices=tuple(DTYPES), default=Parameters.precision, help="default f64"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default 0)"
    )


def _inputs(args: argparse.Namespace) -> tuple[Parameters, "Fitted | None"]:
    """The inputs, and the fit. Inputs that are not given come from the fit or the product, else
    from the defaults."""
    from product_model import parameters, read_fit
    from product_model.fitted import FITTED

    given = {name: getattr(args, name) for name in FLAGS if getattr(args, name) is not None}
    if args.settings and not args.product:
        raise BadInput("set: changes the scene of a product; give --product")
    known: dict[str, Any] = {}
    fit = None
    if args.product:
        fit, known = _predict(args)
    elif args.fit:
        fit = read_fit(args.fit)
        if "m_target" not in given:  # which with m_piece decides the number of pieces
            known["pieces"] = fit.pieces
    if fit is not None:
        known |= {name: fit.value[name] for name in FITTED} | {
            "m_piece": fit.m_piece,
            "landings": fit.landings,
        }
    given = {name: value for name, value in known.items() if value is not None} | given
    return parameters(form=args.form, precision=args.precision, **given), fit


def _predict(args: argparse.Namespace) -> tuple["Fitted", dict[str, Any]]:
    """The predicted model of a product, and the inputs that follow from its scene.

    Prints the uncertainty of the prediction and the effects that it neglects on standard error.
    """
    from dem_jax.errors import SceneError
    from dem_jax.scene import parse_setting
    from product_model.conditions import product_conditions
    from product_model.transfer import describe_prediction, predict_parameters

    if args.m_piece is not None:
        raise BadInput(f"m_piece = {args.m_piece:g}: follows from the product; give one of these")
    try:
        settings = dict(parse_setting(text) for text in args.settings)
    except SceneError as error:
        raise BadInput(str(error)) from None
    gravity = {} if args.gravity is None else {"run.gravity": (0.0, 0.0, -args.gravity)}
    drop, notes = product_conditions(args.product, args.m_target, args.pieces, settings | gravity)
    for line in [*describe_prediction(drop), *notes]:
        print(f"note: {line}", file=sys.stderr)
    return predict_parameters(drop), {"pieces": drop.pieces, "gravity": drop.gravity}


def _simulate(args: argparse.Namespace) -> None:
    from product_model import drawn, ensemble, save
    from product_model.monte_carlo import summarize
    from product_model.output_path import check_target
    from product_model.record import check_output

    params, fit = _inputs(args)
    checked_seed(args.seed)
    if args.runs < 1:
        raise BadInput(f"runs = {args.runs}: must be at least 1")
    if args.draw and fit is None:
        raise BadInput("draw: needs the intervals of a fit; give --fit FILE or --product NAME")
    check_output(args.out, args.overwrite)
    if args.plot:
        check_target(
            "plot", args.plot, (".png", ".pdf", ".svg"), ".png, .pdf or .svg", args.overwrite
        )
    varied = {}
    if args.draw and fit is not None:
        varied = {
            name: values
            for name, values in drawn(fit, args.runs, args.seed).items()
            if getattr(args, name, None) is None
        }
    block = _block_size(params, args, varied)
    if args.runs > block:
        _report(_save_in_blocks(params, args, varied, block), params, args)
        return
    trace = ensemble(params, args.seed, args.runs, varied)
    if args.runs == 1:
        import jax
        import numpy as np

        trace = jax.tree.map(lambda leaf: np.asarray(leaf)[0], trace)
        varied = {name: values[0] for name, values in varied.items()}
    save(args.out, trace, params, seed=args.seed, overwrite=args.overwrite, varied=varied)
    _plot(trace, args)
    _report(summarize(trace), params, args)


def _block_size(
    params: Parameters, args: argparse.Namespace, varied: Mapping[str, "np.ndarray"]
) -> int:
    """Number of portions in a block; prints a note if the file becomes large.

    Raises `BadInput` where a table of all portions does not fit into memory.
    """
    import numpy as np

    from product_model.inputs import DTYPES, count_pieces
    from product_model.memory import (
        GIGABYTE,
        NUMBERS_TO_SAVE,
        check_memory,
        count_pulses,
        portion_bytes,
    )
    from product_model.monte_carlo import widest_grid
    from product_model.record import SUFFIXES, file_bytes

    samples, itemsize = (
        widest_grid(params, varied).samples,
        np.dtype(DTYPES[params.precision]).itemsize,
    )
    one = portion_bytes(
        samples, count_pulses(params, count_pieces(params)), itemsize, NUMBERS_TO_SAVE
    )
    if Path(args.out).suffix not in SUFFIXES[:2]:
        check_memory(
            args.runs,
            args.runs * one,
            "write to .h5, which is done in blocks, or give a larger --sample",
        )
        return args.runs
    size = file_bytes(args.runs, samples, itemsize)
    if size > GIGABYTE:
        words = f"{args.runs} portions of {samples} samples make a file of {size / GIGABYTE:.1f} GB"
        print(
            f"note: {words}, which is written in blocks; a larger --sample makes it smaller",
            file=sys.stderr,
        )
    return max(1, BLOCK_BYTES // one)


def _save_in_blocks(
    params: Parameters, args: argparse.Namespace, varied: Mapping[str, "np.ndarray"], block: int
) -> "Summary":
    """Write portions in several blocks, with a progress bar. The figure is that of the first block."""
    from tqdm import tqdm

    from product_model.monte_carlo import ensemble_blocks, join_summaries, summarize
    from product_model.record import save_blocks

    parts: list[Summary] = []
    bar = tqdm(total=args.runs, unit="portion", file=QuietStream(sys.stderr))

    def summarized() -> Iterator["Trace"]:
        for trace in ensemble_blocks(params, args.seed, args.runs, block, varied):
            if not parts:
                _plot(trace, args)
            parts.append(summarize(trace))
            yield trace
            bar.update(len(trace.force))

    set_open_line(True)
    try:
        save_blocks(
            args.out,
            summarized(),
            args.runs,
            params,
            seed=args.seed,
            overwrite=args.overwrite,
            varied=varied,
        )
    finally:
        bar.close()
        set_open_line(False)
    if args.plot:
        print(
            f"note: the figure is that of the first {len(parts[0].peaks.first)} portions",
            file=sys.stderr,
        )
    return join_summaries(parts)


def _plot(trace: "Trace", args: argparse.Namespace) -> None:
    """Draw the figure if one is requested."""
    if not args.plot:
        return
    from product_model.plot import figure

    try:
        with temporary_file(Path(args.plot)) as part:
            figure(trace).savefig(part, dpi=150, format=Path(args.plot).suffix[1:])
    except OSError as error:
        raise BadInput(
            f"plot = {args.plot}: cannot be written ({error.strerror or error})"
        ) from None


STREAMED = 256  # samples computed at a time


def _stream(args: argparse.Namespace) -> None:
    """Print a line for each sample as soon as it is known, until the last one of the trace."""
    import jax
    import numpy as np

    from product_model import stream
    from product_model.inputs import build_grid
    from product_model.portion import in_precision

    params, _ = _inputs(args)
    grid, gravity = build_grid(params), float(params.gravity)
    state = stream.start(params, args.seed)
    several = jax.jit(
        lambda state: jax.lax.scan(
            lambda state, _: stream.step(state), state, None, length=STREAMED
        )
    )
    print("time_s,force_n,pif_g")
    times = grid.times()
    for first in range(0, grid.samples, STREAMED):
        with in_precision(params):
            state, force = several(state)
        rows = zip(times[first : first + STREAMED], np.asarray(force).tolist(), strict=False)
        lines = [f"{time:.9g},{value:.9g},{1e3 * value / gravity:.9g}\n" for time, value in rows]
        sys.stdout.write("".join(lines))
        sys.stdout.flush()


def _fmu(args: argparse.Namespace) -> None:
    """Write a unit, print its path, and its kind on standard error."""
    from product_model.fmu import check_fmu, write_fmu
    from product_model.fmu_compiled import find_compiler, write_compiled_fmu

    check_fmu(args.out, args.overwrite)
    if args.weigher:
        from product_model.weigher_export import write_weigher_fmu

        print(write_weigher_fmu(args.out, _read_weigher(args), args.overwrite, args.fmi))
        return
    params, _ = _inputs(args)
    compiler = None if args.python else find_compiler()
    if compiler is not None:
        print(write_compiled_fmu(args.out, params, args.seed, args.overwrite, args.fmi))
        words = f"the unit (FMI {args.fmi}.0) is compiled by {compiler} for this platform"
        print(f"{words} and has the C sources for others", file=sys.stderr)
        return
    if args.fmi == "3":
        missing = (
            "compiled C; omit --python" if args.python else "a C compiler (cc, gcc, clang, or CC)"
        )
        raise BadInput(f"fmi = 3: needs {missing}")
    print(write_fmu(args.out, params, args.seed, args.overwrite))
    reason = "" if args.python else "no C compiler found: "
    words = (
        "the unit (FMI 2.0) runs the Python beside it, in which product-impact must be installed"
    )
    print(reason + words, file=sys.stderr)


def _c(args: argparse.Namespace) -> None:
    from product_model.c_export import write_c

    if args.weigher:
        from product_model.weigher_export import write_weigher_c

        folder = write_weigher_c(args.out, _read_weigher(args), args.overwrite)
        print(f"written: {folder}; compile: cc -std=c99 -O2 -o example main.c weigher.c -lm")
        return
    params, _ = _inputs(args)
    folder = write_c(args.out, params, args.seed, args.overwrite)
    print(f"written: {folder}; compile: cc -std=c99 -O2 -o example main.c product_model.c -lm")


def _read_weigher(args: argparse.Namespace) -> "Weigher":
    """The estimator of --weigher, which allows no input of the model. Raises `BadInput`."""
    from product_model.weigher_file import load_weigher

    usual: dict[str, Any] = {
        "fit": None,
        "product": None,
        "settings": [],
        "form": Parameters.form,
        "python": False,
    }
    usual |= dict.fromkeys(FLAGS) | {"precision": Parameters.precision, "seed": 0}
    for name, value in usual.items():
        if getattr(args, name, value) != value:
            flag = "set" if name == "settings" else name.replace("_", "-")
            raise BadInput(f"weigher: an estimator has no inputs of the model; omit --{flag}")
    return load_weigher(args.weigher)


def _report(summary: "Summary", params: Parameters, args: argparse.Namespace) -> None:
    from product_model.monte_carlo import QUANTILES

    print(
        f"{args.runs} portion(s) of {summary.pieces} pieces of {float(params.m_piece) * 1e3:g} g, "
        f"{summary.grid.samples} samples of {summary.grid.sample * 1e6:g} us, {params.form}, {params.precision}"
    )
    print("quantile".ljust(22) + "".join(f"{100 * q:>10.0f} %" for q in QUANTILES))
    units = {
        "peak_kg": ("peak PIF (g)", 1e3),
        "peak_time": ("its time (ms)", 1e3),
        "first": ("first impact (ms)", 1e3),
        "duration": ("total duration (ms)", 1e3),
    }
    for name, values in summary.peaks.quantiles().items():
        print(units[name][0].ljust(22) + "".join(f"{units[name][1] * v:>12.2f}" for v in values))
    print(
        f"drop heights drawn again because negative: {summary.redrawn}; pulses not over at the end: {summary.late}"
    )
    if summary.late:
        print(
            "warning: the trace ends before all pieces have landed; give a longer --duration",
            file=sys.stderr,
        )
    print(f"written: {args.out}" + (f", {args.plot}" if args.plot else ""))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2 on bad input, with one line on stderr)."""
    return run_program("product_model", lambda: _run(argv), (BadInput,))


def _run(argv: Sequence[str] | None) -> None:
    args = _parser().parse_args(argv)
    if args.command == "table":
        print(table())
        return
    if args.command == "weigh":
        weigh(args)
        return
    checked_seed(args.seed)
    {"simulate": _simulate, "stream": _stream, "fmu": _fmu, "c": _c}[args.command](args)


if __name__ == "__main__":
    sys.exit(main())
