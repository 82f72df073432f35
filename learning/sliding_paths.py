"""Sliding paths of data sets as sequences of states of the skin, from which a sliding tip is taught.

A set has its poses on the object in targets.csv, but not where on a curved surface they are. Both follow from the seed, so
the paths are walked again here.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import ContactSample, sample_contact
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_rows
from tactip_twin.sim.dataset.mesh_states import read_mesh_states
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.fast_tip.materials import mechanics_of
from tactip_twin.sim.fast_tip.measures import MEASURES, measures_of
from tactip_twin.sim.fast_tip.overlap import dome_points, overlap_harmonics
from tactip_twin.sim.fast_tip.skin_field import SkinSampler
from tactip_twin.sim.fast_tip.sliding_tip import Steps, motion_between
from tactip_twin.sim.labels import LABELS, Task
from tactip_twin.sim.pose import before_shear, sensor_in_contact, to_mm_deg
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import build_mesh

_SAME_MM_DEG = 5e-3
"""Largest difference between a walked label and the one in targets.csv, mm and degrees: more than their rounding."""


@dataclass(frozen=True)
class SlidingPaths:
    """Paths of one task and tip. (p paths, n states each; the first one is that of a contact after its shear)"""

    configuration: Configuration
    """Configuration of the first set."""
    poses: np.ndarray
    """(p, n, 6) m and rad, labels."""
    motions: np.ndarray
    """(p, n, 6) m and rad: sliding_tip.Steps.motions."""
    overlaps: np.ndarray
    """(p, n, rings, orders) complex64: sliding_tip.Steps.overlaps."""
    harmonics: np.ndarray
    """(p, n, rings, 6, orders) complex64, deformation of the skin (SkinSampler.harmonics), in the sensor's axes."""
    measures: np.ndarray
    """(p, n, MEASURES); NaN where a state failed its checks."""
    skins: np.ndarray
    """(p, n, s, 3) float32 m, vertices of the skin."""

    @property
    def task(self) -> Task:
        """Task of the paths."""
        return "edge" if self.configuration.task == "edge" else "surface"

    @property
    def good(self) -> np.ndarray:
        """(p, n) bool: whether a state passed its checks."""
        return np.isfinite(self.measures[..., 0])

    def step(self, k: int) -> Steps:
        """Return the steps of all paths to state k."""
        touched = np.full(len(self.poses), k > 0)
        return Steps(self.poses[:, k], self.motions[:, k], self.overlaps[:, k], touched)

    def joined(self, others: Sequence["SlidingPaths"]) -> "SlidingPaths":
        """Return these paths and others."""
        names = ("poses", "motions", "overlaps", "harmonics", "measures", "skins")
        parts = (self, *others)
        return dataclasses.replace(self, **{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def read_paths(folders: Sequence[Path]) -> SlidingPaths:
    """Read the paths of sets of one task and tip, all with the same number of images per contact.

    Raises:
        TactipError: A set is not simulated, has no meshes or no sliding paths, or differs from the first in task, fidelity,
            number of images, shape or materials.
    """
    require(len(folders) > 0, "the number of training sets", len(folders), "at least one (name their folders)")
    parts = [_read_set(Path(folder)) for folder in folders]
    first = parts[0].configuration
    for folder, part in zip(folders, parts, strict=True):
        check_same_tip(part.configuration, first, folder, folders[0])
        if part.poses.shape[1] != parts[0].poses.shape[1]:
            raise TactipError(f"{folder} has another number of images per contact than {folders[0]}")
    return parts[0].joined(parts[1:])


def check_same_tip(one: Configuration, first: Configuration, folder: Path, first_folder: Path) -> None:
    """Raise TactipError where the set in a folder is not of the task, fidelity and tip of another."""
    for name in ("task", "fidelity"):
        if getattr(one, name) != getattr(first, name):
            raise TactipError(f"{folder} has another {name} than {first_folder}: a tip is learned from sets of one {name}")
    if mechanics_of(one.design) != mechanics_of(first.design):
        raise TactipError(f"{folder} has a tip of another shape or other materials than {first_folder}")


def _read_set(folder: Path) -> SlidingPaths:
    meta = read_meta(folder)
    c = read_configuration(meta, folder)
    if c.snapshots_per_contact < 2 or c.augment_symmetry or not c.mechanics_randomization.is_identity:
        raise TactipError(
            f"the set in {folder} cannot teach a sliding tip: make it with --snapshots-per-contact of at least 2, without "
            "--augment-symmetry and with one tip"
        )
    rows = {int(row["index"]): row for row in read_rows(folder, meta)}
    states = read_mesh_states(folder, meta).by_contact()
    mesh = build_mesh(c.design.shape, c.fidelity.mesh)
    sampler, points, each = SkinSampler(mesh), dome_points(c.design.shape.radius_m), c.snapshots_per_contact
    columns = ("force_x_N", "force_y_N", "force_z_N", *MEASURES[3:])
    found = []
    for number, vertices in states.items():
        sample = sample_contact(c, number)
        poses, motions, sensors = _walk(c, sample)
        distance = stimulus_named(c.task).distance if sample.solid is None else sample.solid.distance
        at = np.concatenate([points @ T[:3, :3].T + T[:3, 3] for T in sensors])
        overlaps = overlap_harmonics(distance(at).reshape(each, -1))
        cells = np.full((each, len(columns)), np.nan)
        for k in range(each):
            row = rows.get(number * each + k)
            if row is not None:
                cells[k] = [float(row[name]) for name in columns]
                if k or not c.is_curved:
                    _check_label(c, poses[k], np.array([float(row[name]) for name in LABELS]), folder)
        skins = vertices[1:, : mesh.surface_count]
        measures = measures_of(poses, cells[:, :3], cells[:, 3:])
        found.append((poses, motions, overlaps, sampler.harmonics(skins), measures, skins))
    if not found:
        raise TactipError(f"the set in {folder} has no contacts")
    return SlidingPaths(c, *(np.array(part) for part in zip(*found, strict=True)))


def _walk(c: Configuration, sample: ContactSample) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return labels (n, 6), motions (n, 6) and sensors n of (4, 4), in the frame of the object, along a path."""
    path = SlidingPath(c.task, sample.solid, c.pose, sample.pose, sample.rng)
    sensors = [sensor_in_contact(sample.pose)]
    sensors += [sensor_in_contact(path.stride()) for _ in range(c.snapshots_per_contact - 1)]
    before = [sensor_in_contact(before_shear(sample.pose, sample.shear)), *sensors[:-1]]
    poses = np.array([path.truth.label(T) for T in sensors])
    motions = [motion_between(a, b, path.truth.frame(b)) for a, b in zip(before, sensors, strict=True)]
    return poses, np.array(motions), sensors


def _check_label(c: Configuration, walked: np.ndarray, read: np.ndarray, folder: Path) -> None:
    """Raise TactipError if a walked label (6,) differs from one of targets.csv in what the task learns."""
    learned = [0, 2, 3, 4, 5] if c.task == "edge" else [2, 3, 4]
    if np.abs(to_mm_deg(walked) - read)[learned].max() > _SAME_MM_DEG:
        raise TactipError(f"the set in {folder} was made by another version: its labels cannot be found again")
