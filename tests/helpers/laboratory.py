"""A laboratory's set of a real sensor: frames as a rig might have written them, rendered here, and their table."""

import csv
from dataclasses import replace

import cv2
import numpy as np

from tactip_twin.commands import main as tactip
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

SIZE = 256


DESIGN = design_named("nominal-127")


COLUMNS = ["pose_z=-pose_2-5", "pose_Ry=pose_6", "shear_x=move_1"]


def frame(zoom=1.0, design=DESIGN):
    """A binary frame of the tip, its pins spread by a zoom."""
    tips, directions = neutral_pins(design)
    settings = replace(design.image, size_px=SIZE)
    return tactile_image(Raster(design).render(tips * [zoom, zoom, 1.0], directions), settings)


def with_rim(image):
    """The frame with light at the rim: a long patch, and a speck broken off it."""
    lit = image.copy()
    cv2.ellipse(lit, (SIZE // 2, SIZE // 2), (126, 126), 0, 20, 70, 255, 5)
    cv2.circle(lit, (SIZE // 2 - 124, SIZE // 2 - 10), 3, 255, -1)
    return lit


def write_set(folder, count=12, name="frame_{}.png", **extra):
    (folder / "images").mkdir(parents=True)
    cv2.imwrite(str(folder / "init_0.png"), with_rim(frame()))
    rng = np.random.default_rng(0)
    rows = []
    for k in range(count):
        depth = rng.uniform(-4, 0)
        cv2.imwrite(str(folder / "images" / name.format(k)), with_rim(frame(1 + 0.02 * (5 + depth))))
        row = {"image_name": name.format(k), "pose_1": 0, "pose_2": depth, "pose_6": rng.uniform(-20, 20)}
        rows.append(row | {"move_1": rng.uniform(-5, 5)} | extra)
    write_table(folder, rows)
    return rows


def write_table(folder, rows):
    with (folder / "targets.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def redraw(folder, change):
    """Put what a function makes of each of a laboratory's images in its place."""
    for path in [folder / "init_0.png", *(folder / "images").iterdir()]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), change(image))


def bring(folder, out, *options):
    return tactip.main(["import", str(folder), "--out", str(out), "--columns", *COLUMNS, *options])
