"""The columns of a laboratory's table: which are the components of our labels, and in which conventions. Each of our
components is one of their columns, times a factor, plus an offset:

    pose_z=-pose_2-5      depth was measured before a tap of 5 mm, positive into the object
    shear_x=move_1        the motion in contact that led to the pose
    pose_Ry=0.5           a constant where there is no column

A component that is not listed is the column of its own name, whatever the case of its letters, or 0 if there is none. A
column whose name is more than letters, digits and _ is written in brackets: pose_Ry=-[Ry (deg)]. Light to import, for
commands.
"""

import re
from dataclasses import dataclass
from typing import Literal, get_args

from tactip_twin.sim.dataset.sampling import MAX_LABEL
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import TactipError, lookup

Task = Literal["surface", "edge"]
"""Stimulus of a set."""

Angles = Literal["vector", "xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
"""A rotation vector, or Euler angles about fixed axes (small letters) or rotated axes (capitals)."""

AnglesChoice = Literal["auto", Angles]
"""A convention of angles, or `auto`: vector, or what --find finds."""

TOOL_COLUMNS = ("tool_x", "tool_y", "tool_z", "tool_Rx", "tool_Ry", "tool_Rz")
"""Columns that are read instead of a pose in the base's frame."""

_NUMBER = r"\d+\.?\d*(?:[eE][+-]?\d+)?"
_PLAIN = r"[^\W\d]\w*"
_TERM = re.compile(
    rf"(?P<sign>[+-]?)(?:(?P<factor>{_NUMBER})\*)?(?:(?P<column>{_PLAIN})|\[(?P<quoted>.+)\])(?P<offset>[+-]{_NUMBER})?"
)


_MAX_LENGTH = 200
"""Maximum length of the text that maps a column."""


def _possible(number: float, spec: str) -> float:
    require(abs(number) <= MAX_LABEL, f"the numbers in {spec!r}", number, f"from -{MAX_LABEL:g} to {MAX_LABEL:g}")
    return number


@dataclass(frozen=True)
class ColumnMap:
    """Conventions of a laboratory's table. The defaults are those of this project."""

    task: Task = "surface"
    """Stimulus of the set."""
    columns: tuple[str, ...] = ()
    """Columns as OURS=THEIRS, for pose_x to pose_Rz and shear_x to shear_Rz, mm and degrees. THEIRS may be negated,
    scaled and shifted: pose_z=-pose_2-5."""
    image_column: str = ""
    """Column with the frames' file names. Default: the first that exists of sensor_image, image_name, image, filename,
    file_name, file, frame, sensor_video, video_name and video."""
    video_frame: int = within(-100000, 100000, default=-1)
    """Frame to use if the table names videos: 0 is the first, -1 the last."""
    angles: AnglesChoice = "auto"
    """Convention of the three angles: `vector` (axis times angle), or Euler angles in the order of the letters, about
    fixed axes (xyz) or rotated axes (XYZ). auto: vector, or with --find the one that the frames show."""
    base_pose: tuple[str, ...] = ()
    """Columns of a pose in the frame of the robot's base: x, y, z in mm or m, then three angles in the convention `angles`,
    or a quaternion, its real part last. Columns tool_x to tool_Rz are read instead: the position, mm, and the rotation
    vector, degrees, in the axes of the upright tool. --find finds quaternions and rotation vectors."""
    tool_offset_mm: tuple[float, float, float] = within(-500, 500, default=(0.0, 0.0, 0.0))
    """Position of the apex in the frame of the tool whose pose base_pose is, mm, for example of a flange."""
    camera_rotation_deg: float = within(-360, 360, default=0.0)
    """Rotation of the table's axes relative to the image's about the axis of the tip, degrees; the labels are rotated by
    it."""
    tcp_behind_apex_mm: float = within(-100, 100, default=0.0)
    """Distance from the apex back to the point whose poses the table holds, mm: the dome's radius for a point in its
    centre."""
    tcp_beside_axis_mm: tuple[float, float] = within(-20, 20, default=(0.0, 0.0))
    """Position of that point across the axis of the tip, x and y of the table, mm: depth then changes with tilt."""

    def __post_init__(self) -> None:
        check(self)
        lookup("task", self.task, dict.fromkeys(get_args(Task)))
        allowed = "auto, vector, or three letters as xyz or ZYX"
        require(self.angles in get_args(AnglesChoice), "angles", repr(self.angles), allowed)
        require(len(self.base_pose) in (0, 6, 7), "the number of columns of base_pose", len(self.base_pose), "6 or 7")
        if any(self.tool_offset_mm) and not self.base_pose:
            raise TactipError(f"tool_offset_mm must be 0 0 0 without base_pose, got {self.tool_offset_mm}")
        names = [parse_column(spec)[0] for spec in self.columns]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise TactipError(f"each component must be mapped once, got {', '.join(twice)} more than once")


def parse_column(spec: str) -> tuple[str, tuple[float, str | None, float]]:
    """Return our component and its (factor, column or None, offset), mm or degrees, from OURS=THEIRS.

    Raises:
        TactipError: If the component is unknown, or its column is not written as the module's docstring has it.
    """
    if len(str(spec)) > _MAX_LENGTH:
        raise TactipError(f"a column must be written in at most {_MAX_LENGTH} characters, got {len(str(spec))}")
    ours, equals, theirs = (part.strip() for part in str(spec).partition("="))
    theirs = "".join(part if part.startswith("[") else part.replace(" ", "") for part in re.split(r"(\[.*\])", theirs))
    if ours not in (*LABELS, *SHEARS):
        raise TactipError(f"a column must be mapped to one of {', '.join((*LABELS, *SHEARS))}, got {spec!r}")
    match = _TERM.fullmatch(theirs)
    if match:
        factor = float(match["factor"] or 1) * (-1 if match["sign"] == "-" else 1)
        column = match["column"] or match["quoted"]
        return ours, (_possible(factor, spec), column, _possible(float(match["offset"] or 0), spec))
    if equals and re.fullmatch(rf"[+-]?{_NUMBER}", theirs):
        return ours, (0.0, None, _possible(float(theirs), spec))
    forms = "pose_z=-pose_2-5, pose_Ry=0.5*angle, pose_Ry=[Ry (deg)] or shear_x=0"
    raise TactipError(f"a column must be written like {forms}, got {spec!r}")


def written(column: str) -> str:
    """Return a column's name as `parse_column` reads it: in brackets unless it is plain."""
    return column if re.fullmatch(_PLAIN, column) else f"[{column}]"
