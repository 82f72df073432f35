"""Making of the samples of a contact in a worker: simulate or predict it, and write its images and its record."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import ContactSample, curved_stimulus, sample_contact, simulator_for
from tactip_twin.sim.dataset.format import checksum, encode_image, image_name, read_unaltered, row_of
from tactip_twin.sim.dataset.partial_record import pack_record, record_path, sample_indices
from tactip_twin.sim.dataset.pressed_object import OBJECT, PressPlaces, places_on
from tactip_twin.sim.dataset.sampling import seed_text
from tactip_twin.sim.dataset.shards import shard_dir
from tactip_twin.sim.dataset.sliding import SlidingPath, ground_truth_on
from tactip_twin.sim.dataset.symmetry import SymmetricReader
from tactip_twin.sim.fast_tip.corrected_contacts import CorrectedContacts
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip
from tactip_twin.sim.fast_tip.randomized_contacts import RandomizedContacts
from tactip_twin.sim.fast_tip.sliding_contact import SlidingContact, TouchedObject
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip
from tactip_twin.sim.pose import before_shear, sensor_in_contact
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.mesh import Mesh
from tactip_twin.tactip_model.renderer import RENDERERS
from tactip_twin.tactip_model.tactile_image import tactile_image


class _MeshAfterApproach:
    """Observer of a simulator's steps that keeps the mesh at the end of the approach of its last try."""

    def __init__(self, simulator: RetryingSimulator, states: list[np.ndarray]) -> None:
        """Take the simulator, and the list whose first item the mesh (n, 3), m, replaces."""
        self._simulator, self._states = simulator, states

    def __call__(self, phase: str, label: np.ndarray) -> None:
        """Look at a step."""
        if phase == "approach":
            self._states[0] = self._simulator.last.scene.vertices()


class _MadeContact:
    """What is known of a contact and its samples."""

    def __init__(self, indices: range, folder: Path, seed: str) -> None:
        """Begin with nothing.

        Args:
            indices: Indices of its samples.
            folder: Folder of its set or shard.
            seed: Its seed.
        """
        self.indices, self.folder, self.seed = indices, folder, seed
        self.images: dict[str, str] = {}
        """Checksums of the images, by name."""
        self.violations: list[list[str]] = []
        """Failed checks of each try that failed."""
        self.failed = False
        """Whether the contact has no samples."""
        self.missed: list[dict[str, Any]] = []
        """Failures (index, seed, tries) of single samples."""
        self.states: list[np.ndarray] | None = None
        """Meshes (n, 3), m, if the set keeps them."""
        self._rows: list[dict[str, Any]] = []
        self._contacts: list[Contact] = []

    def add(self, contact: Contact, index: int, tries: int) -> None:
        """Add the contact of a sample."""
        self._contacts.append(contact)
        self._rows.append(row_of(contact, index, tries, self.seed))

    def packed(self) -> bytes:
        """Return the record."""
        names = ("violations", "failed", "images", "missed")
        record = {"rows": self._rows, **{name: getattr(self, name) for name in names}}
        pin_tips, directions = ([getattr(one, name) for one in self._contacts] for name in ("pin_tips", "directions"))
        return pack_record(record, pin_tips, directions, self.states)


def _seed(configuration: Configuration, number: int) -> tuple[int, str, str, int]:
    """Return what the seed of contact `number` is made of."""
    return configuration.seed, configuration.task, configuration.split, number


class SampleMaker:
    """Maker of the samples of one set, in a worker."""

    def __init__(self, configuration: Configuration, folder: Path, others: "Iterable[SampleMaker]", fast_tip: str) -> None:
        """Prepare a renderer and a simulator.

        Args:
            configuration: Configuration of the set.
            folder: Folder of the set.
            others: Makers of this process, whose renderer and simulator are shared where theirs are the same.
            fast_tip: File of the learned tip; empty for none.

        Raises:
            TactipError: The file holds another tip than the configuration names.
        """
        self._configuration, self._folder = configuration, folder
        c = configuration
        alike = [m for m in others if m._configuration.design == c.design and m._configuration.renderer == c.renderer]
        self._render = alike[0]._render if alike else lookup("renderer", c.renderer, RENDERERS)(c.design)
        same = [m for m in alike if _physics(m._configuration) == _physics(c)]
        self._fast = _fast_contacts(c, fast_tip) if c.fast_tip and not c.needs_sliding_tip else None
        """Predictor of the contacts, if the set has one."""
        self._sliding = _sliding_contact(c, fast_tip) if c.fast_tip and c.needs_sliding_tip else None
        """Predictor of contacts that slide, if the set has one."""
        self._shared = same[0] if same else None
        self._places = object_places(c, folder)
        self._own_simulator: RetryingSimulator | None = None
        self._readers: dict[int, SymmetricReader] = {}
        """Readers of the design's pins, by the number of vertices of their meshes' skins."""

    @property
    def _simulator(self) -> RetryingSimulator:
        """Simulator of the contacts, built when it is first needed."""
        if self._shared:
            return self._shared._simulator
        if self._own_simulator is None:
            self._own_simulator = simulator_for(self._configuration, self._configuration.design)
        return self._own_simulator

    def make(self, number: int) -> None:
        """Write the images and the record of contact `number`. Raises OSError.

        They are not synced one by one, which would cost milliseconds each: a resumed command checks them, and a set is
        synced as a whole before it counts as finished.
        """
        c = self._configuration
        sample = sample_contact(c, number, self._places)
        made = _MadeContact(sample_indices(c, number), shard_dir(c, self._folder, number), seed_text(*_seed(c, number)))
        predictor = self._fast.of(sample.design) if isinstance(self._fast, RandomizedContacts) else self._fast
        predicted = predictor.trusted(sample.pose, sample.shear, c.symmetries) if predictor else None
        if self._sliding:
            self._slide(self._sliding, sample, made)
        elif predicted is None:
            self._simulate(sample, made)
        else:
            self._write_images(predicted, made.indices, int(c.corrected), made)
        write_file(record_path(made.folder, number), made.packed(), sync=False)

    def _simulate(self, sample: ContactSample, made: _MadeContact) -> None:
        """Simulate a contact, and write the images of its samples."""
        c = self._configuration
        simulator = self._simulator
        if not c.mechanics_randomization.is_identity:
            # Another tip has other pins on the same mesh.
            simulator = simulator_for(c, sample.design)
            self._readers.clear()
        if sample.solid is not None:
            simulator.replace_solid(sample.solid)
        states = [simulator.last.scene.mesh.vertices]
        simulator.watch = _MeshAfterApproach(simulator, states) if c.keep_mesh else None
        contact, made.violations = simulator.simulate(sample.pose, sample.shear)
        tries, made.failed = len(made.violations) + 1, len(made.violations) == simulator.tries
        if made.failed:
            made.add(contact, made.indices[0], tries)
            return
        each = len(c.symmetries)
        for k, (state, violations) in enumerate(self._snapshots(simulator, contact, sample)):
            own = made.indices[k * each : (k + 1) * each]
            states.append(simulator.last.scene.vertices())
            if violations:
                made.missed += [{"index": index, "seed": made.seed, "tries": [violations]} for index in own]
                continue
            # The mesh is another one where the first was too coarse for this contact.
            contacts = self._copies(sample.design, state, *simulator.skin())
            self._write_images(contacts, own, tries, made)
        if c.keep_mesh:
            made.states = states

    def _slide(self, sliding: SlidingContact, sample: ContactSample, made: _MadeContact) -> None:
        """Predict a contact and its sliding path, and write the images of its samples.

        A first contact that cannot be trusted is simulated with all checks and tries, later motions as they are.
        """
        c, solid = self._configuration, sample.solid
        path = SlidingPath(c.task, solid, c.pose, sample.pose, sample.rng)
        stimulus = sliding.touched.stimulus
        if isinstance(stimulus, SolidStimulus) and solid is not None:
            stimulus.solid = solid
        sliding.touched = TouchedObject(stimulus, path.truth, stimulus.distance)
        before, there = (sensor_in_contact(label) for label in (before_shear(sample.pose, sample.shear), sample.pose))
        contact = sliding.touch_down(before, there)
        if contact is None:
            if solid is not None:
                self._simulator.replace_solid(solid)
            contact, made.violations = self._simulator.simulate(sample.pose, sample.shear)
            if len(made.violations) == self._simulator.tries:
                made.failed = True
                made.add(contact, made.indices[0], len(made.violations) + 1)
                return
            skin, mesh = self._simulator.skin()
            if mesh is not sliding.mesh:
                raise TactipError("the learned tip must have the mesh of the simulation that its contacts fall back to")
            sliding.take_over(contact, skin)
        # The label of a set is the pose that was drawn, also where the surface is not quite level.
        contact = replace(contact, pose=sample.pose, shear=sample.shear)
        each = len(c.symmetries)
        for k in range(c.snapshots_per_contact):
            own = made.indices[k * each : (k + 1) * each]
            simulated = k > 0 and np.isfinite(contact.penetration_m)
            violations = contact.violations(c.bounds.while_sliding()) if simulated else []
            if not c.pose.contain(contact.pose):
                violations = [*violations, "its label on the curved surface is outside the ranges"]
            if violations:
                made.missed += [{"index": index, "seed": made.seed, "tries": [violations]} for index in own]
            else:
                contacts = self._copies(sample.design, contact, sliding.skin(), sliding.mesh)
                self._write_images(contacts, own, len(made.violations) + (contact.steps > 0), made)
            if k + 1 < c.snapshots_per_contact:
                contact = sliding.move(sensor_in_contact(path.stride()))

    def _copies(self, design: Design, contact: Contact, skin: np.ndarray, mesh: Mesh) -> list[Contact]:
        """Return a contact under each symmetry of the set, with skin vertices (s, 3), m, of a mesh."""
        if not self._configuration.augment_symmetry:
            return [contact]
        if mesh.surface_count not in self._readers:
            self._readers[mesh.surface_count] = SymmetricReader(design, mesh, self._configuration.symmetries)
        return self._readers[mesh.surface_count].read(contact, skin)

    def _write_images(self, contacts: list[Contact], indices: range, tries: int, made: _MadeContact) -> None:
        """Write the images of contacts, and note the contacts. The last contact of a set may have fewer indices."""
        contacts = contacts[: len(indices)]
        if not contacts:
            return
        pins = (np.stack([getattr(contact, name) for contact in contacts]) for name in ("pin_tips", "directions"))
        for index, contact, grey in zip(indices, contacts, self._render(*pins), strict=True):
            made.add(contact, index, tries)
            data = encode_image(tactile_image(grey, self._configuration.design.image))
            write_file(made.folder / "images" / image_name(index), data, sync=False)
            made.images[image_name(index)] = checksum(data)

    def _snapshots(
        self, simulator: RetryingSimulator, contact: Contact, sample: ContactSample
    ) -> Iterator[tuple[Contact, list[str]]]:
        """Yield the state at each image and its violations of the limits: `contact`, then states on a sliding path."""
        c = self._configuration
        yield contact, []
        if c.snapshots_per_contact == 1:
            return
        path = SlidingPath(c.task, sample.solid, c.pose, sample.pose, sample.rng)
        for _ in range(c.snapshots_per_contact - 1):
            contact = simulator.slide(path.stride(), path.label())
            violations = contact.violations(c.bounds.while_sliding())
            if not c.pose.contain(contact.pose):
                violations = [*violations, "its label on the curved surface is outside the ranges"]
            yield contact, violations


def object_places(configuration: Configuration, folder: Path) -> PressPlaces | None:
    """Return the places on the object of a set; None without one. Raises TactipError if its file is missing or altered."""
    chosen = configuration.object
    if chosen is None:
        return None
    return places_on(read_unaltered(folder / OBJECT, chosen.sha256), chosen, str(folder / OBJECT))


def _physics(configuration: Configuration) -> tuple[object, ...]:
    """Return what decides a simulator, besides the design."""
    c = configuration
    return c.task, c.is_curved, c.rough_fraction > 0, c.object is None, c.fidelity, c.bounds


def _fast_contacts(configuration: Configuration, path: str) -> FastContacts | CorrectedContacts | RandomizedContacts:
    """Return the predictor of a set's contacts. Raises TactipError if the file holds another tip than the set's."""
    c, tip = configuration, read_fast_tip(path)
    if tip.digest != c.fast_tip or tip.task != c.task:
        raise TactipError(f"{path} is not the learned tip of this set: its checksum is {tip.digest}, not {c.fast_tip}")
    if not c.mechanics_randomization.is_identity:
        return RandomizedContacts(tip, c.design)
    return CorrectedContacts(tip, c.design, c.fidelity, c.bounds) if c.corrected else FastContacts(tip, c.design)


def _sliding_contact(configuration: Configuration, path: str) -> SlidingContact:
    """Return the predictor of a set's contacts that slide. Raises TactipError if the file holds another tip."""
    c, tip = configuration, read_sliding_tip(path)
    if tip.digest != c.fast_tip or tip.task != c.task:
        raise TactipError(f"{path} is not the learned tip of this set: its checksum is {tip.digest}, not {c.fast_tip}")
    stimulus = curved_stimulus() if c.is_curved else stimulus_named(c.task)
    touched = TouchedObject(stimulus, ground_truth_on(c.task), stimulus.distance)
    return SlidingContact(tip, c.design, touched, c.fidelity, c.corrected)
