"""One contact: press the tip 3 mm into a surface, tilted and sheared, and write what its camera sees."""

from pathlib import Path

import cv2
import tyro

import tactip_twin as tt
from tactip_twin.tactip_model.renderer import RendererName


def main(out: Path = Path("contact.png"), renderer: RendererName = "pyrender") -> None:
    """out: image to write. renderer: pyrender, or raster without OpenGL."""
    tip = tt.TacTip("tactip-127", renderer=renderer)
    contact = tip.press("surface", depth_mm=3, roll_deg=8, shear_mm=(2, 0), shear_deg=(0, 0, 5))
    cv2.imwrite(str(out), contact.image)
    depth_mm, roll_deg, pitch_deg = tt.load_network("surface-tactip-127").predict(contact.image)
    print(
        f"{out}: {contact.force_N[2]:.2f} N; predicted {-depth_mm:.2f} mm deep, {roll_deg:.1f}° roll, {pitch_deg:.1f}° pitch"
    )


if __name__ == "__main__":
    tyro.cli(main)
