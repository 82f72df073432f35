"""A stimulus of one's own: a pipe, told by its signed distance and by what MuJoCo makes contacts with."""

from dataclasses import dataclass

import mujoco
import numpy as np
import tyro

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.stimuli import HALF_SIZE_M, Stimulus
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.presets import find_design
from tactip_twin.tactip_model.soft_body import TOUCHES_VERTICES


@dataclass(frozen=True)
class Pipe(Stimulus):
    """A pipe along y, its highest line at z = 0."""

    radius_m: float = 15e-3
    """Radius, m."""

    def add_geoms(self, spec, body, touch):
        """A cylinder, which the skin's vertices meet."""
        kind, size, along_y = mujoco.mjtGeom.mjGEOM_CYLINDER, [self.radius_m, HALF_SIZE_M, 0], [1, -1, 0, 0]
        place = [0, 0, -self.radius_m]
        body.add_geom(type=kind, size=size, pos=place, quat=along_y, contype=0, conaffinity=TOUCHES_VERTICES, **touch)

    def distance(self, points):
        """Signed distance (...) m of points (..., 3) m: what the contact is held to."""
        return np.hypot(points[..., 0], points[..., 2] + self.radius_m) - self.radius_m


def main(radii_mm: tuple[float, ...] = (10.0, 15.0, 30.0), depth_mm: float = 3.0, fidelity: str = "standard"):
    """radii_mm: of the pipes. depth_mm: of the press. fidelity: draft, standard or reference."""
    design = find_design("tactip-127")
    for radius_mm in radii_mm:
        player = ContactSimulator(design, Pipe(radius_mm / 1e3), fidelity_named(fidelity))
        contact = player.play(from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), np.zeros(6))
        inside_um = 1e6 * contact.overlap_m
        print(f"radius {radius_mm:g} mm: {contact.normal_force_n:.3f} N; the skin is {inside_um:.0f} µm inside the pipe")


if __name__ == "__main__":
    tyro.cli(main)
