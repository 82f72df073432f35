"""A servo with an estimator of one's own: a linear map from where pins are to the pose, in the place of the network."""

from pathlib import Path

import numpy as np
import tyro

from tactip_twin.control.estimator import Estimate, Estimator
from tactip_twin.control.options import Options, RouteOptions
from tactip_twin.control.servo_run import run
from tactip_twin.sim.dataset.format import read_dataset, read_pins
from tactip_twin.sim.pose import from_mm_deg


class Linear(Estimator):
    """Reads depth, roll and pitch by ridge regression, from the pins of a simulated set."""

    def __init__(self, folder, ridge=1e-2):
        """folder: a set. ridge: float, of the mean square of what pins move."""
        dataset = read_dataset(folder)
        tips, _ = read_pins(folder, dataset.meta)
        seen = tips[..., :2].reshape(len(tips), -1).astype(float)
        self._mean, labels = seen.mean(0), dataset.poses[:, 2:5]
        moved, self._label = seen - self._mean, labels.mean(0)
        square = moved @ moved.T + ridge * (moved**2).sum(1).mean() * np.eye(len(moved))
        self._map = moved.T @ np.linalg.solve(square, labels - self._label)
        self._still = tips[np.argmax(dataset.poses[:, 2])][..., :2]

    def look(self, touch, T_base_tcp):
        """Tell a Estimate of a touch; where the sensor truly is (T_base_tcp) is not for an estimator to know."""
        told = np.zeros(6)
        told[2:5] = (touch.tips[:, :2].ravel() - self._mean) @ self._map + self._label
        # The network tells by the image whether there is contact; here the simulated force does.
        touching = float(np.linalg.norm(touch.force) > 0.02)
        return Estimate(from_mm_deg(told), touching, np.zeros((128, 128), np.uint8))


def main(data: Path, out: Path = Path("runs/own-estimator"), object: str = "sphere", length_mm: float = 20.0):
    """data: folder of a set of surface contacts. out: folder of the run. object: what to follow. length_mm: how far."""
    route = RouteOptions(kind="straight", length_mm=length_mm)
    score = run(
        Options(out, "surface", object, arm="none", fidelity="draft", renderer="raster", route=route), estimator=Linear(data)
    )
    print(
        f"{score['steps']} steps, {score['depth_mae_mm']:.2f} mm, {score['angle_mean_deg']:.1f}°; {score['stopped_because']}"
    )


if __name__ == "__main__":
    tyro.cli(main)
