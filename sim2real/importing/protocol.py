"""Poses to record with a real sensor, as a table that `tactip import` reads without any option once the frames are there.

For each frame the robot lifts off, presses the tip at the start pose, moves in contact to the pose, and takes a frame.
"""

import csv
import io
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.limits import exceeds_max_tilt
from tactip_twin.sim.dataset.sampling import Ranges, Split, generator
from tactip_twin.sim.labels import LABELS, SHEARS, Task
from tactip_twin.sim.pose import before_shear, to_mm_deg
from tactip_twin.sim2real.importing.column_map import Angles
from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import TactipError

STARTS = tuple(name.replace("pose", "start") for name in LABELS)
"""Columns of the pose at which the tip is pressed, mm and degrees."""

MAX_FRAMES = 100_000
"""Maximum number of frames: a robot takes days for them."""

_SPLIT: Split = "train"
_MAX_TRIES = 1000
"""Number of motions sampled for a frame before the ranges are rejected."""


@dataclass(frozen=True)
class ProtocolOptions:
    """What to record."""

    task: Task = "surface"
    """Stimulus: a flat surface, or a straight edge along y with the object at x < 0."""
    frames: int = within(1, MAX_FRAMES, default=300)
    """Number of frames; 300 are enough to test, and to fine-tune with 50 [M]."""
    depth_mm: tuple[float, float] = field(default=(1.0, 5.0))
    """Range of the depth of the apex below the surface, mm [P]."""
    tilt_deg: float = within(0, 25, default=15.0)
    """Maximum roll and pitch, degrees [P]."""
    shear_mm: float = within(0, 15, default=5.0)
    """Maximum motion in contact along x and y before the pose, mm [P]."""
    shear_deg: float = within(0, 20, default=5.0)
    """Maximum turn in contact about each axis before the pose, degrees [P]."""
    offset_mm: float = within(0, 20, default=5.0)
    """Maximum distance beside the edge, mm [P]; edges only."""
    yaw_deg: float = within(0, 180, default=45.0)
    """Maximum yaw relative to the edge, degrees [P]; edges only."""
    angles: Angles = "vector"
    """Convention of the angles: a rotation vector, or Euler angles about fixed (xyz) or rotated axes (XYZ). Give
    `tactip import` the same."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the poses."""

    def __post_init__(self) -> None:
        check(self)
        low, high = self.depth_mm
        require(0 < low <= high <= 8, "depth_mm", self.depth_mm, "a low and a high, above 0 and up to 8")

    def ranges(self) -> tuple[Ranges, Ranges]:
        """Return the ranges of poses and shears."""
        on_edge = self.task == "edge"
        beside, yaw = (self.offset_mm, self.yaw_deg) if on_edge else (0.0, 0.0)
        tilt, slide, turn = ((-x, x) for x in (self.tilt_deg, self.shear_mm, self.shear_deg))
        depth = (-self.depth_mm[1], -self.depth_mm[0])
        pose = Ranges((-beside, beside), (0.0, 0.0), depth, tilt, tilt, (-yaw, yaw))
        return pose, Ranges(slide, slide, (0.0, 0.0), turn, turn, turn)


def protocol_table(options: ProtocolOptions) -> bytes:
    """Return the table as CSV: image_name, the pose, the shear as the difference from the start pose, and the start pose.

    mm and degrees, in the frame of the stimulus (sim/pose.py). Raises TactipError where the ranges allow no pose.
    """
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(["image_name", *LABELS, *SHEARS, *STARTS])
    for number in range(options.frames):
        pose, start = (np.round(_in_convention(label, options.angles), 4) for label in _motion(options, number))
        cells = [f"{value + 0.0:.4f}" for value in (*pose, *(pose - start), *start)]
        table.writerow([f"image_{number:05d}.png", *cells])
    return stream.getvalue().encode()


def _motion(options: ProtocolOptions, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pose and start pose (6,), m and rad, of a frame."""
    rng, (poses, shears) = generator(options.seed, options.task, _SPLIT, number), options.ranges()
    for _ in range(_MAX_TRIES):
        pose, shear = poses.sample(rng), shears.sample(rng)
        if not exceeds_max_tilt(pose, shear):
            return pose, before_shear(pose, shear)
    raise TactipError("the tilts are too large: narrow tilt_deg or shear_deg")


def _in_convention(label: np.ndarray, angles: Angles) -> np.ndarray:
    """Return a label (6,), m and rad, in mm and degrees, with its angles in a convention."""
    turn = label[3:] if angles == "vector" else Rotation.from_rotvec(label[3:]).as_euler(angles)
    return to_mm_deg(np.concatenate([label[:3], turn]))
