"""A folder of real images with the commands of the rig that took them, in its published format.

init_0.png                neutral image (any name that begins with init or neutral; it may lie beside the frames)
images/*.png or *.png     binary frames
targets.csv               image_name or sensor_image; pose_1 … pose_6 and move_1 … move_6, mm and degrees, in the rig's frame
meta.json                 tap_move: the tap that makes contact, after the commanded pose, mm and degrees

Or without meta.json, with labels in the project's own conventions, as `tactip protocol` writes them:

targets.csv               image_name or sensor_image; pose_x … pose_Rz, shear_x … shear_Rz, mm and degrees (sim/pose.py)
"""

import contextlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.column_map import Angles
from tactip_twin.sim2real.importing.source import MAX_TAP_MM, find_neutral_image
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import parse_table, read_file, read_json
from tactip_twin.tactip_model.input_images import read_image

_NAMES = ("image_name", "sensor_image")

_MAX_VALUE = 1e5
"""Maximum of a pose or a move, mm or degrees: more than any rig's."""

_TAP_M = 5e-3
"""Length of the tap of poses that are labels: any will do, because they hold it already, m."""


@dataclass(frozen=True)
class RealSet:
    """Frames of a real sensor and the rig's commands for each. (n frames)"""

    folder: Path
    """Folder that it was read from."""
    files: tuple[Path, ...]
    """The frames, n of them."""
    poses: np.ndarray
    """(n, 6) float: commanded poses in the rig's frame, m and rad."""
    moves: np.ndarray
    """(n, 6) float: commanded motions in contact that lead to the poses, m and rad."""
    tap: np.ndarray
    """(6,) float: the tap after each pose that makes contact, m and rad."""
    neutral: np.ndarray
    """(h, w) uint8: the undeformed tip."""

    def frame(self, index: int) -> np.ndarray:
        """Return frame `index`, (h, w) uint8. Raises TactipError if it cannot be read or its size differs."""
        frame = read_image(self.files[index])
        if frame.shape != self.neutral.shape:
            sizes = (f"{i.shape[1]}×{i.shape[0]} px" for i in (self.neutral, frame))
            raise TactipError(f"{self.files[index]} must be {next(sizes)} like the neutral image, got {next(sizes)}")
        return frame


def read_real_set(folder: str | Path, angles: Angles = "vector") -> RealSet:
    """Return the RealSet in a folder. Raises TactipError that names what is missing or does not fit.

    Args:
        folder: The folder.
        angles: Convention of the angles in a table of `tactip protocol`, as it was given there.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise TactipError(
            f"{folder} is not a folder: it must hold targets.csv, frames and a neutral image init* or neutral*"
        )
    rows = _rows(folder / "targets.csv")
    name = next((n for n in _NAMES if n in rows[0]), None)
    labelled = set(LABELS) <= set(rows[0])
    columns = (
        [list(LABELS), list(SHEARS)] if labelled else [[f"{kind}_{k}" for k in range(1, 7)] for kind in ("pose", "move")]
    )
    missing = [c for group in columns for c in group if c not in rows[0]]
    if name is None or missing:
        what = f"none of {', '.join(_NAMES)}" if name is None else f"no {', '.join(missing)}"
        raise TactipError(
            f"{folder / 'targets.csv'} has {what}: columns must be image_name, pose_1 … pose_6, move_1 … move_6, or those "
            "of tactip protocol"
        )
    for number, row in enumerate(rows, 1):
        short = [c for c in (name, *columns[0], *columns[1]) if row[c] is None]
        if short:
            raise TactipError(f"{folder / 'targets.csv'}: row {number} ends before {short[0]}: it must have all the columns")
    try:
        numbers = [np.array([[float(row[c]) for c in group] for row in rows]) for group in columns]
    except ValueError as error:
        raise TactipError(f"{folder / 'targets.csv'}: {error}") from error
    if not all((np.abs(n) <= _MAX_VALUE).all() for n in numbers):
        raise TactipError(f"{folder / 'targets.csv'} has poses or moves that are not within ±{_MAX_VALUE:g} mm or degrees")
    files = tuple(_found(folder, row[name]) for row in rows)
    neutral = find_neutral_image(folder, files)
    if neutral is None:
        raise TactipError(f"{folder} has no neutral image: add one named init* or neutral*, such as neutral.png")
    first, second = (from_mm_deg(n) for n in numbers)
    poses, moves, tap = _commands(first, second, angles) if labelled else (first, second, _tap(folder / "meta.json"))
    return RealSet(folder, files, poses, moves, tap, read_image(neutral))


def _commands(poses: np.ndarray, shears: np.ndarray, angles: Angles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the commands of a rig whose axes are those of the contact frame, as in RealSet, m and rad: poses (n, 6) before
    the tap, moves (n, 6) and tap (6,).

    Args:
        poses: (n, 6) labels, m and rad.
        shears: (n, 6) what they are more than where contact was made, component by component, as in the table.
        angles: Convention of the angles of both.
    """
    tap = np.array([0, 0, -_TAP_M, 0, 0, 0])
    read = Rotation.from_rotvec if angles == "vector" else partial(Rotation.from_euler, angles)
    ends, starts = (
        np.concatenate([one[:, :3], read(one[:, 3:]).as_euler("xyz")], 1) - tap for one in (poses, poses - shears)
    )
    return ends, ends - starts, tap


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        raise TactipError(f"{path} does not exist: it must name the frames and their poses")
    _, rows = parse_table(read_file(path), str(path))
    if not rows:
        raise TactipError(f"{path} has no rows")
    return rows


def _found(folder: Path, name: str) -> Path:
    for path in (folder / "images" / name, folder / name):
        with contextlib.suppress(OSError):  # a name that is too long for a file
            if path.is_file():
                return path
    raise TactipError(f"the frame {name:.100} does not exist in {folder} or its folder images")


def _tap(path: Path) -> np.ndarray:
    if not path.exists():
        raise TactipError(f"{path} does not exist: it must give tap_move, the tap that makes contact, mm and degrees")
    try:
        tap = np.array(read_json(path)["tap_move"], float)
    except (ValueError, KeyError, TypeError) as error:
        raise TactipError(f"{path} must give tap_move, six numbers in mm and degrees: {error}") from error
    if tap.shape != (6,) or not (np.abs(tap) <= MAX_TAP_MM).all() or not tap[:3].any() or tap[3:].any():
        raise TactipError(
            f"tap_move in {path} must be a translation of at most {MAX_TAP_MM:g} mm along each axis, six numbers in mm and "
            f"degrees, got {tap.tolist()}"
        )
    return from_mm_deg(tap)
