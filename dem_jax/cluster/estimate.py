"""How long tasks will take, in words: before they begin, and from those that are done."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from dem_jax.cluster.tasks import Pool

UNITS = ((86400.0, "day"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
COMPILE_TIME = 8.0  # s of a core, of a program that was not compiled before


@dataclass(frozen=True)
class TaskCost:
    """Estimated cost of a task: work (s on one core), and the most cores that it can use."""

    work: float
    width: int

    def on(self, cores: int) -> float:
        """Time (s) on a number of cores."""
        rounds = -(-self.width // max(1, min(cores, self.width)))
        return self.work * rounds / self.width


@dataclass
class Estimate:
    """Estimated time of the tasks that are left; corrected by those that are done."""

    costs: Sequence[TaskCost]
    pool: Pool
    expected: float = 0.0  # s, of the tasks that are done
    elapsed: float = 0.0  # s that these took
    compiled: float = 0.0  # s of compiling in it
    left: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.left = set(range(len(self.costs)))

    def add(self, number: int, elapsed: float, compiled: float) -> None:
        """Learn from a task that is done."""
        self.left.discard(number)
        self.expected += self.costs[number].on(self.pool.cores)
        self.elapsed += elapsed
        self.compiled += compiled

    def remaining(self) -> float:
        """Time (s) until all are done, of as many workers as the pool has."""
        rate = (self.elapsed - self.compiled) / self.expected if self.expected else 1.0
        each = [rate * self.costs[n].on(self.pool.cores) for n in self.left]
        compiling = 0.0 if self.expected else COMPILE_TIME
        return compiling + max(sum(each) / self.pool.size, max(each, default=0.0))


def format_duration(seconds: float) -> str:
    """A time in one or two digits: about 40 s, 12 min, 2.5 h, 3 days."""
    for size, unit in UNITS:
        if seconds >= 1.5 * size or size == 1.0:
            amount = seconds / size
            digits = f"{amount:.2g}" if amount < 99.5 else f"{amount:.0f}"
            return f"{digits} {unit}{'s' if unit == 'day' else ''}"
    raise AssertionError("UNITS ends with seconds")
