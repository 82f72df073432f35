"""A servo run with an estimator of your own: a linear map from the tactile image to the pose instead of the network."""

from pathlib import Path

import cv2
import numpy as np
import tyro

import tactip_twin as tt


def features(image: np.ndarray) -> np.ndarray:
    """Return the image, blurred and reduced to 32 by 32 px, as a vector with a constant 1."""
    return np.append(cv2.resize(cv2.GaussianBlur(image, (0, 0), 2), (32, 32)).ravel() / 255, 1)


def main(data: Path, out: Path = Path("runs/own-estimator"), object: str = "sphere", length_mm: float = 20.0) -> None:
    """data: folder of a set of surface contacts. out: folder of the run. object: what to follow. length_mm: how far."""
    samples = tt.read_samples(data)
    X = np.array([features(image) for image in samples.images])
    weights = np.linalg.pinv(X, rcond=1e-2) @ samples.targets

    def estimate(image: np.ndarray) -> np.ndarray:
        """Return depth (mm), roll and pitch (degrees)."""
        return features(image) @ weights

    route = tt.RouteOptions(kind="straight", length_mm=length_mm)
    options = tt.ServoOptions(out, "surface", object, arm="none", fidelity="draft", renderer="raster", route=route)
    score = tt.run_servo(options, estimator=estimate)
    print(
        f"{score['steps']} steps, {score['depth_mae_mm']:.2f} mm, {score['angle_mean_deg']:.1f}°; {score['stopped_because']}"
    )


if __name__ == "__main__":
    tyro.cli(main)
