"""Faults of a laboratory's rig, for hidden simulated sensors: what its table says differs from where its tip was."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class RigFaults:
    """Faults of a rig and its camera; by default none."""

    table_tilt_deg: tuple[float, float] = within(-10, 10, default=(0.0, 0.0))
    """Tilt of the table that the object lies on, a rotation vector's x and y in the rig's axes, degrees."""
    tcp_behind_apex_mm: float = within(-50, 50, default=0.0)
    """Distance from the apex back to the point about which the rig rotates, mm."""
    tcp_beside_axis_mm: tuple[float, float] = within(-5, 5, default=(0.0, 0.0))
    """Position of that point across the axis of the tip, x and y, mm."""
    max_unfinished: float = within(0, 0.9, default=0.0)
    """Largest fraction of a shear that is still to come when a frame is taken; uniform from 0."""
    image_growth: float = within(-0.05, 0.05, default=0.0)
    """Growth of the image while the camera warms up, as a fraction."""

    def __post_init__(self) -> None:
        check(self)

    def commanded(self, poses: np.ndarray, shears: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses and shears that the rig's table holds.

        Args:
            poses: (n, 6) mm and degrees, where the tip was, in the object's axes.
            shears: (n, 6) mm and degrees, what the skin was sheared by.
            rng: Generator of the unfinished fractions.
        """
        unfinished = rng.uniform(0, self.max_unfinished, (len(poses), 1))
        moves = shears / (1 - unfinished)
        tilt = Rotation.from_rotvec([*self.table_tilt_deg, 0.0], degrees=True)
        lever = np.array([*self.tcp_beside_axis_mm, self.tcp_behind_apex_mm])
        turns = tilt * Rotation.from_rotvec(poses[:, 3:], degrees=True)
        places = tilt.apply(poses[:, :3]) + turns.apply(lever) - lever
        ends = np.concatenate([places, turns.as_rotvec(degrees=True)], 1) + moves - shears
        moves = np.concatenate([tilt.apply(moves[:, :3]), moves[:, 3:]], 1)
        return ends, moves

    def zoom(self, part: float) -> float:
        """Return the size of the image relative to the neutral one when a part, 0 to 1, of the frames has been taken. A
        ninth of them take the camera 63 % of the way to its final temperature [?]."""
        return float(1 + self.image_growth * (1 - np.exp(-9 * part)))


def typical_rig_faults(rng: np.random.Generator) -> RigFaults:
    """Return faults as large as those of the published sets and of usual rigs: a table tilted by 1 to 2 degrees, a tool
    centre up to 0.7 mm beside the axis, a tenth of the shear unfinished, an image that grows by 0.5 to 1.5 % [M][?]."""
    azimuth, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(1.0, 2.0)
    behind = float(rng.uniform(-1.0, 1.0))
    x, y = (float(offset) for offset in rng.uniform(-0.5, 0.5, 2))
    return RigFaults(
        table_tilt_deg=(float(tilt * np.cos(azimuth)), float(tilt * np.sin(azimuth))),
        tcp_behind_apex_mm=behind,
        tcp_beside_axis_mm=(x, y),
        max_unfinished=0.1,
        image_growth=float(rng.uniform(0.005, 0.015)),
    )
