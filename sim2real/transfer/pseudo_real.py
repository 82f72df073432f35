"""A pseudo-real sensor: a second simulated tip with hidden parameters, whose set has the format in which a laboratory would
publish it. Every step with a real set can thus be tried and tested without one. The hidden parameters are sampled from a
seed: mechanics (sim/dataset/mechanics_randomization.py), the gel's Poisson's ratio, camera, pins, light at the rim; frames
are larger than tactile images, with specks.
"""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import encode_image, read_dataset, read_pins
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim2real.importing.column_map import ColumnMap, Task
from tactip_twin.sim2real.importing.import_set import import_set
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.source import read_source
from tactip_twin.sim2real.transfer.rig_faults import RigFaults
from tactip_twin.sim2real.transfer.settings import PseudoKind
from tactip_twin.tactip_model.design import Design, Pins
from tactip_twin.tactip_model.design_file import design_as_dict
from tactip_twin.tactip_model.files import remove_leftovers, write_file
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.sensor_of_image import with_pins
from tactip_twin.tactip_model.tactile_image import tactile_image

FRAME_PX = {"nominal-127": 256, "nominal-331": 360}
"""Width of the frames by preset, px, as in the two published sets: in smaller frames 331 pins touch."""

_RIM_DIAMETERS = {"nominal-127": (0.9, 1.15), "nominal-331": (0.8, 0.95)}
"""Factors of the apparent diameter of the outermost pins by preset. In the nominal 331-pin tip they almost touch; cameras
are adjusted until they do not."""

_GEL_POISSON = (0.41, 0.48)
"""Range of the gel's Poisson's ratio: around those that calibrations of two real tips find, 0.46 and 0.42 (gel.py)."""

COLUMN_MAP = ColumnMap(columns=("pose_z=-depth", "pose_Rx=roll", "pose_Ry=pitch", "pose_Rz=yaw", "pose_x=across"))
"""Conventions of its table: depth is positive into the object."""

_COLUMNS = {
    "pose_z": ("depth", -1.0),
    "pose_Rx": ("roll", 1.0),
    "pose_Ry": ("pitch", 1.0),
    "pose_Rz": ("yaw", 1.0),
    "pose_x": ("across", 1.0),
}


def hidden_design(name: str, seed: int, friction: float | None = None, pins: Pins | None = None) -> Design:
    """Return the design of a hidden sensor similar to a preset.

    Args:
        name: Name of the preset.
        seed: Seed of what is random.
        friction: Its friction, -; None: random.
        pins: Layout and pitch of its pins, or, if `free`, their places; None: those of the preset.
    """
    rng = np.random.default_rng((seed, 77))
    plain = MECHANICS_RANDOMIZATIONS["real"].sample(design_named(name), rng)
    gel = float(np.random.default_rng((seed, 81)).uniform(*_GEL_POISSON))
    plain = replace(plain, materials=replace(plain.materials, gel_poisson=gel))
    if friction is not None:
        plain = replace(plain, materials=replace(plain.materials, friction=friction))
    if pins is not None:
        plain = with_pins(plain, pins, plain.name)
    o, p = plain.optics, plain.pins
    optics = replace(
        o,
        centre=tuple(float(c + rng.uniform(-0.015, 0.015)) for c in o.centre),
        neutral_radius=tuple(float(c) for c in np.array(o.neutral_radius) * rng.uniform(0.95, 1.05)),
        camera_height_m=float(o.camera_height_m + rng.uniform(-2e-3, 2e-3)),
        camera_offset_m=tuple(float(x) for x in rng.uniform(-0.3e-3, 0.3e-3, 2)),
    )
    count = len(neutral_pins(plain)[0])
    places = np.array(p.as_built_m) if p.layout == "free" else np.zeros((count, 2))
    pins = replace(
        p,
        rotation_deg=float(p.rotation_deg + rng.uniform(-6, 6)),
        diameter_m=float(p.diameter_m * rng.uniform(0.9, 1.15)),
        rim_diameter_m=float(p.rim_diameter_m * rng.uniform(*_RIM_DIAMETERS[name])),
        as_built_m=tuple((float(x), float(y)) for x, y in places + rng.normal(0, 0.08e-3, (count, 2))),
    )
    return replace(plain, name=f"hidden-{seed}", optics=optics, pins=pins)


def make_pseudo_real(
    folder: str | Path,
    task: Task,
    name: PseudoKind,
    frames: int,
    seed: int,
    workers: int,
    log: Callable[[str], None] = print,
) -> Path:
    """Make a hidden sensor's set, as published (`lab`) and imported (`set`), and return the path of the latter.

    Args:
        folder: Folder of both; an interrupted run resumes there.
        task: Task of the set.
        name: Preset that the hidden sensor is similar to.
        frames: Number of frames.
        seed: Seed of sensor and contacts.
        workers: Number of worker processes.
        log: Callback for messages to the user.

    Raises:
        TactipError: If the folder holds something else, or a contact fails.
        Interrupted: On Ctrl-C.
    """
    lab = make_lab(folder, hidden_design(name, seed), HiddenSet(task, frames, seed, FRAME_PX[name]), workers, log)
    layout = Layout(replace(COLUMN_MAP, task=task))
    import_set(read_source(lab, layout.column_map), layout, lab.parent / "set", log)
    return lab.parent / "set"


@dataclass(frozen=True)
class HiddenSet:
    """What is recorded with a hidden sensor."""

    task: Task
    """Task of the set."""
    frames: int
    """Number of frames."""
    seed: int
    """Seed of contacts, light and specks."""
    frame_px: int
    """Width of the frames, px."""
    poses: Ranges | None = None
    """Ranges of the poses. Default: those of the task in the paper."""
    faults: RigFaults = field(default_factory=RigFaults)
    """Faults of the rig."""
    neutral_image: bool = True
    """Whether there is an image of the undeformed tip."""


def make_lab(folder: str | Path, design: Design, what: HiddenSet, workers: int, log: Callable[[str], None] = print) -> Path:
    """Make a hidden sensor's set as a laboratory publishes it, and return its folder. An interrupted run resumes.

    Args:
        folder: Folder of the contacts and the published set.
        design: The hidden sensor.
        what: What is recorded.
        workers: Number of worker processes.
        log: Callback for messages to the user.

    Raises:
        TactipError: If the folder holds something else, or a contact fails.
        Interrupted: On Ctrl-C.
    """
    folder = Path(folder)
    configuration = Configuration(
        task=what.task,
        split="test",
        samples=what.frames,
        seed=what.seed,
        renderer="raster",
        design=design,
        fidelity=fidelity_named("standard"),
        pose=what.poses or POSE_RANGES[what.task],
        shear=SHEAR_RANGES,
    )
    make([Job(configuration, folder / "contacts")], workers, log)
    if not (folder / "lab" / "targets.csv").exists():
        _publish(folder / "contacts", design, what, folder / "lab")
    return folder / "lab"


def _publish(contacts: Path, design: Design, what: HiddenSet, lab: Path) -> None:
    """Write frames and table as a laboratory does, the table last."""
    (lab / "images").mkdir(parents=True, exist_ok=True)
    for place in (lab, lab / "images"):
        remove_leftovers(place)
    rng, dataset = np.random.default_rng((what.seed, 78)), read_dataset(contacts)
    camera = _Camera(design, what.frame_px, rng)
    neutral = camera.frame(*neutral_pins(design), rng)
    if what.neutral_image:
        write_file(lab / "init_0.png", encode_image(neutral))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["image_name", *(name for name, _ in _COLUMNS.values()), *SHEARS])
    tips, directions = (pins.astype(float) for pins in read_pins(contacts, dataset.meta))
    table = what.faults.commanded(dataset.poses, dataset.shears, np.random.default_rng((what.seed, 79)))
    if what.task == "surface":  # where on the surface it is pressed makes no difference, and the table does not say it
        table[0][:, :2] = 0.0
    for k, (pose, shear) in enumerate(zip(*table, strict=True)):
        frame = camera.frame(tips[k], directions[k], rng, what.faults.zoom(k / len(tips)))
        write_file(lab / "images" / f"frame_{k}.png", encode_image(frame))
        cells = [f"{sign * pose[LABELS.index(ours)]:.6f}" for ours, (_, sign) in _COLUMNS.items()]
        writer.writerow([f"frame_{k}.png", *cells, *(f"{x:.6f}" for x in shear)])
    write_file(lab / "hidden.json", (json.dumps(design_as_dict(design), indent=1) + "\n").encode())
    write_file(lab / "targets.csv", text.getvalue().encode())


class _Camera:
    """Frames of the hidden sensor, with light at the rim that no contact moves, and specks."""

    def __init__(self, design: Design, width: int, rng: np.random.Generator) -> None:
        self._design = design
        self._rasters: dict[float, Raster] = {}
        self._width = width
        self._image = replace(design.image, size_px=width)
        self._rim = np.zeros((width, width), np.uint8)
        middle, radius = width // 2, width // 2 - 3
        for start in rng.uniform(0, 360, 5):
            end = start + rng.uniform(20, 50)
            cv2.ellipse(self._rim, (middle, middle), (radius, radius), 0, start, end, 255, int(rng.integers(2, 6)))

    def frame(self, tips: np.ndarray, directions: np.ndarray, rng: np.random.Generator, zoom: float = 1.0) -> np.ndarray:
        """Return a frame (h, w) uint8 of pins (p, 3) m and their directions (p, 3), with the image `zoom` times as large."""
        zoom = round(zoom, 3)
        if zoom not in self._rasters:
            optics = replace(self._design.optics, zoom=zoom)
            self._rasters[zoom] = Raster(replace(self._design, optics=optics))
        raster, (x, y) = self._rasters[zoom], np.array(self._design.optics.centre) * self._width - 0.5
        grown = np.array([[zoom, 0, (1 - zoom) * x], [0, zoom, (1 - zoom) * y]])
        rim = self._rim if zoom == 1 else cv2.warpAffine(self._rim, grown, self._rim.shape, flags=cv2.INTER_NEAREST)
        image = np.maximum(tactile_image(raster.render(tips, directions), self._image), rim)
        for x, y in rng.integers(0, self._width, (rng.integers(0, 3), 2)):
            cv2.circle(image, (int(x), int(y)), 1, 255, -1)
        return image
