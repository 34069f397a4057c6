"""Runs the code of Markdown pages, block by block, each page in a folder of its own: python and sh blocks are executed, a toml
block is written to the file that its first line names.

python .ci/follow.py PAGE ...
"""

import re
import subprocess
import sys
import time
from pathlib import Path

BLOCK = re.compile(r"^```(python|sh|toml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHELL = ["bash", "-euo", "pipefail", "-c"]


def follow(page: Path) -> float:
    """Run a page; the time (s) that it took."""
    folder = Path.cwd() / page.stem
    folder.mkdir()
    whole = 0.0
    for kind, code in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind == "toml":
            (folder / code.splitlines()[0].removeprefix("# ")).write_text(code, encoding="utf-8")
            continue
        steps = (
            [[sys.executable, "-c", code]]
            if kind == "python"
            else [[*SHELL, line] for line in code.splitlines()]
        )
        for step in steps:
            begin = time.perf_counter()
            subprocess.run(step, cwd=folder, check=True)
            took = time.perf_counter() - begin
            whole += took
            print(f"[{page.stem}: {took:.1f} s] {step[-1].splitlines()[0]}", flush=True)
    return whole


if __name__ == "__main__":
    for name in sys.argv[1:]:
        path = Path(name).with_suffix(".md").resolve()
        print(f"== {path.stem}: {follow(path):.0f} s in all", flush=True)
