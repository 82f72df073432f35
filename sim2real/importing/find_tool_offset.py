"""The position of the apex in the frame of a robot's tool, where a table holds the poses of a flange: depths that the frames
show then differ from how far the flange has moved, in tilted frames."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tactip_twin.sim2real.importing.base_pose import base_poses, upright_tool
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts
from tactip_twin.sim2real.importing.table_columns import robust_fit

_MIN_COS_SPREAD = 3e-3
"""Minimum standard deviation of the cosine of the tilt for an offset along the tool's axis to be sought: that of 8° of tilt
[?]."""

_MIN_SIN_SPREAD = 0.02
"""Minimum standard deviation of the sines of the tilts for an offset across it [?]."""

_SIGNIFICANT, _MIN_ALONG_MM, _MIN_ACROSS_MM = 3.5, 10.0, 2.0
"""Minimum of an offset, in standard deviations, and along and across the tool's axis [?]. Smaller ones are tool centres
(find_angles.py)."""

_MAX_CONDITION = 1e3
"""Condition number above which positions along a direction are a multiple of tilts [?]."""

_MIN_GAIN = 0.2
"""Smallest part of the tool's motion along its axis that estimated depths show: one below is another direction's, as for
columns (table_columns.py) [?]."""

_MAX_MM = 500.0
"""Maximum of an offset along each axis, as of ColumnMap.tool_offset_mm."""


def find_tool_offset(
    table: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap
) -> tuple[ColumnMap, list[str]]:
    """Return a ColumnMap with the tool_offset_mm that explains the depths that frames show, and the evidence; unchanged if
    they show none.

    Args:
        table: Cells of each column.
        contacts: Contacts that were estimated from some of its rows.
        column_map: Conventions with a base_pose.

    Raises:
        TactipError: If the table has no such poses.
    """
    known, positions, rotations = base_poses(table, column_map.base_pose, column_map.angles)
    place = np.cumsum(known) - 1  # of a row among those with a pose
    fits = contacts.fits_well & known[contacts.rows]
    rows, depths = place[contacts.rows[fits]], contacts.poses[fits, 2]
    into_tool = rotations.as_matrix().transpose(0, 2, 1)
    normals = upright_tool(rotations, positions)[0].as_matrix().T
    tries = [_fit(positions[rows] @ normal, into_tool[rows] @ normal, depths, k) for k, normal in enumerate(normals)]
    offset, deviations, _ = min(tries, key=lambda one: one[2])
    if not offset.any() or np.abs(offset).max() > _MAX_MM:
        return column_map, []
    found = tuple(float(x) for x in offset.round(1))
    words = " ".join(f"{x:g}" + (f" (± {d:.1f})" if x else "") for x, d in zip(found, deviations, strict=True))
    told = f"tool-offset-mm {words}: the depth of tilted frames is that of a point there in the tool's frame"
    return replace(column_map, tool_offset_mm=found), [told]


def _fit(along: np.ndarray, axes: np.ndarray, depths: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the offset (3,) that explains depths best, its standard deviations (3,), and the spread of what remains, mm: 0
    and inf if the direction is none of depths, because tilts alone move the tool along it.

    Args:
        along: (n,) positions of the tool along a direction, mm.
        axes: (n, 3) this direction in the tool's frame.
        depths: (n,) depths, mm.
        axis: Axis of the upright tool that has this direction.
    """
    smallest = np.full(3, _MIN_ACROSS_MM)
    smallest[axis] = _MIN_ALONG_MM
    chosen = axes.std(0) > _MIN_SIN_SPREAD
    chosen[axis] = axes[:, axis].std() > _MIN_COS_SPREAD
    offset, deviations, remains = np.zeros(3), np.zeros(3), np.inf
    for _ in range(2):  # again without what is not significant
        design = np.stack([along - along.mean(), np.ones_like(along), *(axes - axes.mean(0)).T[chosen]], -1)
        if np.linalg.cond(design / np.maximum(np.linalg.norm(design, axis=0), 1e-9)) > _MAX_CONDITION:
            return np.zeros(3), np.zeros(3), np.inf
        found, spread = robust_fit(design, depths)
        gain = float(found[0])
        if abs(gain) < _MIN_GAIN:
            return np.zeros(3), np.zeros(3), np.inf
        offset[:], deviations[:] = 0.0, 0.0
        offset[chosen], deviations[chosen] = found[2:] / gain, spread[2:] / abs(gain)
        remains = float(np.median(np.abs(depths - design @ found)))
        chosen &= np.abs(offset) >= np.maximum(_SIGNIFICANT * deviations, smallest)
    return np.where(chosen, offset, 0.0), deviations, remains
