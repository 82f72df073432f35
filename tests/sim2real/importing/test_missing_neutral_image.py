"""Import without a neutral image, or with one that does not fit."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.laboratory import DESIGN, SIZE, bring, frame, with_rim, write_set, write_table
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px, reference_pixels, with_spacing
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image


def test_import_other_or_broken_neutral_image_is_refused(tmp_path, capsys):
    write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    other, broken = tmp_path / "other.png", tmp_path / "broken.png"
    cv2.imwrite(str(other), frame(1.01))
    broken.write_bytes(b"no image")
    capsys.readouterr()
    assert bring(tmp_path / "lab", tmp_path / "set", "--neutral", str(other)) == 1
    assert "holds a real data set with other settings (source.neutral_sha256 is" in capsys.readouterr().err
    assert bring(tmp_path / "lab", tmp_path / "third", "--neutral", str(broken)) == 1
    assert "broken.png: it cannot be read as an image" in capsys.readouterr().err


def test_import_finds_neutral_image_beside_frames_but_not_among_them(tmp_path, capsys):
    write_set(tmp_path / "lab")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    images = tmp_path / "lab" / "images"
    (tmp_path / "lab" / "init_0.png").rename(images / "init_0.png")
    assert bring(tmp_path / "lab", tmp_path / "set") == 0  # the same image: the same set
    assert "already holds this set" in capsys.readouterr().out
    # A frame of the table is a contact, whatever its name.
    (images / "init_0.png").unlink()
    table = tmp_path / "lab" / "targets.csv"
    table.write_text(table.read_text().replace("frame_1.png", "init_1.png"))
    (images / "frame_1.png").rename(images / "init_1.png")
    assert bring(tmp_path / "lab", tmp_path / "other") == 0
    assert json.loads((tmp_path / "other" / "import.json").read_text())["neutral_image"] is False


def test_import_without_neutral_image_skips_unusable_frames(tmp_path):
    write_set(tmp_path / "lab")
    (tmp_path / "lab" / "init_0.png").unlink()
    images = tmp_path / "lab" / "images"
    (images / "frame_1.png").write_bytes(b"no image")
    cv2.imwrite(str(images / "frame_3.png"), np.zeros((SIZE, 300), np.uint8))
    assert bring(tmp_path / "lab", tmp_path / "set") == 0
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    assert [one["frame"] for one in report["left_out"]] == ["frame_1.png", "frame_3.png"]


def test_import_without_neutral_image_uses_shallowest_frames(tmp_path, capsys):
    """Each presses the pins of another part outward by two of their widths: in most frames they are where they were."""
    write_set(tmp_path / "lab", 1)
    (tmp_path / "lab" / "init_0.png").unlink()
    tips, directions = neutral_pins(DESIGN)
    rows = []
    for k in range(18):
        depth = 0.05 if k < 5 else 4.0
        away = tips[:, :2] - 0.008 * np.array([np.cos(1.2 * k), np.sin(1.2 * k)])
        pressed = np.linalg.norm(away, axis=1) < 2e-3 * (1 + depth)
        moved = tips + np.where(pressed[:, None], np.pad(away * 0.4, ((0, 0), (0, 1))), 0.0)
        image = tactile_image(Raster(DESIGN).render(moved, directions), replace(DESIGN.image, size_px=SIZE))
        cv2.imwrite(str(tmp_path / "lab" / "images" / f"frame_{k}.png"), with_rim(image))
        rows.append({"image_name": f"frame_{k}.png", "pose_2": depth - 5})
    write_table(tmp_path / "lab", rows)
    command = ["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", "pose_z=-pose_2-5"]
    assert tactip.main(command) == 0
    output = "no neutral image: replaced by the median of the 5 frames that have moved least (-0.05 to -0.05 mm)"
    assert output in capsys.readouterr().out
    design, figures = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert figures["pins"] == 127 and figures["camera"] is None
    assert np.abs(neutral_px(design) - neutral_px(DESIGN)).max() < 0.6
    # One that an earlier version imported, which did not remove the press, is imported anew, and not used before.
    report = json.loads((tmp_path / "set" / "import.json").read_text())
    del report["stand_in"]["press_removed"]
    (tmp_path / "set" / "import.json").write_text(json.dumps(report))
    with pytest.raises(TactipError, match="an earlier version made its replacement: import the set again"):
        fit_design_to_neutral_image(tmp_path / "set", 128)
    assert tactip.main(command) == 0
    assert "whose report is incomplete" in capsys.readouterr().out
    # And one whose report is damaged is named.
    (tmp_path / "set" / "import.json").write_text("{")
    assert tactip.main(command) == 1
    assert "import.json is not JSON" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("low_mm", "high_mm", "tilt_deg", "shear_mm", "max_px"),
    [(1, 2, 0, 0, 0.3), pytest.param(2.5, 4, 10, 3, 0.6, marks=pytest.mark.slow)],
)
def test_press_of_frames_that_replace_a_neutral_image_is_removed(tmp_path, low_mm, high_mm, tilt_deg, shear_mm, max_px):
    """Frames of a stiffer tip: the twin's pins are where that tip's are when nothing touches, although some have moved by
    more than their spacing."""
    write_set(tmp_path / "lab", 1)
    (tmp_path / "lab" / "init_0.png").unlink()
    stiffer = replace(DESIGN, materials=replace(DESIGN.materials, skin_young_pa=1.3 * DESIGN.materials.skin_young_pa))
    simulator, rng = ContactSimulator(stiffer, "surface", fidelity_named("draft")), np.random.default_rng(0)
    rows, moved = [], []
    for k, depth in enumerate(np.linspace(low_mm, high_mm, 16)):
        tilt, slid = rng.uniform(-tilt_deg, tilt_deg, 2), rng.uniform(-shear_mm, shear_mm, 2)
        contact = simulator.simulate(from_mm_deg([0, 0, -depth, *tilt, 0]), from_mm_deg([*slid, 0, 0, 0, 0]))
        drawn = Raster(DESIGN).render(contact.pin_tips, contact.directions)
        image = tactile_image(drawn, replace(DESIGN.image, size_px=SIZE))
        cv2.imwrite(str(tmp_path / "lab" / "images" / f"frame_{k}.png"), image)
        row = {"image_name": f"frame_{k}.png", "depth": depth, "pose_Rx": tilt[0], "pose_Ry": tilt[1]}
        rows.append(row | {"shear_x": slid[0], "shear_y": slid[1]})
        lens = Lens(DESIGN)
        there = reference_pixels(lens.project(contact.pin_tips), lens.width)
        moved.append(np.sqrt(((there - neutral_px(DESIGN)) ** 2).sum(1).mean()))
    write_table(tmp_path / "lab", rows)
    columns = ["pose_z=-depth", *(f"{name}={name}" for name in ("pose_Rx", "pose_Ry", "shear_x", "shear_y"))]
    command = ["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", *columns]
    assert tactip.main(command) == 0
    assert json.loads((tmp_path / "set" / "import.json").read_text())["stand_in"]["press_removed"]
    design, _ = fit_design_to_neutral_image(tmp_path / "set", 128)
    off = np.sqrt(((neutral_px(design) - neutral_px(DESIGN)) ** 2).sum(1).mean())
    assert off < max_px and off < 0.4 * min(moved)
    assert design.pins.diameter_m == pytest.approx(DESIGN.pins.diameter_m, rel=0.2 if tilt_deg else 0.15)


def test_pins_at_rest_follow_from_frames_of_a_narrow_soft_tip(tmp_path):
    """Its pitch and materials, which the nominal tip does not have, are estimated for it; without, the pins are 1 px off."""
    plain = DESIGN.materials
    soft = replace(plain, skin_young_pa=0.7 * plain.skin_young_pa, friction=0.9, kinetic_fraction=0.8)
    design, rng = replace(with_spacing(DESIGN, 0.94), materials=soft), np.random.default_rng(1)
    poses = rng.uniform([0, 0, -5, -10, -10, 0], [0, 0, -2.5, 10, 10, 0], (24, 6))
    rows = write_predicted(tmp_path / "lab", design, poses, rng.uniform(-3, 3, (24, 6)) * [1, 1, 0, 0, 0, 0])
    write_table(tmp_path / "lab", rows)
    columns = ["pose_z=-u1", "pose_Ry=u2", "pose_Rx=-u3", "shear_x=v1", "shear_y=v2"]
    command = ["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--columns", *columns]
    assert tactip.main(command) == 0
    found, _ = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert np.sqrt(((neutral_px(found) - neutral_px(design)) ** 2).sum(1).mean()) < 0.4


def write_predicted(folder, design, poses, shears):
    """Write frames that the learned tip of any materials predicts for a design, and return the rows of their table."""
    tip = FastContacts(read_fast_tip(any_materials("surface")), design)
    contacts, _ = tip.predict(from_mm_deg(poses), from_mm_deg(shears))
    (folder / "images").mkdir(parents=True)
    rows = []
    for k, contact in enumerate(contacts):
        drawn = Raster(design).render(contact.pin_tips, contact.directions)
        image = tactile_image(drawn, replace(design.image, size_px=360))
        cv2.imwrite(str(folder / "images" / f"frame_{k}.png"), image)
        row = {"image_name": f"frame_{k}.png", "u1": -poses[k, 2], "u2": poses[k, 4], "u3": -poses[k, 3]}
        rows.append(row | {"v1": shears[k, 0], "v2": shears[k, 1]})
    return rows


@pytest.mark.slow
def test_conventions_are_found_without_neutral_image_on_deep_frames(tmp_path, capsys):
    """331 pins, 2.5 to 5 mm deep, tilted and sheared: no frame shows the pins near where they are at rest."""
    plain = design_named("nominal-331")
    stiffer = replace(plain.materials, friction=0.9, kinetic_fraction=0.8, skin_young_pa=1.2 * plain.materials.skin_young_pa)
    design, rng = replace(plain, materials=stiffer), np.random.default_rng(1)
    low, high = np.array([[0, 0, -5, -12, -12, 0], [0, 0, -2.5, 12, 12, 0]])
    poses, shears = rng.uniform(low, high, (150, 6)), rng.uniform(-4, 4, (150, 6)) * [1, 1, 0, 0, 0, 0]
    write_table(tmp_path / "lab", write_predicted(tmp_path / "lab", design, poses, shears))
    assert tactip.main(["import", str(tmp_path / "lab"), "--out", str(tmp_path / "set"), "--find"]) == 0
    output = capsys.readouterr().out
    assert "no neutral image shows it" in output and "press removed by a learned tip" in output
    found = read_dataset(tmp_path / "set").poses
    assert np.abs(found[:, 2] - poses[:, 2]).mean() < 0.05
    assert np.abs(found[:, 3:5] - poses[:, 3:5]).mean() < 1.0
    design, _ = fit_design_to_neutral_image(tmp_path / "set", 128)
    assert np.sqrt(((neutral_px(design) - neutral_px(plain)) ** 2).sum(1).mean()) < 0.6


def test_import_other_layout_without_neutral_image(tmp_path):
    """128 px frames of a tip with 331 pins, named without an ending; depth positive, three components, no neutral image."""
    design = design_named("nominal-331")
    small = replace(design, image=replace(design.image, size_px=128))
    tips, directions = neutral_pins(design)
    folder = tmp_path / "lab"
    (folder / "frames").mkdir(parents=True)
    rows = []
    for k in range(6):
        image = tactile_image(Raster(small).render(tips * [1 + 0.01 * k, 1 + 0.01 * k, 1], directions), small.image)
        cv2.imwrite(str(folder / "frames" / f"image_{k}.png"), image)
        rows.append({"sensor_image": f"image_{k}", "depth": 1 + 0.5 * k, "roll": k, "pitch": -k})
    write_table(folder, rows)
    layout = tmp_path / "layout.json"
    layout.write_text(json.dumps({"columns": ["pose_z=-depth", "pose_Rx=roll", "pose_Ry=pitch"]}))
    out = tmp_path / "set"
    assert tactip.main(["import", str(folder), "--out", str(out), "--layout", str(layout)]) == 0
    dataset = read_dataset(out)
    assert np.allclose(dataset.poses[:, 2], [-1 - 0.5 * k for k in range(6)], atol=1e-5)
    assert not dataset.shears.any()
    report = json.loads((out / "import.json").read_text())
    assert not report["neutral_image"] and report["stand_in"]["pose_z"][0] == -1.0
