"""How a laboratory wrote its set down: what its columns mean, and how its camera sits. Told once, by options or a file.

Each component of ours is a column of theirs, times a factor, plus an offset:

    pose_z=-pose_2-5      depth was measured before a tap of 5 mm, and grew into the object
    shear_x=move_1        the motion in contact that led to the pose
    pose_Ry=0.5           a number where there is no column

A component that is not told is the column of its own name, or 0 where there is none.
"""

import json
import re
from dataclasses import dataclass, fields
from pathlib import Path

from tactip_twin.sim.labels import LABELS, SHEARS, TASKS
from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import TactipError, lookup

_NUMBER = r"\d+\.?\d*(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"(?P<sign>[+-]?)(?:(?P<factor>{_NUMBER})\*)?(?P<column>[A-Za-z_]\w*)(?P<offset>[+-]{_NUMBER})?")


@dataclass(frozen=True)
class Layout:
    """A laboratory's conventions. Defaults are the project's own."""

    task: str = "surface"
    """surface or edge."""
    columns: tuple[str, ...] = ()
    """OURS=THEIRS, for pose_x to pose_Rz and shear_x to shear_Rz, mm and degrees: pose_z=-pose_2-5."""
    image_column: str = ""
    """Column that names the frames; sensor_image, image_name, image, filename, sensor_video, video_name or video if not
    given."""
    film_frame: int = within(-100000, 100000, default=-1)
    """Which frame is used where the table names films: 0 is the first, -1 the last."""
    angles: str = "vector"
    """What their three angles are: `vector` (axis times angle), or Euler angles in the order of letters: xyz about fixed
    axes, XYZ about turned ones."""
    camera_turn_deg: float = within(-360, 360, default=0.0)
    """Turn of their axes against the image's, about the axis of the tip, degrees: the labels are turned by it."""
    tcp_behind_apex_mm: float = within(-100, 100, default=0.0)
    """Distance of the point that their poses are of behind the apex, mm: the radius for a point in the dome's
    middle."""
    image_turn_deg: float = within(-360, 360, default=0.0)
    """Turn of the frames before they are used, degrees, counter-clockwise: for an edge, whose yaw the camera's turn would
    shift."""
    mirrored: bool = False
    """Whether the frames are mirror images, left for right; undone before they are turned."""
    dark: bool = False
    """Whether the pins are dark on light."""
    crop: tuple[int, int, int, int] | None = within(0, 65536, default=None)
    """Left, top, right, bottom of the part of the frame that is used, px; all if not given."""
    threshold: tuple[int, float] | None = within((3, -255), (65535, 255), default=None)
    """Block and constant of the adaptive threshold of grey frames; None for frames that are binary."""
    size_px: int = within(8, 4096, default=128)
    """Width of the images that are made, px."""
    mask: str = "pins"
    """pins: what is outside of the pins is made black (light at the rim); none: it stays."""

    def __post_init__(self):
        check(self)
        lookup("task", self.task, dict.fromkeys(TASKS))
        lookup("mask", self.mask, dict.fromkeys(("pins", "none")))
        good = self.angles == "vector" or sorted(self.angles.lower()) == ["x", "y", "z"]
        good = good and self.angles in ("vector", self.angles.lower(), self.angles.upper())
        require(good, "angles", repr(self.angles), "vector, or three letters as xyz or ZYX")
        for told in self.columns:
            parsed(told)


def read_layout(path):
    """The Layout in a JSON file: an object of the fields that are not as Layout has them. Raises TactipError."""
    path = Path(path)
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise TactipError(f"the layout file {path} does not exist") from None
    except ValueError as error:
        raise TactipError(f"the layout file {path} is not JSON: {error}") from error
    known = {f.name for f in fields(Layout)}
    if not isinstance(content, dict) or set(content) - known:
        strange = sorted(set(content) - known) if isinstance(content, dict) else [type(content).__name__]
        raise TactipError(f"the layout file {path} has {', '.join(strange)}: its fields are {', '.join(sorted(known))}")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
    try:
        return Layout(**values)
    except TypeError as error:
        raise TactipError(f"the layout file {path} has a value of the wrong kind: {error}") from error


def parsed(told):
    """Our component (str) and its (factor, column or None, offset) of an OURS=THEIRS (str). Raises TactipError."""
    ours, equals, theirs = (part.strip() for part in str(told).partition("="))
    theirs = theirs.replace(" ", "")
    if ours not in (*LABELS, *SHEARS):
        raise TactipError(f"{told!r} does not begin with a component: {', '.join((*LABELS, *SHEARS))}")
    match = _TERM.fullmatch(theirs)
    if match:
        factor = float(match["factor"] or 1) * (-1 if match["sign"] == "-" else 1)
        return ours, (factor, match["column"], float(match["offset"] or 0))
    if equals and re.fullmatch(rf"[+-]?{_NUMBER}", theirs):
        return ours, (0.0, None, float(theirs))
    raise TactipError(f"{told!r} is not understood: it must be as pose_z=-pose_2-5, pose_Ry=0.5*angle or shear_x=0")
