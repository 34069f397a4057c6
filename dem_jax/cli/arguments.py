"""Shared parts of the commands: the parser, and types that validate arguments."""

import argparse
from collections.abc import Callable
from typing import Any, NoReturn

BAD_INPUT = 2  # exit code

Args = argparse.Namespace
Commands = Any  # the type that add_subparsers returns is private to argparse


class Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line; its help ends with ``more``, which is computed on
    request.
    """

    more: Callable[[], str] | None = None

    def format_help(self) -> str:
        """The text of the help, with ``more`` at its end."""
        return super().format_help() + (f"\n{self.more()}" if self.more else "")

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        self.exit(BAD_INPUT, f"{self.prog}: {join_lines(message)} (see --help)\n")


def join_lines(message: object) -> str:
    """The message without line breaks."""
    return " ".join(str(message).split())


def create_command(
    commands: Commands, name: str, action: Callable[[Args], None], text: str, now: str | None = None
) -> Parser:
    """A command that calls ``action``. now: the command that replaces it; the former one still
    works, but is not in the list of commands.
    """
    if now is None:
        made = commands.add_parser(name, help=text, description=text)
    else:
        made = commands.add_parser(name, description=f"{text} Now: dem-jax {now}.")
    made.set_defaults(action=action)
    return made


def quantity_table() -> str:
    """A table of the sampled quantities."""
    from dem_jax.dynamics.quantity import format_quantity_table
    from dem_jax.dynamics.standard_quantities import QUANTITIES

    return format_quantity_table(QUANTITIES)


def positive_int(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: a whole number of at least 1")
    return int(text)


def nonnegative_int(text: str) -> int:
    """A whole number of at least 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: a whole number of at least 0")
    return int(text)


def parse_instants(text: str) -> int | str | list[float]:
    """A number of instants, times (s) with commas, or "auto"."""
    if text == "auto":
        return text
    try:
        return int(text) if text.isdecimal() else [float(t) for t in text.split(",")]
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r}: allowed: a number of instants, times (s) with commas, or auto"
        ) from error
