"""Memory that portions need, and available memory."""

import os
from pathlib import Path

from product_model.inputs import BadInput, Parameters

GIGABYTE = 1e9
NUMBERS_TO_COMPUTE = 4, 15  # for each sample and each pulse of a portion, measured
NUMBERS_TO_SAVE = 12, 20  # the same, with the arrays of a file
LIMIT_FILES = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current")  # of a container


def portion_bytes(
    samples: int, pulses: int, itemsize: int, numbers: tuple[int, int] = NUMBERS_TO_COMPUTE
) -> int:
    """Bytes that one portion needs while it is computed, or with NUMBERS_TO_SAVE until it is in a
    file.
    """
    return itemsize * (numbers[0] * samples + numbers[1] * pulses)


def count_pulses(params: Parameters, pieces: int) -> int:
    """Number of pulses of a portion, to which its memory is proportional; the extended model has a
    few for each piece.
    """
    return pieces if params.landings is None else pieces * (1 + sum(params.landings.impacts))


def available_memory() -> int | None:
    """Bytes available to this process, None if the system does not report them."""
    found = [_available_in_system(), _available_in_container()]
    return min((number for number in found if number is not None), default=None)


def _available_in_system() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(
            1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")
        )
    except (OSError, ValueError, StopIteration):
        pass
    try:  # macOS does not say how much is free
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _available_in_container() -> int | None:
    try:
        limit, used = (int(Path(name).read_text(encoding="ascii")) for name in LIMIT_FILES)
        return max(limit - used, 0)
    except (OSError, ValueError):
        return None


def check_memory(runs: int, needed: int, advice: str) -> None:
    """Raise `BadInput` where `runs` portions need more bytes than are available. advice: how to use
    less memory.
    """
    available = available_memory()
    if available is not None and needed > available:
        raise BadInput(
            f"runs = {runs}: needs {needed / GIGABYTE:.1f} GB of memory, and {available / GIGABYTE:.1f} GB are available; {advice}"
        )
