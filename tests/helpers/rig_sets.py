"""A real set as a laboratory takes it: frames of a hidden sensor on a rig, and the rig's commands."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.sim2real.calibration.parameters import SensorOnRig
from tactip_twin.sim2real.calibration.rig import Rig, RigMotion
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

TAP = from_mm_deg([0, 5, 0, 0, 0, 0])
RIG = Rig(
    press_axis=(0.0, 1.0, 0.0),
    azimuth_deg=-75.0,
    depth_zero_m=0.2e-3,
    tcp_behind_apex_m=12e-3,
    tilt_zero_deg=(0.8, -0.6),
)


def hidden_twin():
    plain = design_named("nominal-127")
    return SensorOnRig(
        replace(
            plain,
            materials=replace(plain.materials, friction=0.65, kinetic_fraction=0.6, skin_young_pa=0.9e6, gel_young_pa=1.6e4),
            pins=replace(plain.pins, length_m=2.2e-3, rotation_deg=31.0),
            optics=replace(plain.optics, camera_height_m=9e-3, zoom=1.012, drift=(0.002, -0.001), frame_px=512),
        ),
        RIG,
    )


def picture(design, tips, directions):
    settings = replace(design.image, threshold=(87, -5.0), size_px=256)
    return tactile_image(Raster(design).render(tips, directions), settings)


def write_set(folder, twin, count, seed=0):
    """Write a real set of the hidden sensor, half of its frames taken during the move; return the finished fractions."""
    rng = np.random.default_rng(seed)
    simulator, motion = ContactSimulator(twin.design, "surface", fidelity_named("draft")), RigMotion(twin.rig)
    (folder / "images").mkdir(parents=True)
    at_rest = replace(twin.design, optics=replace(twin.design.optics, zoom=1.0, drift=(0.0, 0.0)))
    cv2.imwrite(str(folder / "init_0.png"), picture(at_rest, *neutral_pins(at_rest)))
    fractions = np.where(rng.random(count) < 0.5, 1.0, rng.random(count))
    columns = ["image_name", *(f"{k}_{i}" for k in ("pose", "move") for i in range(1, 7))]
    with (folder / "targets.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(columns)
        for i, fraction in enumerate(fractions):
            pose = from_mm_deg([0, rng.uniform(-3.5, -0.5), 0, 0, 0, rng.uniform(-15, 15)])
            move = from_mm_deg([rng.uniform(-3, 3), 0, 0, 0, 0, rng.uniform(-4, 4)])
            contact = simulator.simulate(*motion.contact(pose, move, TAP, fraction))
            cv2.imwrite(str(folder / f"images/f_{i}.png"), picture(twin.design, contact.pin_tips, contact.directions))
            rows.writerow([f"f_{i}.png", *to_mm_deg(pose), *to_mm_deg(move)])
    (folder / "meta.json").write_text(json.dumps({"tap_move": to_mm_deg(TAP).tolist()}))
    return fractions
