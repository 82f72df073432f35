"""A contact of a data set as a recording: simulated again, bit for bit, and recorded at every time step."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import sample_contact, simulator_for
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_rows, versions
from tactip_twin.sim.dataset.sample_maker import object_places
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact
from tactip_twin.sim.robot.recording import RecordedScene, Recorder
from tactip_twin.sim.view.geometry import body_mesh
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.renderer import RENDERERS
from tactip_twin.tactip_model.tactile_image import tactile_image

_PLACE_M = (0.3, 0.0)
"""Position of the stimulus, m: the middle of the table that is shown."""

_MIN_CONTACT_N = 0.02
"""Force above which there is contact, N."""


ReadLabel = Callable[[np.ndarray], Mapping[str, float]]
"""Function of a tactile image to the predicted label by component, mm and degrees."""


def record_contact(
    folder: str | Path, sample: int, out: str | PathLike[str], read: ReadLabel | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Simulate the contact of a sample again and record it.

    A sample that is a rotation or mirror image of a contact is recorded as the contact itself; a sample from a sliding path,
    with the path up to it.

    Args:
        folder: Folder of the data set.
        sample: Index of the sample.
        out: Folder to record into.
        read: Predicts labels from images; None without a network.

    Returns:
        The record and arrays, as recording.read_recording returns them.

    Raises:
        TactipError: If the set cannot be read or was not simulated, there is no such sample, or `out` is in use.
    """
    meta = read_meta(folder)
    configuration = read_configuration(meta, folder)
    rows = read_rows(folder, meta)
    kept = sorted(int(row["index"]) for row in rows)
    if sample not in kept:
        raise TactipError(
            f"the set in {folder} has no sample {sample}: it has {len(kept)} samples from {kept[0]} to {kept[-1]}"
            if kept
            else f"the set in {folder} has no samples"
        )
    number = sample // configuration.samples_per_contact
    contact_sample = sample_contact(configuration, number, object_places(configuration, Path(folder)))
    solid, simulator = contact_sample.solid, simulator_for(configuration, contact_sample.design)
    if solid is not None:
        simulator.replace_solid(solid)
    vertices, triangles = (
        body_mesh(simulator.last.scene.model, "stimulus") if solid is None else (solid.vertices, solid.triangles)
    )
    T_base_object = np.eye(4)
    T_base_object[:3, 3] = [*_PLACE_M, -vertices[:, 2].min()]
    simulator.watch = steps = _Rows(simulator, configuration, T_base_object, read)
    contact, failures = simulator.simulate(contact_sample.pose, contact_sample.shear)
    path = SlidingPath(configuration.task, solid, configuration.pose, contact_sample.pose, contact_sample.rng)
    steps.true_label = path.truth.label
    for _ in range(sample % configuration.samples_per_contact // len(configuration.symmetries)):
        contact = simulator.slide(path.stride(), path.label())
    description = {
        "task": configuration.task,
        "object": f"sample {sample} of {Path(folder).name}",
        "set": {"folder": str(folder), "digest": meta["digest"], "sample": sample, "contact": number},
        "design": json.loads(json.dumps(dataclasses.asdict(configuration.design))),
        "shear": contact.shear.tolist(),
        "tries": len(failures) + 1,
        "versions": versions(),
    }
    radius = configuration.design.shape.radius_m
    scenery = RecordedScene(vertices, triangles, T_base_object, simulator.skin()[1].triangles, radius, False)
    recorder = Recorder(out, description, scenery)
    for row in steps.accepted:
        recorder.add(row)
    return recorder.finish({"stopped_because": "the tip is at rest", "closed": False})


class _Rows:
    """The state after each time step of every try of a RetryingSimulator, as rows of a recording."""

    def __init__(
        self, simulator: RetryingSimulator, configuration: Configuration, T_base_object: np.ndarray, read: ReadLabel | None
    ) -> None:
        self._simulator, self._design, self._read = simulator, configuration.design, read
        self._render = lookup("renderer", configuration.renderer, RENDERERS)(configuration.design)
        self._T_base_object = T_base_object
        self._tries: dict[ContactSimulator, list[dict[str, Any]]] = {}
        self.true_label: Callable[[np.ndarray], np.ndarray] | None = None
        """Function of T_stimulus_sensor (4, 4) to the true label, set while the contact slides on. Before that, the true
        label is the commanded one."""

    @property
    def accepted(self) -> list[dict[str, Any]]:
        """Rows of the accepted try, from its approach on."""
        return self._tries[self._simulator.last]

    def __call__(self, phase: str, label: np.ndarray) -> None:
        """Add the state of a phase at a commanded label (6,), m and rad."""
        simulator = self._simulator.last
        scene = simulator.scene
        skin = scene.vertices()[: scene.mesh.surface_count]
        tips, directions = simulator.reader.read(skin)
        frame, settings = self._render(tips, directions), self._design.image
        image = tactile_image(frame, replace(settings, grey=False))  # recordings have binary images
        force = scene.contact_force()
        predicted = self._predicted(tactile_image(frame, settings) if settings.grey else image)
        T = self._T_base_object @ sensor_in_contact(label)
        self._tries.setdefault(simulator, []).append({
            "T_base_tcp": T,
            "T_base_tcp_measured": T,
            "T_base_object": self._T_base_object,
            "angles_rad": np.full(6, np.nan),
            "pin_tips_m": tips,
            "directions": directions,
            "skin_m": skin,
            "force_n": force,
            "predicted": predicted,
            "predicted_from_image": predicted,
            "deviations": np.full(6, np.nan),
            "true": self.true_label(sensor_in_contact(label)) if self.true_label else label,
            "touching": float(np.linalg.norm(force) > _MIN_CONTACT_N),
            "penetration_m": scene.penetration(),
            "phase": phase,
            "part": 0,
            "sim_steps": 1,
            "seconds": np.zeros(4),
            "images": image,
        })  # fmt: skip

    def _predicted(self, image: np.ndarray) -> np.ndarray:
        """Return the predicted label (6,), m and rad; NaN without a prediction."""
        predicted = self._read(image) if self._read else {}
        return from_mm_deg([predicted.get(component, np.nan if not predicted else 0.0) for component in COMPONENTS])
