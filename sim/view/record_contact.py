"""A contact of a data set as a recording: played once more, the same to the bit, and kept at every time step."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_rows, versions
from tactip_twin.sim.dataset.generate import sample_contact, simulator_for
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact
from tactip_twin.sim.robot.recording import RecordedScene, Recorder
from tactip_twin.sim.view.geometry import body_mesh
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.renderer import renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image

_PLACE_M = (0.3, 0.0)
"""Where the stimulus stands, m: in the middle of the table that is drawn."""

_LEAST_N = 0.02
"""Force from which on there is contact, N."""


def record_contact(folder, sample, out, read: Callable | None = None):
    """Play the contact that sample `sample` (int) of the set in a folder is of, and record it into the folder `out`.

    A sample that is a turn or a mirror of a contact is shown as the contact itself; a look on a walk, with the walk to it.

    read: function of a tactile image to a dict of what is felt by component (mm and degrees), or None. Returns the record
    and arrays, as recording.read_recording. Raises TactipError where the set cannot be read or was not simulated, there is
    no such sample, or `out` is in use.
    """
    meta = read_meta(folder)
    configuration = read_configuration(meta, folder)
    rows = read_rows(folder, meta)
    kept = sorted(int(row["index"]) for row in rows)
    if sample not in kept:
        raise TactipError(
            f"the set in {folder} has no sample {sample}: it has {len(kept)} of them, {kept[0]} to {kept[-1]}"
            if kept
            else f"the set in {folder} has no sample"
        )
    number = sample // configuration.each
    given = sample_contact(configuration, number)
    solid, player = given.solid, simulator_for(configuration, given.design)
    if solid is not None:
        player.stimulus.solid = solid
    scene = player.last.scene
    thing = body_mesh(scene.model, "stimulus") if solid is None else (solid.vertices, solid.triangles)
    T_base_object = np.eye(4)
    T_base_object[:3, 3] = [*_PLACE_M, -thing[0][:, 2].min()]
    player.watch = keeper = _Keeper(player, configuration, T_base_object, read)
    contact, faults = player.play(given.pose, given.shear)
    walk = SlidingPath(configuration.task, solid, configuration.pose, given.pose, given.draw)
    keeper.truth = walk.truth
    for _ in range(sample % configuration.each // len(configuration.symmetries)):
        contact = player.slide(walk.stride(), walk.label())
    description = {
        "task": configuration.task,
        "object": f"sample {sample} of {Path(folder).name}",
        "set": {"folder": str(folder), "digest": meta["digest"], "sample": sample, "contact": number},
        "shear": contact.shear.tolist(),
        "tries": len(faults) + 1,
        "versions": versions(),
    }
    radius = configuration.design.shape.radius_m
    recorder = Recorder(out, description, RecordedScene(*thing, T_base_object, scene.mesh.triangles, radius, False))
    for row in keeper.rows:
        recorder.add(row)
    return recorder.finish({"stopped_because": "the tip is at rest", "closed": False})


class _Keeper:
    """Keeps the state after each time step of the last try of a RetryingSimulator."""

    def __init__(self, player, configuration, T_base_object, read):
        self._player, self._design, self._read = player, configuration.design, read
        self._render = renderer_named(configuration.renderer, configuration.design)
        self._T_base_object, self._tries = T_base_object, {}
        self.truth = None
        """Tells the true label where the contact goes on; until then it is the label that the contact is brought to."""

    @property
    def rows(self):
        """Rows (list of dict) of the try that served, from its approach on."""
        return self._tries[self._player.last]

    def __call__(self, phase, label):
        player = self._player.last
        scene = player.scene
        skin = scene.vertices()[: scene.mesh.surface_count]
        tips, directions = player.reader.read(skin)
        image = tactile_image(self._render(tips, directions), self._design.image)
        force = scene.contact_force()
        T = self._T_base_object @ sensor_in_contact(label)
        self._tries.setdefault(player, []).append({
            "T_base_tcp": T,
            "T_told": T,
            "angles_rad": np.full(6, np.nan),
            "tips_m": tips,
            "directions": directions,
            "skin_m": skin,
            "force_n": force,
            "felt": self._felt(image),
            "true": self.truth.label(sensor_in_contact(label)) if self.truth else label,
            "touching": float(np.linalg.norm(force) > _LEAST_N),
            "penetration_m": scene.penetration(),
            "phase": phase,
            "part": 0,
            "sim_steps": 1,
            "seconds": np.zeros(4),
            "images": image,
        })  # fmt: skip

    def _felt(self, image):
        """The label (6,), m and rad, that is felt; not a number where nothing is."""
        told = self._read(image) if self._read else {}
        return from_mm_deg([told.get(component, np.nan if not told else 0.0) for component in COMPONENTS])
