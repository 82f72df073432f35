"""Video files: H.264 in .mp4 (by PyAV), or .gif (by Pillow)."""

import itertools
import os
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from PIL import Image

from tactip_twin.tactip_model.errors import TactipError

ENDINGS = (".mp4", ".gif")

_GIF_WIDTH = 960
"""Maximum width of a GIF, px."""

_GIF_COLORS = 256


def write_video(path: str | os.PathLike[str], frames: Iterable[np.ndarray], rate: int = 25) -> int:
    """Write a video. The file appears when it is complete.

    Args:
        path: File to write, .mp4 or .gif.
        frames: Frames (h, w, 3) uint8, of one even size.
        rate: Frames per second.

    Returns:
        Number of frames.

    Raises:
        TactipError: If the file has another ending, there is no frame, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise TactipError(f"a video file must end in one of {', '.join(ENDINGS)}, got {path}")
    if not path.parent.is_dir() or path.is_dir():  # before anything is rendered
        what = "it is a folder" if path.is_dir() else f"there is no folder {path.parent}"
        raise TactipError(f"cannot write {path}: {what}")
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise TactipError(f"cannot write {path}: the recording has no steps")
    part = path.with_name(f".{path.name}.part")
    write = _gif if path.suffix.lower() == ".gif" else _mp4
    try:
        count = write(part, itertools.chain([first], iterator), rate)
        os.replace(part, path)
    except OSError as error:
        raise TactipError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return count


def _mp4(path: Path, frames: Iterator[np.ndarray], rate: int) -> int:
    count = 0
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate))
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "22", "preset": "veryfast"}
        for frame in frames:
            if not count:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            count += 1
        container.mux(stream.encode())
    return count


def _gif(path: Path, frames: Iterator[np.ndarray], rate: int) -> int:
    images = []
    for frame in frames:
        height = round(frame.shape[0] * min(1.0, _GIF_WIDTH / frame.shape[1]))
        small = cv2.resize(frame, (min(frame.shape[1], _GIF_WIDTH), height), interpolation=cv2.INTER_AREA)
        images.append(Image.fromarray(small).quantize(_GIF_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
    images[0].save(path, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / rate), loop=0)
    return len(images)
