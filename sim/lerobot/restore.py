"""Import of a data set or a servo run that `export.py` wrote: images and pins come from LeRobot's files."""

import contextlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.dataset.format import (
    checksum,
    encode_image,
    pack_pins,
    read_configuration,
    read_meta,
    read_parts,
    read_rows,
)
from tactip_twin.sim.labels import LABELS
from tactip_twin.sim.lerobot.export import DIRECTIONS, IMAGE, KEPT, PINS, RUN_FILES
from tactip_twin.sim.lerobot.writer import INFO, VERSION, pyarrow_modules
from tactip_twin.sim.robot.recording import RECORDING, read_recording
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_file, read_json
from tactip_twin.tactip_model.input_images import decode_image

_BATCH = 256
"""Number of frames that are read at a time."""

_MAX_DIFFERENCE = 1e-4
"""Maximum difference of a label in LeRobot's table from ours, mm and degrees: it is rounded to float32."""


def restore(folder: Path, out: Path) -> int:
    """Write the set or the run that was exported; return the number of its frames.

    Args:
        folder: Data set in LeRobot's format, as `export_lerobot` writes it.
        out: Folder to write; it must not exist.

    Raises:
        TactipError: If `folder` is something else or was changed, or `out` exists.
        OSError: If a file cannot be written.
    """
    info = read_json(folder / INFO) if (folder / INFO).exists() else None
    kept = folder / KEPT
    if not isinstance(info, dict) or info.get("codebase_version") != VERSION or not kept.is_dir():
        raise TactipError(f"{folder} must be a LeRobot data set of version {VERSION} that `tactip dataset export` wrote")
    if out.exists():
        raise TactipError(f"{out} must not exist: choose another folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        count = (_restore_run if (kept / RECORDING).exists() else _restore_set)(folder, kept, partial)
        partial.chmod(0o755)
        partial.rename(out)
    finally:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(partial)
    return count


def _restore_set(folder: Path, kept: Path, out: Path) -> int:
    meta, frames, count = read_meta(kept), _frames(folder), 0
    for part, own in read_parts(kept, meta):
        place = out / part.relative_to(kept)
        (place / "images").mkdir(parents=True)
        rows, tips, directions = read_rows(part, own), [], []
        for row in rows:
            frame = next(frames, None)
            poses = [float(row[name]) for name in LABELS]
            if frame is None or not np.allclose(frame.label, poses, rtol=0, atol=_MAX_DIFFERENCE):
                raise TactipError(f"frame {count} of {folder} must have the label {poses} of {row['sensor_image']}")
            # Encoded as the images of sets are; another version of OpenCV may give other bytes.
            data = encode_image(frame.image)
            own["images"][row["sensor_image"]] = checksum(data)
            write_file(place / "images" / row["sensor_image"], data, sync=False)
            if frame.pins is not None:
                tips.append(frame.pins[0])
                directions.append(frame.pins[1])
            count += 1
        for path in part.iterdir():
            if path.is_file():
                write_file(place / path.name, read_file(path))
        if "pins.npz" in own["files"]:
            data = pack_pins(read_configuration(own, part), tips, directions)
            own["files"]["pins.npz"] = checksum(data)
            write_file(place / "pins.npz", data)
        data = (json.dumps(own, indent=1) + "\n").encode()
        write_file(place / "meta.json", data)
        if "shards" in meta:
            meta["files"][f"{part.name}/meta.json"] = checksum(data)
    if next(frames, None) is not None:
        raise TactipError(f"{folder} must have {count} frames, as the set that was exported, and has more")
    if "shards" in meta:
        for path in (path for path in kept.iterdir() if path.is_file()):
            write_file(out / path.name, read_file(path))
        write_file(out / "meta.json", (json.dumps(meta, indent=1) + "\n").encode())
    return count


def _restore_run(folder: Path, kept: Path, out: Path) -> int:
    for name in RUN_FILES:
        write_file(out / name, read_file(kept / name))
    _, arrays = read_recording(out)
    images, frames = arrays["images"], list(_frames(folder))
    if len(frames) != len(images) or not all(np.array_equal(f.image, i) for f, i in zip(frames, images, strict=True)):
        raise TactipError(f"the frames of {folder} must be those of the recording that was exported")
    return len(frames)


@dataclass(frozen=True)
class _Frame:
    """What is read of a frame."""

    image: np.ndarray
    """(size, size) uint8."""
    label: np.ndarray
    """(6,) mm and degrees."""
    pins: tuple[np.ndarray, np.ndarray] | None
    """Pin tips and directions (p, 3), float32, or None."""


def _frames(folder: Path) -> Iterator[_Frame]:
    """Yield the frames in LeRobot's files, in order. Raises TactipError if one is damaged."""
    arrow, parquet = pyarrow_modules()
    for path in sorted(folder.glob("data/*/*.parquet")):
        try:
            file = parquet.ParquetFile(path)
            with_pins = PINS in file.schema_arrow.names
            columns = [IMAGE, "label", *((PINS, DIRECTIONS) if with_pins else ())]
            for batch in file.iter_batches(_BATCH, columns=columns):
                images = batch.column(IMAGE).field("bytes").to_pylist()
                labels = batch.column("label").flatten().to_numpy().reshape(-1, 6)
                pins = [_matrices(batch.column(name), len(images)) for name in (PINS, DIRECTIONS)] if with_pins else None
                for i, (data, label) in enumerate(zip(images, labels, strict=True)):
                    image = decode_image(data, f"an image in {path}")
                    yield _Frame(image, label, None if pins is None else (pins[0][i], pins[1][i]))
        except (arrow.ArrowException, KeyError, ValueError, TypeError, OSError) as error:
            raise TactipError(f"{path} is damaged: {error}") from error


def _matrices(column: Any, count: int) -> np.ndarray:
    """Return the matrices (count, p, 3) float32 of a column of vectors."""
    return column.flatten().to_numpy().astype(np.float32).reshape(count, -1, 3)
