"""Poses in the frame of a robot's base, as controllers record them, in place of poses relative to a surface.

There, the tool often points down: its rotation vector is 180° long and flips its sign from row to row, and a quaternion has
no component that is a tilt. Six further columns are read instead: position and rotation vector in the axes that the tool has
when it is upright, mm and degrees. Upright is where an axis of the tool is along one of the base; the rotation about it is
that of the mean orientation, or that which puts a line of positions along an axis.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.dataset.sampling import MAX_LABEL
from tactip_twin.sim2real.importing.column_map import TOOL_COLUMNS, AnglesChoice, ColumnMap
from tactip_twin.sim2real.importing.table_columns import number, plain_name
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError

_POSITION = ("x", "y", "z")
_VECTORS = ((_POSITION, ("rx", "ry", "rz")), (("0", "1", "2"), ("3", "4", "5")), (("1", "2", "3"), ("4", "5", "6")))
"""Ends of the names of a position and a rotation vector: by letters, from 0, and from 1."""

_QUATERNIONS = (("x", "y", "z", "w"), ("1", "2", "3", "0"), ("2", "3", "4", "1"))
"""Ends of the names of a quaternion, the real part last: by letters, from q0, and from q1 as ABB's controllers have it."""

_Q = re.compile(r"(?:^|[^a-z])q_?$")
"""What stands before the number in the name of a quaternion's part whose order is known."""

_BEFORE = "pqsto"
"""Letters that may stand before such an end, as in qx, posx or tcpx; others belong to a word, as in index, or to rx."""

_JOINTS = re.compile(r"joint|(?:^|[^a-z])q[^a-z]*$")
"""What stands before the end of the names of joint angles."""

_MIN_LEAN_DEG, _MIN_FAR_MM = 60.0, 60.0
"""Angle between the tool's axis and the table's, and distance from its origin, above which, in all rows, a pose is one in
the base's frame: relative to the surface, tips lean less, and are nearer [?]."""

_MAX_VECTOR_DEG = 180.2
"""Maximum length of a rotation vector, with rounding; three Euler angles around 180° are longer in some rows."""

_MAX_METRES, _MAX_SPREAD_METRES, _MAX_RADIANS = 5.0, 0.2, 6.4
"""Largest number of positions in m, their largest standard deviation, and the largest number of angles in rad; larger ones
are mm and degrees. Labels in mm that vary by less would be of one depth [?]."""

_LEVEL_DEG, _WALL_DEG = 10.0, 2.0
"""Angle between the mean direction of an axis of the tool and an axis of the base within which upright is the latter: the
vertical, because tables are level and the tilts of a set have a mean of some degrees, and a horizontal one, because walls
stand in any direction [?]."""

_CLEAR_TURNS = 1.5
"""Ratio of the spreads of the directions of two axes of the tool from which one stands out [?]."""

_LINE = 5.0
"""Ratio of the standard deviations of positions along and across a line above which it is that of the offsets from an edge
[?]."""

_MIN_LINE_MM = 0.5
"""Minimum standard deviation of positions along it, mm [?]."""


def find_base_pose(table: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return the columns of a table that are a pose in the frame of a robot's base, as ColumnMap.base_pose has them; empty
    if there is none.

    It is a position beside any quaternion, or beside a rotation vector if either is none relative to a surface.

    Args:
        table: Cells (n,) of each column.

    Raises:
        TactipError: If the table has a quaternion, but no position, or the names of its parts do not tell their order.
    """
    values = {name: _numbers(cells) for name, cells in table.items()}
    values = {name: column for name, column in values.items() if np.isfinite(column).any()}
    for ends in _QUATERNIONS:
        for before, quaternion in _groups(values, ends).items():
            if not _is_unit(values, quaternion):
                continue
            if "w" not in ends and not _Q.search(before):
                raise TactipError(
                    f"the order of the quaternion {', '.join(sorted(quaternion))} must be known: give --base-pose, x, y and "
                    "z of the position, then the quaternion, its real part last"
                )
            positions = _groups([name for name in values if name not in quaternion], _POSITION)
            if not positions:
                raise TactipError(
                    f"the quaternion {', '.join(quaternion)} must stand beside a position, three columns whose names end in "
                    f"x, y and z, got {', '.join(values)}: name all seven columns with --base-pose"
                )
            return (*positions.get(before, next(iter(positions.values()))), *quaternion)
    for position_ends, ends in _VECTORS:
        positions = _groups(values, position_ends)
        for before, vector in _groups(values, ends).items():
            if before not in positions or _JOINTS.search(before):
                continue
            numbers = np.array([values[name] for name in (*positions[before], *vector)]).T
            if _is_base(numbers[np.isfinite(numbers).all(1)]):
                return (*positions[before], *vector)
    return ()


class BasePoses(NamedTuple):
    """Poses of a tool in the frame of a robot's base."""

    known: np.ndarray
    """(n,) bool, the rows of the table that have one."""
    positions: np.ndarray
    """(m, 3) positions in these rows, mm."""
    rotations: Rotation
    """(m) orientations in these rows."""


def base_poses(table: Mapping[str, Sequence[str]], base_pose: Sequence[str], angles: AnglesChoice = "auto") -> BasePoses:
    """Return the poses in the frame of a robot's base that a table of n rows holds.

    Args:
        table: Cells (n,) of each column.
        base_pose: Its columns: x, y and z, then three angles or the four parts of a quaternion, the real part last.
        angles: Convention of three angles; auto: a rotation vector.

    Raises:
        TactipError: If a column is missing, no row has numbers in all of them, or four of them are no quaternion.
    """
    missing = [name for name in base_pose if name not in table]
    if missing:
        raise TactipError(f"the table has no column {', '.join(missing)} (--base-pose): its columns are {', '.join(table)}")
    values = np.array([_numbers(table[name]) for name in base_pose]).T
    known = np.asarray(np.isfinite(values).all(1))
    if not known.any():
        raise TactipError(f"no row of the table has numbers in all of {', '.join(base_pose)} (--base-pose)")
    positions, turns = values[known, :3], values[known, 3:]
    if turns.shape[1] == len(_QUATERNIONS[0]):
        norms = np.linalg.norm(turns, axis=1)
        is_unit = bool((np.abs(norms - 1) < _UNIT).all())
        require(is_unit, "the length of a quaternion", f"{norms.min():g} to {norms.max():g}", "1")
        rotations = Rotation.from_quat(turns)
    else:
        turns = _radians(turns)
        rotations = Rotation.from_rotvec(turns) if angles in ("auto", "vector") else Rotation.from_euler(angles, turns)
    return BasePoses(known, _millimetres(positions), rotations)


def with_tool_columns(table: Mapping[str, Sequence[str]], column_map: ColumnMap) -> dict[str, Sequence[str]]:
    """Return a table with TOOL_COLUMNS, mm and degrees, from its poses in the frame of a robot's base.

    Args:
        table: Cells (n,) of each column.
        column_map: Conventions of the table, with a base_pose.

    Raises:
        TactipError: As base_poses.
    """
    known, positions, rotations = base_poses(table, column_map.base_pose, column_map.angles)
    apexes = positions + rotations.apply(column_map.tool_offset_mm)
    upright, mount = upright_tool(rotations, apexes)
    relative = (upright.inv() * rotations * mount).as_rotvec(degrees=True)
    found = np.full((len(known), len(TOOL_COLUMNS)), np.nan)
    found[known] = np.concatenate([upright.inv().apply(apexes), relative], 1)
    cells = [[f"{x:.7g}" for x in column] for column in found.T]
    return {**table, **dict(zip(TOOL_COLUMNS, cells, strict=True))}


_UNIT = 1e-2
"""Largest deviation of a quaternion's length from 1: tables are rounded."""


def upright_tool(rotations: Rotation, positions: np.ndarray) -> tuple[Rotation, Rotation]:
    """Return the orientation of the upright tool in the base's frame, from n rotations and positions (n, 3), mm, and the
    rotation about the tool's axis after which it has no rotation in the mean."""
    mean = rotations.mean()
    axes = mean.as_matrix()
    turned = _axis_of_turns(rotations)
    limits = np.cos(np.radians([_WALL_DEG, _WALL_DEG, _LEVEL_DEG]))[:, None]
    near = [(int(base), int(tool)) for base, tool in np.argwhere(np.abs(axes) > limits)]
    upright = mean
    if near:
        base, tool = max(near, key=lambda pair: (pair[1] == turned, pair[0]))
        along = np.sign(axes[base, tool]) * np.eye(3)[base]
        upright = Rotation.align_vectors(along[None], axes[:, tool][None])[0] * mean
    across = None if turned is None else _line(np.delete(upright.inv().apply(positions), turned, 1))
    if turned is None or across is None:
        return upright, Rotation.identity()
    axis = np.eye(3)[turned]
    # Axes 0 and 2 follow each other the other way round.
    upright *= Rotation.from_rotvec((-across if turned == 1 else across) * axis)
    return upright, Rotation.from_rotvec(-((upright.inv() * mean).as_rotvec() @ axis) * axis)


def _axis_of_turns(rotations: Rotation) -> int | None:
    """Return the axis of the tool about which n rotations are the largest, as at an edge, because it varies least; None if
    it does not stand out."""
    means = rotations.as_matrix().mean(0)
    spreads = 1 - np.linalg.norm(means, axis=0)  # half of the mean squared angle to the mean direction
    first, second = np.argsort(spreads)[:2]
    return int(first) if spreads[second] > _CLEAR_TURNS**2 * spreads[first] else None


def _line(positions: np.ndarray) -> float | None:
    """Return the rotation, rad, that brings the nearer axis onto the line on which positions (n, 2), mm, lie, because one
    coordinate is to be the offset from an edge; None if they lie on none."""
    centred = positions - positions.mean(0)
    spread, directions = np.linalg.eigh(centred.T @ centred / len(centred))
    if np.sqrt(spread[1]) < _MIN_LINE_MM or spread[1] < _LINE**2 * spread[0]:
        return None
    angle = float(np.arctan2(directions[1, 1], directions[0, 1]))
    return angle - np.pi / 2 * float(np.rint(angle / (np.pi / 2)))


def _groups(names: Iterable[str], ends: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the names that end in each of `ends`, in their order, by what stands before the end; only whole groups."""
    found: dict[str, dict[str, str]] = {}
    for name in names:
        plain = plain_name(name)
        for end in ends:
            before = plain.removesuffix(end)
            if before != plain and (not before or not before[-1].isalnum() or before[-1] in _BEFORE):
                found.setdefault(before, {})[end] = name
    return {before: tuple(group[end] for end in ends) for before, group in found.items() if len(group) == len(ends)}


def _numbers(cells: Sequence[str]) -> np.ndarray:
    """Return the numbers in a column's cells (n,); NaN where a cell has none, or one that is too large for a label."""
    values = np.array([number(cell) for cell in cells])
    return np.where(np.abs(values) <= MAX_LABEL, values, np.nan)


def _is_unit(values: Mapping[str, np.ndarray], names: Sequence[str]) -> bool:
    """Return whether columns are the parts of unit quaternions, where all are known."""
    squares = np.sum([values[name] ** 2 for name in names], 0)
    known = np.isfinite(squares)
    return bool(known.any() and (np.abs(np.sqrt(squares[known]) - 1) < _UNIT).all())


def _is_base(numbers: np.ndarray) -> bool:
    """Return whether numbers (n, 6) are positions and rotation vectors in the frame of a robot's base."""
    if not len(numbers):
        return False
    positions, vectors = _millimetres(numbers[:, :3]), _radians(numbers[:, 3:])
    if np.degrees(np.linalg.norm(vectors, axis=1).max()) > _MAX_VECTOR_DEG:
        return False
    leans = Rotation.from_rotvec(vectors).as_matrix()[:, 2, 2] < np.cos(np.radians(_MIN_LEAN_DEG))
    return bool(leans.all() or (np.linalg.norm(positions, axis=1) > _MIN_FAR_MM).all())


def _millimetres(positions: np.ndarray) -> np.ndarray:
    """Return positions (n, 3), mm or m, in mm."""
    metres = np.abs(positions).max() <= _MAX_METRES and positions.std(0).max() <= _MAX_SPREAD_METRES
    return 1e3 * positions if metres else positions


def _radians(angles: np.ndarray) -> np.ndarray:
    """Return angles (n, 3), degrees or rad, in rad."""
    return angles if np.abs(angles).max() <= _MAX_RADIANS else np.radians(angles)
