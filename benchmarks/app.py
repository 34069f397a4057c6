"""Time from ``dem-jax app`` until one sees the first drop fall, and until its numbers are there.

A person who changes nothing and clicks at once: the page Drop, the button, the pieces in 3-D. With
an empty cache of compiled programs, then with the one that it left. Needs chromium and playwright. Run:
``python -m benchmarks app``.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks import report

PATIENCE = 600_000  # ms
SEEN = 5  # frames after the release: pieces have begun to fall
ASKED = {"empty": 20.0, "warm": 6.0}  # s, until it falls
EVENTS = ("address", "page", "click", "it falls", "numbers")
GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def sum_processor_time(parent: int) -> float:
    """Processor time (s) of a process and of all that it has started, also of those that have ended, as Linux tells it."""
    stats = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            words = path.read_text(encoding="utf-8").rpartition(")")[2].split()
            stats[int(path.parent.name)] = int(words[1]), sum(map(int, words[11:15]))
    own = {parent}
    while more := {pid for pid, (of, _) in stats.items() if of in own} - own:
        own |= more
    return sum(stats[pid][1] for pid in own if pid in stats) / os.sysconf("SC_CLK_TCK")


def time_first_drop(cache: str, launch: Callable[[], Any]) -> tuple[list[float], float]:
    """Seconds from the start of the app to each of EVENTS, and the processor time (s) of the app
    until it falls.

    Args:
        cache: folder of compiled programs.
        launch: starts a browser.
    """
    own = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, "XDG_CACHE_HOME": cache}
    own |= {
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
    }
    browser = launch()
    tab = browser.new_page(viewport={"width": 1280, "height": 900})
    tab.set_default_timeout(PATIENCE)
    start, times = time.perf_counter(), []
    note = lambda: times.append(time.perf_counter() - start)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "dem_jax", "app", folder, "--no-browser"]
        app = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=own)
        try:
            address = [app.stdout.readline() for _ in range(2)][1].strip()
            note()
            tab.goto(address)
            tab.get_by_role("heading", level=1).first.wait_for()
            note()
            tab.get_by_role("navigation").get_by_role("link", name="Drop").click()
            tab.get_by_role("button", name="Drop", exact=True).click()
            note()
            canvas = tab.frame_locator("iframe").locator("canvas[data-frame]")
            canvas.wait_for()
            while int(canvas.get_attribute("data-frame")) < SEEN:
                time.sleep(0.02)
            note()
            spent = sum_processor_time(app.pid)
            tab.get_by_text("time to weigh").first.wait_for()
            note()
        finally:
            browser.close()
            app.terminate()
            app.wait(30)
    return times, spent


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the same, written to out/benchmarks")
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))))
    machine = report.environment()
    rows = []
    with sync_playwright() as started, tempfile.TemporaryDirectory() as cache:
        launch = lambda: started.chromium.launch(
            executable_path=browser, args=["--no-sandbox", *GRAPHICS]
        )
        for name, asked in ASKED.items():
            times, spent = time_first_drop(cache, launch)
            rows.append([name, *(f"{t:.1f}" for t in times), f"{asked:g}", f"{spent:.1f}"])
    text = f"""# From `dem-jax app` to the first drop

{machine}; load at the end {os.getloadavg()[0]:.2f}

Seconds from the start of the command, of a person who changes nothing and clicks at once; the browser, which draws without a
graphics card, is open. "It falls": pieces that have left the feed bucket are shown. Asked: until then. The processor time is that of
the app and its processes until then, without the browser: on a busy machine it tells more than the clock.

{report.table(("cache of programs", *EVENTS, "asked: it falls", "processor time"), rows)}
"""
    report.write("app", text, options.quick)


if __name__ == "__main__":
    main()
