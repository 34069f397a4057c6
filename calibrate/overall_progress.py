"""One progress bar over stages of different kinds, with the remaining time: that of the present
stage from its own progress, that of later stages from estimates.
"""

import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from product_model.program import QuietStream, set_open_line

TICK, LOGGED = 0.5, 10.0  # s between two looks of the bar: on a screen, in a log
FORMAT = "{desc}: {percentage:3.0f}% |{bar}| [{elapsed}{postfix}]"


class Stage(NamedTuple):
    """A part of the work. seconds: its expected duration, before it has begun."""

    name: str
    seconds: float


class OverallProgress:
    """A bar over stages. A context manager; silent where `shown` is False."""

    def __init__(self, stages: Sequence[Stage], shown: bool = True) -> None:
        self._stages, self._shown = list(stages), shown
        self._begun = self._since = time.perf_counter()
        self._current, self._share, self._words = 0, 0.0, ""
        self._done = 0.0  # of all, which never decreases
        self._bar: Any = None
        self._ended = threading.Event()
        self._clock: threading.Thread | None = None

    def __enter__(self) -> Self:
        if self._shown:
            from tqdm import tqdm

            self._bar = tqdm(
                total=1.0, file=QuietStream(sys.stderr), bar_format=FORMAT, dynamic_ncols=True
            )
            set_open_line(True)
            self._clock = threading.Thread(target=self._refresh, daemon=True)
            self._clock.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._clock is not None:
            self._clock.join()
        if self._bar is not None:
            self._bar.close()
            set_open_line(False)

    def begin(self, name: str) -> None:
        """Begin the stage of this name."""
        self._current = next(k for k, stage in enumerate(self._stages) if stage.name == name)
        self._since, self._share, self._words = time.perf_counter(), 0.0, name
        self._draw()

    def tell(self, words: str, share: float) -> None:
        """Report progress: the finished share of the present stage. words: its description."""
        self._words, self._share = words, min(max(share, 0.0), 1.0)
        self._draw()

    @property
    def left(self) -> float:
        """Remaining time (s), from the pace of the present stage and the estimates of later ones."""
        stage, spent = self._stages[self._current], time.perf_counter() - self._since
        expected = max(stage.seconds, spent)
        if self._share > 0.0:  # its own pace counts the more, the more of it is done
            expected += self._share * (spent / self._share - expected)
        own = max(expected - spent, 0.0)
        return own + sum(later.seconds for later in self._stages[self._current + 1 :])

    def _draw(self) -> None:
        if self._bar is None:
            return
        spent, left = time.perf_counter() - self._begun, self.left
        self._done = max(self._done, spent / max(spent + left, 1e-9))
        stage = self._stages[self._current].name
        words = stage if self._words in ("", stage) else f"{stage} ({self._words})"
        self._bar.n = self._done
        self._bar.set_description_str(words, refresh=False)
        self._bar.set_postfix_str(f"about {_format_clock(left)} left", refresh=False)
        self._bar.refresh()

    def finish(self) -> None:
        """Complete the bar."""
        self._stages, self._current, self._share = [Stage("done", 0.0)], 0, 1.0
        self._words, self._done = "done", 1.0
        self._draw()

    def _refresh(self) -> None:
        while not self._ended.wait(
            TICK if sys.stderr is not None and sys.stderr.isatty() else LOGGED
        ):
            self._draw()


def _format_clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
