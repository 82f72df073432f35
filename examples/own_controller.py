"""A servo run with a controller of your own: proportional control instead of the paper's proportional-integral control."""

from pathlib import Path

import numpy as np
import tyro
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

import tactip_twin as tt
from tactip_twin.control.servo import pose_error, reference_mm_deg
from tactip_twin.sim.pose import from_mm_deg, matrix


class Proportional(tt.Controller):
    """Moves by half of the error at each step."""

    def move(self, label: np.ndarray, along: ArrayLike = (0.0, 0.0, 0.0), max_press_m: float = np.inf) -> np.ndarray:
        error = 0.5 * pose_error(label, from_mm_deg(reference_mm_deg(depth_mm=2)))
        return matrix(error[:3] + np.asarray(along), Rotation.from_rotvec(error[3:]))


def main(out: Path = Path("runs/own-controller"), object: str = "sphere", length_mm: float = 20.0) -> None:
    """out: folder of the run. object: what to follow. length_mm: how far."""
    route = tt.RouteOptions(kind="straight", length_mm=length_mm)
    options = tt.ServoOptions(out, "surface", object, arm="none", fidelity="draft", renderer="raster", route=route)
    score = tt.run_servo(options, controller=Proportional())
    print(
        f"{score['steps']} steps, {score['depth_mae_mm']:.2f} mm, {score['angle_mean_deg']:.1f}°; {score['stopped_because']}"
    )


if __name__ == "__main__":
    tyro.cli(main)
