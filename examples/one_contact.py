"""One contact, one image: press the tip 3 mm into a surface, tilted and sheared, and write what its camera sees."""

from pathlib import Path

import cv2
import tyro

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.presets import find_design
from tactip_twin.tactip_model.renderer import renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image


def main(out: Path = Path("contact.png"), renderer: str = "pyrender"):
    """out: image to write. renderer: pyrender, or raster without OpenGL."""
    design = find_design("tactip-127")
    player = ContactSimulator(design, "surface", fidelity_named("standard"))
    # x, y and depth in mm, roll, pitch and yaw in degrees (sim/pose.py); the shear is how it came there.
    contact = player.play(from_mm_deg([0, 0, -3, 8, 0, 0]), from_mm_deg([2, 0, 0, 0, 0, 5]))
    frame = renderer_named(renderer, design)(contact.tips, contact.directions)
    cv2.imwrite(str(out), tactile_image(frame, design.image))
    print(f"{out}: {contact.normal_force_n:.2f} N, {contact.steps} steps")


if __name__ == "__main__":
    tyro.cli(main)
