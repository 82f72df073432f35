"""Conversion of a laboratory's table to labels in the conventions of sim/pose.py."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.dataset.sampling import MAX_LABEL
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import from_mm_deg, shear_between, to_mm_deg
from tactip_twin.sim2real.importing.column_map import ColumnMap, parse_column
from tactip_twin.sim2real.importing.table_columns import number
from tactip_twin.tactip_model.errors import TactipError

_IMAGES = ("sensor_image", "image_name", "image", "filename", "file_name", "file", "frame")
IMAGE_COLUMNS = (*_IMAGES, "sensor_video", "video_name", "video")
"""Column names under which tables list their frames."""


def image_column(column_map: ColumnMap, columns: Sequence[str]) -> str:
    """Return which of a table's `columns` names the frames. Raises TactipError if there is none."""
    names = (column_map.image_column,) if column_map.image_column else IMAGE_COLUMNS
    for name in names:
        if name in columns:
            return name
    raise TactipError(
        f"the table has no column {' or '.join(names)} for the frames: give --image-column, one of {', '.join(columns)}"
    )


def own_columns(table: Collection[str]) -> dict[str, str]:
    """Return the columns of a table that have the name of a component, by component; case does not matter, if it is the
    only such column."""
    low = Counter(name.lower() for name in table)
    by_low = {name.lower(): name for name in table}
    return {
        name: name if name in table else by_low[name.lower()]
        for name in (*LABELS, *SHEARS)
        if name in table or low[name.lower()] == 1
    }


def unused_columns(column_map: ColumnMap, table: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the columns of numbers that vary, but are no label in these conventions."""
    given = dict(parse_column(spec) for spec in column_map.columns)
    used = {column for _, column, _ in given.values()} | {c for ours, c in own_columns(table).items() if ours not in given}
    used |= {*column_map.base_pose}
    return [name for name, cells in table.items() if name not in used and _span(cells)]


def convert_labels(column_map: ColumnMap, table: Mapping[str, Sequence[str]]) -> tuple[np.ndarray, np.ndarray]:
    """Return poses and shears (n, 6) each, mm and degrees, in the conventions of sim/pose.py; NaN where a cell is not a
    number.

    Args:
        column_map: Conventions of the table.
        table: Cells (n,) of each column.

    Raises:
        TactipError: If a column is missing, or none is mapped and none has the name of a component.
    """
    given = dict(parse_column(spec) for spec in column_map.columns)
    for spec in column_map.columns:
        constant = spec.partition("=")[2].strip().lstrip("+-")
        if constant in table and given[spec.partition("=")[0].strip()][1] is None:
            raise TactipError(f"{spec} is a number, but the table has a column {constant}: write [{constant}] to mean it")
    found = own_columns([name for name in table if name not in column_map.base_pose])
    if not given and not found:
        raise TactipError(
            "the table has no column named pose_x … shear_Rz: map its columns with --columns, for example pose_z=-pose_2-5; "
            f"its columns are {', '.join(name + _span(cells) for name, cells in table.items())}"
        )
    count = len(next(iter(table.values())))
    values = {}
    for name in (*LABELS, *SHEARS):
        values[name] = _column(table, *given.get(name, (1.0, found.get(name), 0.0)), count)
    for name in LABELS[3:]:  # a rotation vector of 350° is not that of -10° once it has other parts
        whole = np.where(np.abs(values[name]) > 180, np.round(values[name] / 360), 0.0)
        values[name] = values[name] - 360 * whole
    ends = from_mm_deg(np.stack([values[name] for name in LABELS], -1))
    moves = from_mm_deg(np.stack([values[name] for name in SHEARS], -1))
    known = np.isfinite(ends).all(1) & np.isfinite(moves).all(1)
    poses, shears = np.full((2, count, 6), np.nan)
    last, first = (_labels(column_map, commands[known]) for commands in (ends, ends - moves))
    shears[known] = shear_between(first, last)
    # The place of contact on a surface, or along an edge, makes no difference.
    last[:, [0, 1] if column_map.task == "surface" else [1]] = 0.0
    poses[known] = last
    return to_mm_deg(poses), to_mm_deg(shears)


def _labels(column_map: ColumnMap, commands: np.ndarray) -> np.ndarray:
    """Return the labels (n, 6) of poses (n, 6) in their conventions, both in m and rad."""
    angles = column_map.angles
    plain = angles in ("auto", "vector") or bool(column_map.base_pose)  # base_pose.py gives rotation vectors
    turns = Rotation.from_rotvec(commands[:, 3:]) if plain else Rotation.from_euler(angles, commands[:, 3:])
    lever = 1e-3 * np.array([*column_map.tcp_beside_axis_mm, column_map.tcp_behind_apex_mm])
    apexes = commands[:, :3] + lever - turns.apply(lever)
    camera = Rotation.from_euler("z", column_map.camera_rotation_deg, degrees=True)
    # A surface looks the same from all sides, so its axes are rotated with the camera's.
    axes = camera if column_map.task == "surface" else Rotation.identity()
    return np.concatenate([axes.apply(apexes), (axes * turns * camera.inv()).as_rotvec()], 1)


def _column(table: Mapping[str, Sequence[str]], factor: float, column: str | None, offset: float, count: int) -> np.ndarray:
    """Return the numbers (count,) of a column, scaled and shifted; NaN where a cell is not a number."""
    if column is None:
        return np.full(count, offset)
    if column not in table:
        raise TactipError(f"the table has no column {column!r}: its columns are {', '.join(table)}")
    return factor * np.array([_label(cell) for cell in table[column]]) + offset


def _span(cells: Sequence[str]) -> str:
    """Return the range of a column's cells as text; empty if not all of them are numbers, or all are equal."""
    numbers = np.array([_label(cell) for cell in cells])
    return f" ({numbers.min():.3g} to {numbers.max():.3g})" if np.isfinite(numbers).all() and np.ptp(numbers) else ""


def _label(cell: str | None) -> float:
    """Return the number in a table's cell; NaN if it is none, or too large for a label."""
    value = number(cell)
    return value if abs(value) <= MAX_LABEL else float("nan")
