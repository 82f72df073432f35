"""Import of frames of sensors whose pins no preset has."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.laboratory import write_table
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image
from tactip_twin.tactip_model.design import Pins
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

ANGLES = ("pose_Rx", "pose_Ry")


def square_array():
    """Return a tip with 7 by 7 pins, and the lens of a preset."""
    plain = replace(design_named("nominal-127"), materials=design_named("tactip-127").materials)
    line = np.linspace(-12e-3, 12e-3, 7)
    places = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    pins = Pins("free", 6, diameter_m=1.2e-3, rim_diameter_m=1.2e-3, as_built_m=tuple(map(tuple, places)))
    return replace(plain, name="square", pins=pins)


def write_lab(folder, design, frames, low_mm, high_mm, neutral):
    """Write frames of tilted and sheared presses, their table with positive depths, and a neutral image if wanted."""
    rng = np.random.default_rng(0)
    depths, tilts, slides = rng.uniform(low_mm, high_mm, frames), *rng.uniform(-1, 1, (2, frames, 2))
    poses, shears = np.zeros((frames, 6)), np.zeros((frames, 6))
    poses[:, 2], poses[:, 3:5], shears[:, :2] = -depths, 12 * tilts, 3 * slides
    tip = FastContacts(read_fast_tip(any_materials("surface")), design)
    contacts, _ = tip.predict(from_mm_deg(poses), from_mm_deg(shears))
    (folder / "images").mkdir(parents=True)
    pins = [(contact.pin_tips, contact.directions) for contact in contacts]
    for k, shown in enumerate([*pins, neutral_pins(design)][: frames + neutral]):
        image = tactile_image(Raster(design).render(*shown), replace(design.image, size_px=256))
        name = f"images/frame_{k}.png" if k < frames else "init_0.png"
        cv2.imwrite(str(folder / name), image)
    rows = []
    for k in range(frames):
        row = {"image_name": f"frame_{k}.png", "depth": depths[k], "shear_x": shears[k, 0], "shear_y": shears[k, 1]}
        rows.append(row | dict(zip(ANGLES, poses[k, 3:5], strict=True)))
    write_table(folder, rows)
    return poses


def places_apart_px(design, hidden):
    """Return the distance of each of a tip's pins in the neutral image from the nearest of another's, px of 256."""
    return np.linalg.norm(neutral_px(hidden)[:, None] - neutral_px(design)[None], axis=2).min(1)


def test_press_of_frames_of_a_square_array_is_removed(tmp_path):
    hidden = square_array()
    write_lab(tmp_path / "lab", hidden, 60, 1, 3, neutral=False)
    columns = ["pose_z=-depth", *(f"{name}={name}" for name in (*ANGLES, "shear_x", "shear_y"))]
    assert tactip.main(["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", *columns]) == 0
    assert json.loads((tmp_path / "set" / "import.json").read_text())["stand_in"]["press_removed"]
    design, figures = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert (figures["layout"], figures["pins"]) == ("free-49", 49)
    # Where they touch, the pins have moved by 3 px in the mean.
    assert np.sqrt((places_apart_px(design, hidden) ** 2).mean()) < 0.5


@pytest.mark.slow
def test_conventions_of_a_square_array_are_found(tmp_path, capsys):
    hidden = square_array()
    poses = write_lab(tmp_path / "lab", hidden, 100, 1, 4, neutral=True)
    assert tactip.main(["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--find"]) == 0
    assert "found: --task surface --columns pose_z=-depth" in capsys.readouterr().out
    found = read_dataset(tmp_path / "set").poses
    assert np.abs(found - poses)[:, 2].max() < 0.2 and np.abs(found - poses)[:, 3:].max() < 1.0
    design, _ = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert places_apart_px(design, hidden).max() < 0.5
