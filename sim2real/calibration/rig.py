"""Conversion of a laboratory rig's commanded poses and moves to poses and shears in the contact frame.

A rig commands its tool centre point (TCP) in its own work frame, presses along one of its axes and turns about a point that
need not be the tip's apex. Conventions differ between laboratories; only this module handles them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class Rig:
    """Geometry of a rig. The defaults describe a perfect rig; a calibration fits them."""

    press_axis: tuple[float, float, float] = within(-1, 1, default=(0.0, 0.0, -1.0))
    """Direction of the press in the work frame, a unit vector: into the object."""
    azimuth_deg: float = within(-720, 720, default=0.0)
    """Rotation of the work frame about the surface's normal relative to the image's x axis, degrees: how the camera is
    mounted."""
    depth_zero_m: float = within(-5e-3, 5e-3, default=0.0)
    """Depth beyond the commanded one, m, because the rig does not know the surface's exact height."""
    tcp_behind_apex_m: float = within(-0.1, 0.1, default=0.0)
    """Distance from the tip's apex back to the point about which the rig rotates, m."""
    tilt_zero_deg: tuple[float, float] = within(-20, 20, default=(0.0, 0.0))
    """Tilt of the tip when none is commanded, rotation vector about x and y before the azimuth, degrees."""

    def __post_init__(self) -> None:
        check(self)


class RigMotion:
    """Conversion of a rig's commands to contacts."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        inward = np.array(rig.press_axis) / np.linalg.norm(rig.press_axis)
        # Contact frame in the work frame: z out of the object; x the work frame's axis most square to it, made square.
        x = np.eye(3)[np.abs(inward).argmin()] if abs(inward[0]) > 0.9 else np.array([1.0, 0, 0])
        x = x - (x @ inward) * inward
        x /= np.linalg.norm(x)
        work_in_contact = np.stack([x, np.cross(-inward, x), -inward])
        self._turn = Rotation.from_euler("z", rig.azimuth_deg, degrees=True).as_matrix() @ work_in_contact
        self._tilt_offset = self._turn @ work_in_contact.T @ np.radians([*rig.tilt_zero_deg, 0.0])

    def _apex_and_turn(self, command: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Return the apex (3,) m and the Rotation, in the contact frame, of a commanded pose (6,), m and rad."""
        turn = Rotation.from_matrix(self._turn @ Rotation.from_euler("xyz", command[3:]).as_matrix() @ self._turn.T)
        turn = turn * Rotation.from_rotvec(self._tilt_offset)
        lever = np.array([0.0, 0.0, self.rig.tcp_behind_apex_m])
        return self._turn @ command[:3] + lever - turn.apply(lever), turn

    def contact(
        self, pose: ArrayLike, move: ArrayLike, tap: ArrayLike, fraction: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose and shear (6,), m and rad (sim/pose.py), of a press at `pose` minus `move` that moves to `pose`.

        Args:
            pose: (6,), m and rad in the work frame, commanded pose before the tap.
            move: (6,), m and rad in the work frame, motion in contact.
            tap: (6,), m and rad in the work frame, the tap that makes contact; only its translation is used.
            fraction: Finished fraction of the move when the image is taken, 0 to 1; the rest causes no shear.
        """
        pose, move = np.asarray(pose, float), np.asarray(move, float)
        pressed = np.concatenate([np.asarray(tap, float)[:3], np.zeros(3)])
        first, turn_first = self._apex_and_turn(pose + pressed - move)
        last, turn_last = self._apex_and_turn(pose + pressed - (1 - fraction) * move)
        shear = last - first
        turned = (turn_last * turn_first.inv()).as_rotvec()
        place = np.array([0.0, 0.0, last[2] - self.rig.depth_zero_m])
        return np.concatenate([place, turn_last.as_rotvec()]), np.concatenate([shear, turned])
