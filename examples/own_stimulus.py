"""A stimulus of your own: a pipe, defined by its signed distance and by the geoms that MuJoCo collides."""

from dataclasses import dataclass

import mujoco
import numpy as np
import tyro

import tactip_twin as tt
from tactip_twin.sim.contact.stimuli import HALF_SIZE_M, ContactAttributes
from tactip_twin.sim.labels import FidelityName
from tactip_twin.tactip_model.soft_body import TOUCHES_VERTICES


@dataclass(frozen=True)
class Pipe(tt.Stimulus):
    """A pipe along y, its highest line at z = 0."""

    radius_m: float = 15e-3
    """Radius, m."""

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """Add a cylinder, which the skin's vertices touch."""
        kind, size, along_y = mujoco.mjtGeom.mjGEOM_CYLINDER, [self.radius_m, HALF_SIZE_M, 0], [1, -1, 0, 0]
        place = [0, 0, -self.radius_m]
        body.add_geom(type=kind, size=size, pos=place, quat=along_y, contype=0, conaffinity=TOUCHES_VERTICES, **touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (...) m of points (..., 3) m: contacts are checked against it."""
        return np.hypot(points[..., 0], points[..., 2] + self.radius_m) - self.radius_m


def main(
    radii_mm: tuple[float, ...] = (10.0, 15.0, 30.0), depth_mm: float = 3.0, fidelity: FidelityName = "standard"
) -> None:
    """radii_mm: of the pipes. depth_mm: of the press. fidelity: draft, standard or reference."""
    tip = tt.TacTip("tactip-127", fidelity)
    for radius_mm in radii_mm:
        contact = tip.press(Pipe(radius_mm / 1e3), depth_mm=depth_mm)
        overlap_um = 1e6 * contact.record.overlap_m
        print(f"radius {radius_mm:g} mm: {contact.force_N[2]:.3f} N; skin and pipe overlap by {overlap_um:.0f} µm")


if __name__ == "__main__":
    tyro.cli(main)
