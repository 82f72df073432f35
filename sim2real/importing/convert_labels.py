"""From a laboratory's table to labels in the conventions of sim/pose.py, as its Layout says."""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import from_mm_deg, label_of, matrix, sensor_in_contact, shear_between, to_mm_deg
from tactip_twin.sim2real.importing.column_map import parsed
from tactip_twin.tactip_model.errors import TactipError

IMAGE_COLUMNS = ("sensor_image", "image_name", "image", "filename", "sensor_video", "video_name", "video")
"""Names under which tables have their frames."""


def image_column(layout, columns):
    """The column (str) that names the frames, of a table's columns (list of str). Raises TactipError."""
    names = (layout.image_column,) if layout.image_column else IMAGE_COLUMNS
    for name in names:
        if name in columns:
            return name
    raise TactipError(f"the table has no column {' or '.join(names)} for the frames: its columns are {', '.join(columns)}")


def labels(layout, table):
    """Poses and shears (n, 6) each, mm and degrees, in the conventions of sim/pose.py; NaN where a cell is no number.

    table: dict of column to its cells (n,), str. Raises TactipError on a column that is not there, and where none is told or
    found.
    """
    told = dict(parsed(each) for each in layout.columns)
    found = [name for name in (*LABELS, *SHEARS) if name in table]
    if not told and not found:
        raise TactipError(
            "the table has none of our columns (pose_x … shear_Rz): say by --columns which is what, as pose_z=-pose_2-5; "
            f"its columns are {', '.join(name + _span(cells) for name, cells in table.items())}"
        )
    count = len(next(iter(table.values())))
    values = {name: _column(table, *told.get(name, (1.0, name if name in found else None, 0.0)), count) for name in LABELS}
    values |= {name: _column(table, *told.get(name, (1.0, name if name in found else None, 0.0)), count) for name in SHEARS}
    ends = from_mm_deg(np.stack([values[name] for name in LABELS], -1))
    moves = from_mm_deg(np.stack([values[name] for name in SHEARS], -1))
    out = [_ours(layout, end, end - move) for end, move in zip(ends, moves, strict=True)]
    return tuple(to_mm_deg(np.array(each)) for each in zip(*out, strict=True))


def _ours(layout, end, start):
    """Pose and shear (6,) m and rad of a motion from `start` to `end` (6,), in their conventions."""
    if not (np.isfinite(end).all() and np.isfinite(start).all()):
        return np.full(6, np.nan), np.full(6, np.nan)
    last, first = (_placed(layout, command) for command in (end, start))
    shear = shear_between(first, last)
    # Where on it a surface is touched makes no difference, nor where along an edge.
    last[[0, 1] if layout.task == "surface" else [1]] = 0.0
    return last, shear


def _placed(layout, command):
    """Label (6,) of a pose in their conventions (6,), m and rad."""
    turn = (
        Rotation.from_rotvec(command[3:]) if layout.angles == "vector" else Rotation.from_euler(layout.angles, command[3:])
    )
    lever = np.array([0.0, 0.0, 1e-3 * layout.tcp_behind_apex_mm])
    camera = matrix(np.zeros(3), Rotation.from_euler("z", layout.camera_turn_deg, degrees=True))
    tool = matrix(command[:3] + lever - turn.apply(lever), turn) @ camera.T
    # A surface looks the same from all sides: its own axes are turned with the camera's.
    return label_of((camera if layout.task == "surface" else np.eye(4)) @ tool @ sensor_in_contact(np.zeros(6)))


def _column(table, factor, column, offset, count):
    """Numbers (count,) of a column: NaN where a cell is none."""
    if column is None:
        return np.full(count, offset)
    if column not in table:
        raise TactipError(f"the table has no column {column!r}: its columns are {', '.join(table)}")
    return factor * np.array([_number(cell) for cell in table[column]]) + offset


def _span(cells):
    """In words, from where to where a column's cells (list of str) go; nothing if they are not numbers all."""
    numbers = np.array([_number(cell) for cell in cells])
    return f" ({numbers.min():.3g} to {numbers.max():.3g})" if np.isfinite(numbers).all() and np.ptp(numbers) else ""


def _number(cell):
    try:
        return float(cell)
    except (TypeError, ValueError):
        return float("nan")
