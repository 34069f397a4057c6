"""Animations from a series of pictures: GIF, or MP4 by ffmpeg."""

import io
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import check_writable, write_atomically


def write_animation(pictures: Iterable[np.ndarray], path: Path, fps: float) -> Path:
    """Write pictures [height, width, 3] uint8, all of one size, at fps per second, as .gif or .mp4.
    Returns the path.

    Raises RecordError for a file that cannot be written, and for .mp4 without imageio-ffmpeg.
    """
    check_writable(path)
    return write_atomically(
        path,
        _encode_mp4(pictures, path, fps)
        if path.suffix.lower() == ".mp4"
        else _encode_gif(pictures, fps),
    )


def _encode_gif(pictures: Iterable[np.ndarray], fps: float) -> memoryview:
    """Encode pictures as a GIF that loops."""
    from PIL import Image

    first, *rest = (Image.fromarray(p).quantize(256, dither=Image.Dither.NONE) for p in pictures)
    image = io.BytesIO()
    first.save(
        image, "GIF", save_all=True, append_images=rest, duration=max(20, round(1000 / fps)), loop=0
    )
    return image.getbuffer()


def _encode_mp4(pictures: Iterable[np.ndarray], path: Path, fps: float) -> bytes:
    """Encode pictures as MP4 (H.264), which needs even sizes: the last row and column may be left
    out.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        words = (
            "needs imageio-ffmpeg: pip install 'product-impact[video]'; allowed without it: .gif"
        )
        raise RecordError(f"{path} {words}") from error
    even = (p[: p.shape[0] // 2 * 2, : p.shape[1] // 2 * 2] for p in pictures)
    with tempfile.TemporaryDirectory() as folder:  # it does not write to memory
        made = Path(folder) / "made.mp4"
        problem = _run_ffmpeg(get_ffmpeg_exe(), even, made, fps)
        if problem:
            raise RecordError(f"{path} cannot be written: ffmpeg: {problem}")
        return made.read_bytes()


def _run_ffmpeg(ffmpeg_program: str, pictures: Iterator[np.ndarray], path: Path, fps: float) -> str:
    """Run ffmpeg; returns its error message, "" without an error."""
    first = next(pictures)
    size = f"{first.shape[1]}x{first.shape[0]}"
    taken = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", "-"]
    made = [
        "-c:v",
        "libx264",
        "-crf",
        "20",
        "-pix_fmt",
        "yuv420p",
        "-movflags",
        "+faststart",
        str(path),
    ]
    # Not by imageio_ffmpeg.write_frames, which forks a process in which JAX has threads.
    with subprocess.Popen(
        [ffmpeg_program, "-y", "-v", "error", *taken, *made], stdin=PIPE, stderr=PIPE
    ) as ffmpeg:
        assert ffmpeg.stdin is not None and ffmpeg.stderr is not None
        with suppress(BrokenPipeError):  # it has ended: its complaint is read below
            for picture in chain([first], pictures):
                ffmpeg.stdin.write(np.ascontiguousarray(picture).tobytes())
            ffmpeg.stdin.close()
        said = ffmpeg.stderr.read().decode(errors="replace").strip()
    if not ffmpeg.returncode:
        return ""
    return said.splitlines()[-1] if said else f"it ended with {ffmpeg.returncode}"
