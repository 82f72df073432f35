"""Export of a data set or a servo run to LeRobot's format.

A contact is an episode, of one frame or of those of its sliding path; a run is one episode of its control steps. The folder
`tactip` keeps what the features do not have, so `restore.py` gives back what was exported.
"""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.dataset.format import FORCES, Dataset, encode_image, read_dataset, read_meta, read_parts, read_pins
from tactip_twin.sim.dataset.pressed_object import OBJECT
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.lerobot.writer import Feature, LeRobotWriter
from tactip_twin.sim.pose import inverse, to_mm_deg
from tactip_twin.sim.robot.recording import RECORDING, SCENERY, STEPS, read_recording
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_file

IMAGE, PINS, DIRECTIONS = "observation.images.tactile", "observation.pin_tips", "observation.pin_directions"
"""Features of image and pins: x, y and z of each pin tip, m, and of each direction, sensor frame (3 p). They are vectors,
because LeRobot's own tools cannot copy matrices."""

KEPT = "tactip"
"""Folder of the files of ours that are kept beside LeRobot's."""

RUN_FILES = (RECORDING, SCENERY, STEPS)
"""Files of a run that are kept. Of a set, all are but images and pins."""


def export_lerobot(folder: Path, out: Path, fps: int) -> tuple[int, int]:
    """Write a data set or a recording in LeRobot's format.

    Args:
        folder: Folder of a finished set, or of a complete recording.
        out: Folder to write; it must not exist.
        fps: Frames per second that the format states: contacts and control steps have no rate of their own.

    Returns:
        The numbers of episodes and frames.

    Raises:
        TactipError: If `folder` is neither, `out` exists, fps is below 1, or the extra `lerobot` is not installed.
        OSError: If a file cannot be written.
    """
    require(fps >= 1, "fps", fps, "at least 1")
    if out.exists():
        raise TactipError(f"{out} must not exist: choose another folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    # Renamed at the end, so an interrupted export leaves nothing that looks complete.
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        counts = (_export_run if (folder / RECORDING).exists() else _export_set)(folder, partial, fps)
        partial.chmod(0o755)
        partial.rename(out)
    finally:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(partial)
    return counts


def _export_set(folder: Path, out: Path, fps: int) -> tuple[int, int]:
    meta = read_meta(folder)
    whole = meta["samples"]["kept"]
    if not whole:
        raise TactipError(f"the set in {folder} has no samples: at least one is needed")
    writer, episodes, task = None, 0, f"press the tactile fingertip on a {meta['configuration']['task']}"
    _keep(folder, out / KEPT, ["meta.json"])
    for part, own in read_parts(folder, meta):
        _keep(part, out / KEPT / part.relative_to(folder), ["meta.json", *(n for n in own["files"] if n != "pins.npz")])
        if not own["images"]:
            continue
        dataset = read_dataset(part)
        arrays = read_pins(part, own) if dataset.simulated else None
        if writer is None:
            writer = LeRobotWriter(out, _set_features(dataset, arrays), fps, whole)
        for rows in _contacts(dataset, own["configuration"]):
            writer.add_episode(_set_frames(dataset, arrays, rows), task)
            episodes += 1
    assert writer is not None  # noqa: S101
    writer.finish()
    return episodes, whole


def _set_features(dataset: Dataset, pins: tuple[np.ndarray, np.ndarray] | None) -> dict[str, Feature]:
    """Return the features of a set's frames. pins: pin tips and directions (n, p, 3) of a simulated set."""
    size = len(dataset.image(0))
    features = {IMAGE: Feature("image", (size, size, 3), ("height", "width", "channels"))}
    features |= {"label": Feature("float32", (6,), _with_units(LABELS))}
    features |= {"observation.shear": Feature("float32", (6,), _with_units(SHEARS))}
    if pins is not None:
        features |= _pin_features(pins[0].shape[1]) | {"observation.force": Feature("float32", (3,), FORCES)}
    return features


def _set_frames(
    dataset: Dataset, pins: tuple[np.ndarray, np.ndarray] | None, rows: slice
) -> dict[str, list[bytes] | np.ndarray]:
    """Return the frames of some rows of a set in one folder."""
    frames: dict[str, list[bytes] | np.ndarray] = {
        IMAGE: [_png(dataset.image(i)) for i in range(rows.start, rows.stop)],
        "label": dataset.poses[rows],
        "observation.shear": dataset.shears[rows],
    }
    if pins is not None:
        count = rows.stop - rows.start
        frames |= {PINS: pins[0][rows].reshape(count, -1), DIRECTIONS: pins[1][rows].reshape(count, -1)}
        frames["observation.force"] = np.stack([dataset.measures[name][rows] for name in FORCES], 1)
    return frames


def _contacts(dataset: Dataset, configuration: dict[str, Any]) -> Iterator[slice]:
    """Yield the rows of each contact whose samples follow each other; those made by symmetry stand alone."""
    each = configuration.get("snapshots_per_contact", 1)
    indices = np.arange(len(dataset.images))
    if each > 1 and not configuration["augment_symmetry"]:
        names = [int(name.removeprefix("image_").removesuffix(".png")) for name in dataset.images]
        indices = np.array(names) // each
    start = 0
    for _, rows in groupby(indices):
        end = start + len(list(rows))
        yield slice(start, end)
        start = end


def _export_run(folder: Path, out: Path, fps: int) -> tuple[int, int]:
    record, arrays = read_recording(folder)
    count = record["steps"]
    if not record["complete"] or not count or not record["size_px"]:
        raise TactipError(f"the recording in {folder} must be complete, with steps and images")
    size, pins = record["size_px"], arrays["pin_tips_m"].shape[1]
    pose = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    motion = ("x_m", "y_m", "z_m", "Rx_rad", "Ry_rad", "Rz_rad")
    features = {
        IMAGE: Feature("image", (size, size, 3), ("height", "width", "channels")),
        "observation.state": Feature("float32", (7,), pose),
        **_pin_features(pins),
        "observation.force": Feature("float32", (3,), FORCES),
        "observation.predicted": Feature("float32", (6,), _with_units(LABELS)),
        "label": Feature("float32", (6,), _with_units(LABELS)),
        "action": Feature("float32", (6,), motion),
    }
    writer = LeRobotWriter(out, features, fps, count)
    _keep(folder, out / KEPT, RUN_FILES)
    frames = {
        IMAGE: [_png(image) for image in arrays["images"]],
        "observation.state": _poses(arrays["T_base_tcp_measured"]),
        PINS: arrays["pin_tips_m"].reshape(count, -1),
        DIRECTIONS: arrays["directions"].reshape(count, -1),
        "observation.force": arrays["force_n"],
        "observation.predicted": np.nan_to_num(np.stack([to_mm_deg(label) for label in arrays["predicted"]])),
        "label": np.stack([to_mm_deg(label) for label in arrays["true"]]),
        "action": _motions(arrays["T_base_tcp_measured"]),
    }
    writer.add_episode(frames, f"follow the {record['task']} of {record['object']} by touch")
    writer.finish()
    return 1, count


def _pin_features(pins: int) -> dict[str, Feature]:
    """Return the features of pins. pins: their number."""
    names = [f"pin_{k}_{axis}" for k in range(pins) for axis in "xyz"]
    return {
        PINS: Feature("float32", (3 * pins,), tuple(f"{name}_m" for name in names)),
        DIRECTIONS: Feature("float32", (3 * pins,), tuple(names)),
    }


def _with_units(columns: tuple[str, ...]) -> tuple[str, ...]:
    """Return names of components with their units."""
    return tuple(f"{name}_{'deg' if '_R' in name else 'mm'}" for name in columns)


def _poses(T: np.ndarray) -> np.ndarray:
    """Return position, m, and scalar-first quaternion (n, 7) of poses (n, 4, 4)."""
    return np.concatenate([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)], 1)


def _motions(T: np.ndarray) -> np.ndarray:
    """Return the motion (n, 6), m and rad, from each pose (n, 4, 4) to the next, in the sensor frame; 0 at the end."""
    steps = np.stack([inverse(a) @ b for a, b in zip(T, [*T[1:], T[-1]], strict=True)])
    return np.concatenate([steps[:, :3, 3], Rotation.from_matrix(steps[:, :3, :3]).as_rotvec()], 1)


def _png(image: np.ndarray) -> bytes:
    """Return an image (h, w) as a PNG of three equal channels, which policies for cameras take."""
    return encode_image(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


def _keep(folder: Path, kept: Path, names: Sequence[str]) -> None:
    """Copy files of ours, and the object of a set and the record of how it was made, if there are any."""
    kept.mkdir(parents=True, exist_ok=True)
    for name in (*names, *(name for name in (OBJECT, "run.json") if (folder / name).exists())):
        (kept / name).write_bytes(read_file(folder / name))
