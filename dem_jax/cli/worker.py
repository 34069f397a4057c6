"""python -m dem_jax.cli.worker: one command of the app, in a process that has imported all modules
before.

The first line of standard input is JSON: {"program": "dem_jax", "argv": ["run", "weigh-bucket"]}.
The worker acts as ``python -m PROGRAM ARGV``, with the same output and exit code.
"""

import json
import sys
from collections.abc import Callable

PROGRAMS = ("dem_jax", "calibrate", "product_model")


def main() -> int:
    """Wait for a command, and run it; the exit code."""
    _import_ahead()
    line = sys.stdin.readline()
    if not line:
        return 0
    order = json.loads(line)
    sys.argv = [order["program"], *order["argv"]]
    return _find_main(order["program"])()


def _import_ahead() -> None:
    """Import the modules that a simulation needs, so that it begins at once."""
    import jax  # noqa: F401

    import dem_jax.runner.interface
    import dem_jax.visualization.summary  # noqa: F401


def _find_main(program: str) -> Callable[[], int]:
    if program == "dem_jax":
        from dem_jax.cli.main import main as found
    elif program == "calibrate":
        from calibrate.__main__ import main as found
    elif program == "product_model":
        from product_model.__main__ import main as found
    else:
        raise ValueError(f"{program}: allowed: {', '.join(PROGRAMS)}")
    return found


if __name__ == "__main__":
    sys.exit(main())
