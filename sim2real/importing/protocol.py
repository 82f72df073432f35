"""The poses of a recording protocol: contacts to command to a rig, as a table that `tactip import` reads without options."""

import csv
import io
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.limits import MAX_TILT_RAD, check_ranges, exceeds_max_tilt
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.labels import COMPONENTS, LABELS, SHEARS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.column_map import Angles
from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import TactipError

STARTS = tuple(f"start_{c}" for c in COMPONENTS)
"""Columns of the pose at which a contact is made, before the shear, mm and degrees."""

_MAX_TRIES = 1000
"""Number of samples of a contact before ranges are rejected."""


@dataclass(frozen=True)
class Protocol:
    """Contacts of a recording."""

    frames: int = within(20, 10000, default=300)
    """Number of contacts, each with one frame."""
    taps: int = within(0, 1000, default=20)
    """Number of these that are upright presses without shear, at evenly increasing depth, at the beginning: they show how
    the pattern of pins grows with depth."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the random contacts."""
    pose: Ranges = POSE_RANGES["surface"]
    """Ranges of the poses, low and high of each component. The defaults are those of the task in the paper (Table 1)."""
    shear: Ranges = SHEAR_RANGES
    """Ranges of the motion in contact that leads to the pose. The defaults are the paper's (Table 1)."""
    angles: Angles = "vector"
    """Convention of the angles in the table: a rotation vector, or Euler angles about fixed (xyz) or rotated axes (ZYX), as
    the robot wants them. `tactip import` needs the same."""

    def __post_init__(self) -> None:
        check(self)
        require(self.taps <= self.frames, "taps", self.taps, f"at most {self.frames}, the number of frames")
        self.pose.check("pose")
        self.shear.check("shear")
        require(self.pose.depth_mm[1] <= 0, "pose.depth_mm", self.pose.depth_mm, "at most 0 (depth is negative)")
        check_ranges(self.pose, self.shear)

    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return poses and shears (frames, 6), mm and degrees, to a thousandth.

        Raises TactipError if nearly all contacts in the ranges are too steep.
        """
        poses, shears = (np.zeros((self.frames, 6)) for _ in range(2))
        low, high = self.pose.depth_mm
        poses[: self.taps, 2] = np.linspace(high, low, self.taps)
        rng = np.random.default_rng(self.seed)
        for k in range(self.taps, self.frames):
            poses[k], shears[k] = self._sample(rng)
        return poses, shears

    def _sample(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        for _ in range(_MAX_TRIES):
            pose, shear = (
                np.round(low + (high - low) * rng.random(6), 3)
                for low, high in (self.pose.bounds().T, self.shear.bounds().T)
            )
            if not exceeds_max_tilt(from_mm_deg(pose), from_mm_deg(shear)):
                return pose, shear
        raise TactipError(
            f"all of {_MAX_TRIES} poses and shears sampled from the ranges tilt by more than {np.degrees(MAX_TILT_RAD):g} "
            "degrees: narrow the ranges of roll and pitch"
        )


def protocol_table(protocol: Protocol) -> bytes:
    """Return the contacts of a protocol as a table of comma-separated values: the name of the frame, then STARTS, LABELS and
    SHEARS. A start is the pose minus the shear, component by component."""
    poses, shears = protocol.contacts()
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["image_name", *STARTS, *LABELS, *SHEARS])
    for k, (pose, shear) in enumerate(zip(poses, shears, strict=True)):
        start, end = (_in_convention(label, protocol.angles) for label in (pose - shear, pose))
        numbers = np.concatenate([start, end, end - start]) + 0.0  # no minus zero
        writer.writerow([f"frame_{k:04d}.png", *(f"{value:.3f}" for value in numbers)])
    return text.getvalue().encode()


def _in_convention(pose: np.ndarray, angles: Angles) -> np.ndarray:
    """Return a pose (6,), mm and degrees, with its rotation vector in another convention."""
    if angles == "vector":
        return pose
    euler = Rotation.from_rotvec(pose[3:], degrees=True).as_euler(angles, degrees=True)
    return np.concatenate([pose[:3], euler])
