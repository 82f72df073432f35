"""A film of pictures, H.264 in an MP4 file, by PyAV."""

import os
from fractions import Fraction
from pathlib import Path

import av

from tactip_model.errors import TactipError


def write_film(path, pictures, rate=25):
    """Write pictures, an iterable of (h, w, 3) uint8 of one even size, as a film. rate: int, pictures a second.

    Returns how many. The file appears when it is complete. Raises TactipError where it cannot be written.
    """
    path, count = Path(path), 0
    part = path.with_name(f".{path.name}.part")
    try:
        with av.open(str(part), "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=Fraction(rate))
            stream.pix_fmt, stream.options = "yuv420p", {"crf": "22", "preset": "veryfast"}
            for picture in pictures:
                if not count:
                    stream.height, stream.width = picture.shape[:2]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                count += 1
            container.mux(stream.encode())
        os.replace(part, path)
    except OSError as error:
        raise TactipError(f"cannot write the film {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return count
