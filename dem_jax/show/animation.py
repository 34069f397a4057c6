"""Pictures one after another as a file that plays: GIF, or MP4 by ffmpeg."""

import subprocess
from collections.abc import Iterable
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE

import numpy as np

from dem_jax.errors import RecordError


def write(pictures: Iterable[np.ndarray], path: Path, fps: float) -> Path:
    """Write pictures [height, width, 3] uint8, all of one size, at fps per second, as .gif or .mp4. Returns the path.

    Raises RecordError for a file that cannot be written, and for .mp4 without imageio-ffmpeg.
    """
    try:
        return _mp4(pictures, path, fps) if path.suffix.lower() == ".mp4" else _gif(pictures, path, fps)
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {error.strerror or error}") from error


def _gif(pictures: Iterable[np.ndarray], path: Path, fps: float) -> Path:
    """Loops."""
    from PIL import Image

    first, *rest = (Image.fromarray(p).quantize(256, dither=Image.Dither.NONE) for p in pictures)
    first.save(path, save_all=True, append_images=rest, duration=max(20, round(1000 / fps)), loop=0)
    return path


def _mp4(pictures: Iterable[np.ndarray], path: Path, fps: float) -> Path:
    """H.264, which takes even sizes only: the last row and column may be left out."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        words = "needs imageio-ffmpeg: pip install 'product-impact[video]'; allowed without it: .gif"
        raise RecordError(f"{path} {words}") from error
    path.touch()  # what cannot be written is found here: ffmpeg says it at length
    even = (p[: p.shape[0] // 2 * 2, : p.shape[1] // 2 * 2] for p in pictures)
    first = next(even)
    size = f"{first.shape[1]}x{first.shape[0]}"
    taken = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", "-"]
    made = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path.absolute())]
    # Not by imageio_ffmpeg.write_frames, which forks a process in which JAX has threads.
    with subprocess.Popen([get_ffmpeg_exe(), "-y", "-v", "error", *taken, *made], stdin=PIPE, stderr=PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None and ffmpeg.stderr is not None
        with suppress(BrokenPipeError):  # it has ended: what went wrong is read below
            for picture in chain([first], even):
                ffmpeg.stdin.write(np.ascontiguousarray(picture).tobytes())
            ffmpeg.stdin.close()
        said = ffmpeg.stderr.read().decode(errors="replace").strip()
    if ffmpeg.returncode:
        raise RecordError(f"{path} cannot be written: ffmpeg: {said.splitlines()[-1] if said else ffmpeg.returncode}")
    return path
