"""Progress of a run, on stderr, so that stdout holds only the summary."""

import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self

from dem_jax.process import SilentStream
from dem_jax.runner.job import Job

if TYPE_CHECKING:
    from dem_jax.runner.chunk_result import ChunkResult

SCREEN_INTERVAL, LOG_INTERVAL = 0.5, 5.0  # (s) between two looks of the bar: on a screen, in a log


ProgressCallback = Callable[[str, float], object]  # called with a description of the work, and its
# finished share


class Progress:
    """A progress bar with simulated time, speed and remaining time, shown only on request. A
    context manager.
    """

    def __init__(self, job: Job, shown: bool | ProgressCallback) -> None:
        """shown: whether there is a bar, or a function that is called instead."""
        self._job = job
        self._tell: ProgressCallback | None = shown if callable(shown) else None
        shown = bool(shown) and self._tell is None
        self._bar: Any = None
        self._ended = threading.Event()
        self._stream = SilentStream(sys.stderr)
        self._clock: threading.Thread | None = None
        self._from = job.sample_index(job.state)
        self._share = 0.0
        self._since, self._compiled = time.perf_counter(), job.clock.compile
        if shown:
            from tqdm import tqdm

            total, ms = job.samples - self._from, 1e3 * job.scene.run.sample_interval
            below = None if sys.stderr.isatty() else 0  # a study's bar; in a log, which has one
            # line, no bar stands below another
            self._bar = tqdm(
                total=total,
                unit_scale=ms,
                file=self._stream,
                bar_format=FORMAT,
                dynamic_ncols=True,
                position=below,
            )
            self._bar.set_description_str(self._name_phase(self._from))
            self._clock = threading.Thread(
                target=_refresh_bar, args=(self._bar, self._ended), daemon=True
            )
            self._clock.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._clock is not None:
            self._clock.join()
        if self._bar is not None:
            self._bar.close()

    def _name_phase(self, at: int) -> str:
        return "settling" if at < 0 else "running"

    def show_compiling(self) -> None:
        """Show that a program is about to be compiled."""
        if self._tell is not None:
            self._tell("compiling", self._share)
        if self._bar is not None:
            self._bar.set_description_str("compiling")

    def show_note(self, text: str) -> None:
        """Show a note for the user above the bar."""
        if self._bar is not None:
            self._bar.write(text, file=self._stream)

    def show_chunk(self, span: "ChunkResult") -> None:
        """Show that a chunk is done."""
        left_out = span.find_next(self._job.samples) - span.end
        self._share = (span.end + left_out - self._from) / max(self._job.samples - self._from, 1)
        if self._tell is not None:
            self._tell(self._name_phase(span.end), self._share)
        if self._bar is None:
            return
        now, compiled = time.perf_counter(), self._job.clock.compile
        took = now - self._since - (compiled - self._compiled)
        steps = span.count * self._job.steps_per_sample * (self._job.runs or 1)
        self._since, self._compiled = now, compiled
        self._bar.set_postfix_str(f"{1e6 * took / steps:.3g} µs/step", refresh=False)
        self._bar.set_description_str(self._name_phase(span.end), refresh=False)
        self._bar.update(span.count + left_out)


def _refresh_bar(bar: Any, ended: threading.Event) -> None:
    """Keep the bar's clock running while a program compiles or a chunk is computed.

    The thread gets no other objects, as it must not be the one that frees the arrays of a run.
    """
    while not ended.wait(SCREEN_INTERVAL if sys.stderr.isatty() else LOG_INTERVAL):
        bar.refresh()


FORMAT = (
    "{desc}: {percentage:3.0f}% |{bar}| {n:.0f}/{total:.0f} ms [{elapsed} < {remaining}{postfix}]"
)
