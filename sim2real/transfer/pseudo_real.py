"""A sensor that is real to the network alone: a second simulated tip, whose parameters are hidden, published as a laboratory
would.

So that everything that is done with a real set can be done, and tested, without one. What is hidden is drawn from its seed:
mechanics (sim/dataset/mechanics_randomization.py), camera, pins, light at the rim; frames are larger than tactile
images, with specks.
"""

import csv
import io
import json
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import encode_image, read_dataset, read_pins
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.import_set import import_set, read_source
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

FRAME_PX = 256
"""Width of the frames that are published."""

COLUMN_MAP = ColumnMap(columns=("pose_z=-depth", "pose_Rx=roll", "pose_Ry=pitch", "pose_Rz=yaw", "pose_x=across"))
"""What its table says: depth is positive into the object."""

_COLUMNS = {
    "pose_z": ("depth", -1.0),
    "pose_Rx": ("roll", 1.0),
    "pose_Ry": ("pitch", 1.0),
    "pose_Rz": ("yaw", 1.0),
    "pose_x": ("across", 1.0),
}


def hidden_design(name, seed):
    """The Design of a hidden sensor of the kind of a preset (str)."""
    draw = np.random.default_rng((seed, 77))
    plain = MECHANICS_RANDOMIZATIONS["real"].sample(design_named(name), draw)
    o, p = plain.optics, plain.pins
    optics = replace(
        o,
        centre=tuple(float(c + draw.uniform(-0.015, 0.015)) for c in o.centre),
        neutral_radius=tuple(float(c) for c in np.array(o.neutral_radius) * draw.uniform(0.95, 1.05)),
        camera_height_m=float(o.camera_height_m + draw.uniform(-2e-3, 2e-3)),
        camera_offset_m=tuple(float(x) for x in draw.uniform(-0.3e-3, 0.3e-3, 2)),
    )
    count = len(neutral_pins(plain)[0])
    pins = replace(
        p,
        rotation_deg=float(p.rotation_deg + draw.uniform(-6, 6)),
        diameter_m=float(p.diameter_m * draw.uniform(0.9, 1.15)),
        rim_diameter_m=float(p.rim_diameter_m * draw.uniform(0.9, 1.15)),
        as_built_m=tuple((float(x), float(y)) for x, y in draw.normal(0, 0.08e-3, (count, 2))),
    )
    return replace(plain, name=f"hidden-{seed}", optics=optics, pins=pins)


def make_pseudo_real(folder, task, name, frames, seed, workers, say=print):
    """Make a hidden sensor's set in a folder (path): as published (`lab`) and imported (`set`). Returns the latter's path.

    task: surface or edge. name: nominal-127 or nominal-331. frames: int. seed: int. workers: int. say: called with lines.
    Raises TactipError, and Interrupted at Ctrl-C; it goes on where it was.
    """
    folder = Path(folder)
    design = hidden_design(name, seed)
    configuration = Configuration(
        task=task,
        split="test",
        samples=frames,
        seed=seed,
        renderer="raster",
        design=design,
        fidelity=fidelity_named("standard"),
        pose=POSE_RANGES[task],
        shear=SHEAR_RANGES,
    )
    make([Job(configuration, folder / "contacts")], workers, say)
    lab = folder / "lab"
    if not (lab / "targets.csv").exists():
        _publish(folder / "contacts", design, lab, seed)
    layout = Layout(replace(COLUMN_MAP, task=task))
    import_set(read_source(lab, layout.column_map), layout, folder / "set", say)
    return folder / "set"


def _publish(contacts, design, lab, seed):
    """Write frames and table as a laboratory does, table last."""
    (lab / "images").mkdir(parents=True, exist_ok=True)
    draw, dataset = np.random.default_rng((seed, 78)), read_dataset(contacts)
    camera = _Camera(design, draw)
    write_file(lab / "init_0.png", encode_image(camera.frame(*neutral_pins(design), draw)))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["image_name", *(name for name, _ in _COLUMNS.values()), *SHEARS])
    tips, directions = (pins.astype(float) for pins in read_pins(contacts, dataset.meta))
    for k, (pose, shear) in enumerate(zip(dataset.poses, dataset.shears, strict=True)):
        write_file(lab / "images" / f"frame_{k}.png", encode_image(camera.frame(tips[k], directions[k], draw)))
        told = [f"{sign * pose[LABELS.index(ours)]:.6f}" for ours, (_, sign) in _COLUMNS.items()]
        writer.writerow([f"frame_{k}.png", *told, *(f"{x:.6f}" for x in shear)])
    write_file(lab / "hidden.json", (json.dumps(asdict(design), indent=1) + "\n").encode())
    write_file(lab / "targets.csv", text.getvalue().encode())


class _Camera:
    """Frames of the hidden sensor, with light at the rim that no contact moves, and specks."""

    def __init__(self, design, draw):
        self._raster = Raster(design)
        self._image = replace(design.image, size_px=FRAME_PX)
        self._rim = np.zeros((FRAME_PX, FRAME_PX), np.uint8)
        middle, radius = FRAME_PX // 2, FRAME_PX // 2 - 3
        for start in draw.uniform(0, 360, 5):
            end = start + draw.uniform(20, 50)
            cv2.ellipse(self._rim, (middle, middle), (radius, radius), 0, start, end, 255, int(draw.integers(2, 6)))

    def frame(self, tips, directions, draw):
        """A frame (FRAME_PX, FRAME_PX) uint8 of pins (p, 3)."""
        image = np.maximum(tactile_image(self._raster.render(tips, directions), self._image), self._rim)
        for x, y in draw.integers(0, FRAME_PX, (draw.integers(0, 3), 2)):
            cv2.circle(image, (int(x), int(y)), 1, 255, -1)
        return image
