"""Command line: `logger | python -m product_model weigh weigher.json`: a reading for each sample as
it comes."""

import argparse
import sys
from collections.abc import Iterator
from typing import Any, TextIO

import numpy as np

from product_model.inputs import BadInput

TEXT = (
    "Read samples of a load cell (g, with the tare), one in each line, from the standard input or "
    "a file. For each sample print the time (s), the net weight (g), its standard deviation (g), "
    "the status (empty, estimate or fallback) and the reason of a fallback."
)


def add_weigh_command(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "weigh", help="readings of a scale as its samples come, by an estimator", description=TEXT
    )
    parser.add_argument("weigher", metavar="weigher.json", help="of calibrate weigher")
    parser.add_argument(
        "samples",
        nargs="?",
        default="-",
        metavar="FILE",
        help="file of samples (default -: standard input)",
    )
    parser.add_argument(
        "--column",
        type=int,
        metavar="N",
        help="column of the samples, from 1 on (default: the last)",
    )
    parser.add_argument(
        "--decide",
        type=float,
        metavar="G",
        help="print one line for each portion, as soon as its error is within G grams",
    )
    parser.add_argument(
        "--confidence",
        type=float,
        default=0.99,
        metavar="P",
        help="of --decide, from 0.5 to below 1 (default 0.99)",
    )
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="print each N-th reading (default 1)"
    )


def weigh(args: argparse.Namespace) -> None:
    """Print a reading for each sample. Raises `BadInput`."""
    from product_model.decision import check_decision
    from product_model.weigher_file import load_weigher

    if args.every < 1:
        raise BadInput(f"every = {args.every}: allowed: at least 1")
    if args.column is not None and args.column < 1:
        raise BadInput(f"column = {args.column}: allowed: at least 1")
    if args.decide is not None:
        check_decision(args.decide, args.confidence)
    weigher = load_weigher(args.weigher)
    if args.samples == "-":
        _print(weigher, read_samples(sys.stdin, "standard input", args.column), args)
        return
    try:
        with open(args.samples, encoding="utf-8") as file:
            _print(weigher, read_samples(file, args.samples, args.column), args)
    except OSError as error:
        raise BadInput(f"{args.samples}: cannot be read ({error.strerror or error})") from None


def _print(weigher: Any, samples: Iterator[float], args: argparse.Namespace) -> None:
    """Print a line for each reading, or for each portion the one that counts."""
    from product_model.decision import is_decided
    from product_model.weigher import EMPTY, STATUS, Reading, describe_doubts

    state, is_open = weigher.start(), True
    print("time_s,grams,sd_g,status,doubts", flush=True)
    for number, sample in enumerate(samples):
        state, found = weigher.feed(state, np.float64(sample))
        reading = Reading(*map(np.asarray, found))
        if args.decide is not None:
            is_open = is_open or int(reading.status) == EMPTY
            if not (is_open and bool(is_decided(reading, args.decide, args.confidence))):
                continue
            is_open = False
        elif number % args.every:
            continue
        time = f"{number * float(weigher.interval):.9g}"
        words = f"{STATUS[int(reading.status)]},{describe_doubts(int(reading.doubts))}"
        print(f"{time},{float(reading.grams):.4f},{float(reading.sd):.4f},{words}", flush=True)


def read_samples(lines: TextIO, name: str, column: int | None = None) -> Iterator[float]:
    """Yield the numbers of a column (None: the last) of lines as they arrive; the first line may be
    a header. Raises `BadInput`."""
    for number, line in enumerate(lines, 1):
        cells = line.replace(";", ",").replace("\t", ",").split(",")
        if not line.strip():
            continue
        if column is not None and column > len(cells):
            raise BadInput(
                f"{name}: line {number}: {len(cells)} columns, allowed: at least {column}"
            )
        cell = cells[-1 if column is None else column - 1].strip()
        try:
            value = float(cell)
        except ValueError:
            if number == 1:
                continue
            raise BadInput(f"{name}: line {number}: {cell!r}: allowed: a number (g)") from None
        if not np.isfinite(value):
            raise BadInput(f"{name}: line {number}: {cell!r}: allowed: a finite number (g)")
        yield value
