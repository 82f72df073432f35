"""Pictures one after another as a file: a film (.mp4, H.264, by PyAV) or a GIF (by Pillow)."""

import itertools
import os
from fractions import Fraction
from pathlib import Path

import av
import cv2
from PIL import Image

from tactip_twin.tactip_model.errors import TactipError

ENDINGS = (".mp4", ".gif")

_GIF_WIDTH = 560
"""Width to which a GIF is made smaller, px."""

_GIF_COLOURS = 128


def write_video(path, pictures, rate=25):
    """Write pictures, an iterable of (h, w, 3) uint8 of one even size, as a film or, where `path` ends in .gif, a GIF.

    rate: int, pictures a second. Returns how many. The file appears when it is complete. Raises TactipError where its name
    ends otherwise, there is no picture, or it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise TactipError(f"{path} does not say what it is to be: its name ends in one of {', '.join(ENDINGS)}")
    if not path.parent.is_dir() or path.is_dir():  # before anything is drawn
        what = "it is a folder" if path.is_dir() else f"there is no folder {path.parent}"
        raise TactipError(f"cannot write {path}: {what}")
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise TactipError(f"there is nothing to be seen in {path}: no step was recorded")
    part = path.with_name(f".{path.name}.part")
    write = _gif if path.suffix.lower() == ".gif" else _mp4
    try:
        count = write(part, itertools.chain([first], pictures), rate)
        os.replace(part, path)
    except OSError as error:
        raise TactipError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return count


def _mp4(path, pictures, rate):
    count = 0
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate))
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "22", "preset": "veryfast"}
        for picture in pictures:
            if not count:
                stream.height, stream.width = picture.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            count += 1
        container.mux(stream.encode())
    return count


def _gif(path, pictures, rate):
    frames = []
    for picture in pictures:
        height = round(picture.shape[0] * min(1.0, _GIF_WIDTH / picture.shape[1]))
        small = cv2.resize(picture, (min(picture.shape[1], _GIF_WIDTH), height), interpolation=cv2.INTER_AREA)
        frames.append(Image.fromarray(small).quantize(_GIF_COLOURS, dither=Image.Dither.NONE))
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=round(1000 / rate), loop=0)
    return len(frames)
