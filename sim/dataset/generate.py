"""Generation of data sets: contacts on worker processes, images, and files that survive a kill at any moment.

A contact and its samples are done once its record is in the set's `.partial` folder; its images are written before. Resuming
makes the contacts without a record, and the bytes are the same, because a contact depends only on the configuration and its
number. When all are done, the records become tables and, last, meta.json. A finished set grows
likewise: it becomes records again, and the missing ones are made.
"""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.contact.curved_surface import (
    MAX_CURVATURE_PER_M,
    MAX_HOLLOW_PER_M,
    curved_surface,
    sample_curved_surface,
)
from tactip_twin.sim.contact.fidelity import is_coarse
from tactip_twin.sim.contact.limits import MAX_TILT_RAD, check_ranges, exceeds_max_tilt
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import RetryingSimulator
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.dataset.builder import DatasetBuilder
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import MAX_PINS_BYTES, checksum, encode_image, image_name, pins_bytes, row_of
from tactip_twin.sim.dataset.mesh_states import MAX_MESH_BYTES, mesh_states_bytes
from tactip_twin.sim.dataset.partial_record import pack_record, record_path, sample_indices
from tactip_twin.sim.dataset.sampling import generator, seed_text
from tactip_twin.sim.dataset.shards import (
    MAX_SHARDS,
    ShardedDatasetBuilder,
    ShardFinalizer,
    open_builder,
    shard_count,
    shard_dir,
)
from tactip_twin.sim.dataset.sliding import MAX_SNAPSHOTS, SlidingPath
from tactip_twin.sim.dataset.symmetry import SymmetricReader, ranges_are_symmetric
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip
from tactip_twin.sim.parallel.ray_pool import RayPool, joined, ray_here
from tactip_twin.sim.parallel.worker_pool import WorkerPool
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.renderer import RENDERERS
from tactip_twin.tactip_model.tactile_image import tactile_image

_ROUNDING = 1e-9
"""Distance that a label may lie outside its range, because of rounding, mm or degrees."""

_MAX_SAMPLES = 10_000_000
"""Maximum number of samples of a set: some 40 GB of images, which one core simulates in three weeks."""

_Task = tuple[int, int | ShardFinalizer]
"""A worker task: the number of the job, and the number of a contact or the end of a shard."""


@dataclass(frozen=True)
class Job:
    """A set to make and where."""

    configuration: Configuration
    """Configuration of the set."""
    folder: Path
    """Folder of the set."""
    fast_tip: Path | None = None
    """File of the learned tip, if the configuration names one."""


def check(configuration: Configuration) -> None:
    """Raise TactipError where a configuration is invalid."""
    require(1 <= configuration.samples <= _MAX_SAMPLES, "samples", configuration.samples, f"from 1 to {_MAX_SAMPLES}")
    require(configuration.seed >= 0, "seed", configuration.seed, "non-negative")
    lookup("renderer", configuration.renderer, dict.fromkeys(RENDERERS))
    rng = generator(configuration.seed, configuration.task, configuration.split, 0)
    configuration.pose.check("pose")
    configuration.shear.check("shear")
    depth = configuration.pose.depth_mm
    require(depth[1] <= 0, "pose.depth_mm", depth, "at most 0 (depth is negative into the object)")
    check_ranges(configuration.pose, configuration.shear)
    _sample_motion(configuration, rng)
    _check_snapshots(configuration)
    _check_shards(configuration)
    _check_curvature(configuration)
    _check_mesh(configuration)
    _check_fast_tip(configuration)
    for name in ("pose", "shear"):
        if not ranges_are_symmetric(configuration.symmetries, getattr(configuration, name)):
            raise TactipError(
                f"the {name} ranges are not symmetric, so samples made by symmetry would lie outside them: make the ranges "
                "symmetric, or leave --augment-symmetry out"
            )


def _check_shards(configuration: Configuration) -> None:
    """Raise TactipError where the set would have more or larger shards than are read back."""
    c = configuration
    most = MAX_PINS_BYTES // pins_bytes(c.design)
    require(min(c.samples, c.shard_samples) <= most, "shard_samples", c.shard_samples, f"at most {most} for these pins")
    allowed = f"at least {-(-c.samples // MAX_SHARDS) + c.samples_per_contact - 1} for {c.samples} samples"
    require(shard_count(c) <= MAX_SHARDS, "shard_samples", c.shard_samples, allowed)


def _check_snapshots(configuration: Configuration) -> None:
    c = configuration
    require(
        1 <= c.snapshots_per_contact <= MAX_SNAPSHOTS,
        "snapshots_per_contact",
        c.snapshots_per_contact,
        f"between 1 and {MAX_SNAPSHOTS}",
    )
    allowed = f"at least {c.samples_per_contact}, the number of samples of one contact"
    require(c.shard_samples >= c.samples_per_contact, "shard_samples", c.shard_samples, allowed)
    names = ("x_mm", "y_mm", "yaw_deg") if c.task == "surface" else ("y_mm",)
    for name in names if c.snapshots_per_contact > 1 else ():
        low, high = getattr(c.pose, name)
        allowed = "a range that includes 0 if snapshots_per_contact is above 1, because sliding paths start at 0"
        require(low <= 0 <= high, f"pose.{name}", (low, high), allowed)


def _check_fast_tip(configuration: Configuration) -> None:
    """Raise TactipError where a learned tip would have to predict what it has not learned."""
    c = configuration
    if not c.fast_tip:
        return
    unlearned = {
        "snapshots_per_contact": c.snapshots_per_contact > 1,
        "curvature_per_m": c.is_curved,
        "keep_mesh": c.keep_mesh,
        "mechanics_randomization": not c.mechanics_randomization.is_identity,
    }
    for name, chosen in unlearned.items():
        if chosen:
            raise TactipError(f"{name} needs a simulated tip: the learned tip knows single contacts of one tip only")


def _check_mesh(configuration: Configuration) -> None:
    """Raise TactipError where a set that keeps its meshes would have meshes of two kinds, or too many to be read back."""
    c = configuration
    if not c.keep_mesh:
        return
    allowed = f"no {c.fidelity.name!r}, because its contacts may be repeated on a finer mesh"
    require(not (c.task == "edge" and is_coarse(c.fidelity)), "fidelity", c.fidelity.name, f"{allowed}, if keep_mesh is set")
    per_shard = -(-min(c.samples, c.shard_samples) // c.samples_per_contact) * mesh_states_bytes(c)
    require(
        per_shard <= MAX_MESH_BYTES, "shard_samples", c.shard_samples, "smaller, because mesh.npz could not be read again"
    )


def _check_curvature(configuration: Configuration) -> None:
    low, high = configuration.curvature_per_m
    if configuration.is_curved and configuration.task != "surface":
        raise TactipError(f"curvature_per_m applies to the task 'surface' only, got the task {configuration.task!r}")
    require(
        0 <= configuration.varying_curvature_fraction <= 1,
        "varying_curvature_fraction",
        configuration.varying_curvature_fraction,
        "between 0 and 1",
    )
    if configuration.varying_curvature_fraction and not configuration.is_curved:
        raise TactipError("varying_curvature_fraction needs a range of curvature: give --curvature-per-m too")
    allowed = f"a low and a high between -{MAX_HOLLOW_PER_M:g} and {MAX_CURVATURE_PER_M:g} 1/m"
    require(-MAX_HOLLOW_PER_M <= low <= high <= MAX_CURVATURE_PER_M, "curvature_per_m", (low, high), allowed)


def make(jobs: list[Job], workers: int, log: Callable[[str], None] = print, cluster: str = "") -> list[dict[str, Any]]:
    """Make sets, or finish them where they were interrupted.

    What is done is kept whatever is raised.

    Args:
        jobs: Sets to make.
        workers: Number of workers; 0 for as many as there is room for.
        log: Function that takes messages for the user.
        cluster: Address of a Ray cluster (sim/parallel/ray_pool.py) whose workers make the sets, in folders that all of its
            machines see; empty for none.

    Returns:
        A result per job, with the samples asked, kept, failed and made by this command, and the seconds this took.

    Raises:
        TactipError: A wrong configuration, an unwritable folder, a set of another configuration in the folder, no OpenGL, or
            no cluster.
        Interrupted: Ctrl-C.
    """
    if cluster:
        ray_here()
    for job in jobs:
        check(job.configuration)
    with contextlib.ExitStack() as stack:
        builders = [stack.enter_context(open_builder(job.configuration, job.folder)) for job in jobs]
        plans = [builder.plan() for builder in builders]
        count, missing = (sum(numbers) for numbers in zip(*plans, strict=True))
        # One by one, because a large set has millions: nothing here may grow with their number.
        todo = _tasks(builders)
        total = sum(job.configuration.samples for job in jobs)
        if count and missing < total:
            log(f"{total - missing} of {total} samples already exist")
        start = time.perf_counter()

        def done(task: _Task, seconds: float, peak_mib: float) -> list[_Task]:
            job, item = task
            if isinstance(item, ShardFinalizer):
                builders[job].mark_shard_finished(item.shard)
                return []
            finalizers = builders[job].done(item, (seconds, peak_mib), workers, time.perf_counter() - start)
            return [(job, finalizer) for finalizer in finalizers]

        unit = "contact" if any(job.configuration.samples_per_contact > 1 for job in jobs) else "sample"

        def name_of(task: _Task) -> str:
            job, item = task
            name = item if isinstance(item, ShardFinalizer) else f"{unit} {item}"
            return f"{name} of {jobs[job].folder}"

        if count:
            arguments = (
                [job.configuration for job in jobs],
                [str(job.folder.resolve()) for job in jobs],
                [str(job.fast_tip.resolve()) if job.fast_tip else "" for job in jobs],
            )
            settings = _SampleMakers, arguments, todo, unit, log, name_of, count
            pool = RayPool(stack.enter_context(joined(cluster)), *settings) if cluster else WorkerPool(*settings)
            workers = min(workers or pool.places(), count)
            pool.work(workers, done)
        return [builder.finish(workers, time.perf_counter() - start) for builder in builders]


def _tasks(builders: Sequence[DatasetBuilder | ShardedDatasetBuilder]) -> Iterator[_Task]:
    """Yield the contacts that are still to be made."""
    for k, builder in enumerate(builders):
        for number in builder.missing():
            yield k, number


class _SampleMakers:
    """The sample makers of a worker, created when they are needed."""

    def __init__(self, configurations: list[Configuration], folders: list[str], fast_tips: list[str]) -> None:
        """Take the configurations of the jobs, their folders, and the files of their learned tips."""
        self._configurations, self._folders, self._fast_tips = configurations, folders, fast_tips
        self._makers: dict[int, _SampleMaker] = {}

    def __call__(self, task: _Task) -> None:
        """Make the samples of a contact, or finish a shard."""
        job, item = task
        if isinstance(item, ShardFinalizer):
            item(self._configurations[job], Path(self._folders[job]))
            return
        if job not in self._makers:
            folder = Path(self._folders[job])
            arguments = self._configurations[job], folder, self._makers.values(), self._fast_tips[job]
            self._makers[job] = _SampleMaker(*arguments)
        self._makers[job].make(item)


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


class _SampleMaker:
    """Maker of the samples of one set, in a worker."""

    def __init__(self, configuration: Configuration, folder: Path, others: "Iterable[_SampleMaker]", fast_tip: str) -> None:
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
        self._fast = _fast_contacts(c, fast_tip) if c.fast_tip else None
        """Predictor of the contacts, if the set has one."""
        self._shared = same[0] if same else None
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
        sample = sample_contact(c, number)
        made = _MadeContact(sample_indices(c, number), shard_dir(c, self._folder, number), seed_text(*_seed(c, number)))
        predicted = self._fast.trusted(sample.pose, sample.shear, c.symmetries) if self._fast else None
        if predicted is None:
            self._simulate(sample, made)
        else:
            self._write_images(predicted, made.indices, 0, made)
        write_file(record_path(made.folder, number), made.packed(), sync=False)

    def _simulate(self, sample: "ContactSample", made: "_MadeContact") -> None:
        """Simulate a contact, and write the images of its samples."""
        c = self._configuration
        simulator, readers = self._simulator, self._readers
        if not c.mechanics_randomization.is_identity:
            simulator, readers = simulator_for(c, sample.design), {}
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
            contacts = [state]
            if c.augment_symmetry:
                skin, mesh = simulator.skin()  # of another mesh where the first one was too coarse for this contact
                if mesh.surface_count not in readers:
                    readers[mesh.surface_count] = SymmetricReader(sample.design, mesh, c.symmetries)
                contacts = readers[mesh.surface_count].read(state, skin)
            self._write_images(contacts, own, tries, made)
        if c.keep_mesh:
            made.states = states

    def _write_images(self, contacts: list[Contact], indices: range, tries: int, made: "_MadeContact") -> None:
        """Write the images of contacts, and note the contacts. The last contact of a set may have fewer indices."""
        for index, contact in zip(indices, contacts, strict=False):
            made.add(contact, index, tries)
            grey = self._render(contact.pin_tips, contact.directions)
            data = encode_image(tactile_image(grey, self._configuration.design.image))
            write_file(made.folder / "images" / image_name(index), data, sync=False)
            made.images[image_name(index)] = checksum(data)

    def _snapshots(
        self, simulator: RetryingSimulator, contact: Contact, sample: "ContactSample"
    ) -> Iterator[tuple[Contact, list[str]]]:
        """Yield the state at each image and its violations of the limits: `contact`, then states on a sliding path."""
        c = self._configuration
        yield contact, []
        if c.snapshots_per_contact == 1:
            return
        path = SlidingPath(c.task, sample.solid, c.pose, sample.pose, sample.rng)
        low, high = c.pose.bounds().T
        for _ in range(c.snapshots_per_contact - 1):
            contact = simulator.slide(path.stride(), path.label())
            label, violations = to_mm_deg(contact.pose), contact.violations(c.bounds.while_sliding())
            if not ((label > low - _ROUNDING) & (label < high + _ROUNDING)).all():
                violations = [*violations, "its label on the curved surface is outside the ranges"]
            yield contact, violations


def _physics(configuration: Configuration) -> tuple[object, ...]:
    """Return what decides a simulator, besides the design."""
    c = configuration
    return c.task, c.is_curved, c.fidelity, c.bounds, c.fast_tip


def _fast_contacts(configuration: Configuration, path: str) -> FastContacts:
    """Return the predictor of a set's contacts. Raises TactipError if the file holds another tip than the set's."""
    tip = read_fast_tip(path)
    if tip.digest != configuration.fast_tip or tip.task != configuration.task:
        raise TactipError(
            f"{path} is not the learned tip of this set: its checksum is {tip.digest}, not {configuration.fast_tip}"
        )
    return FastContacts(tip, configuration.design)


@dataclass(frozen=True)
class ContactSample:
    """A contact sampled from the ranges of a set."""

    pose: np.ndarray
    """(6,) m and rad."""
    shear: np.ndarray
    """(6,) m and rad."""
    solid: SignedDistanceMesh | None
    """Curved surface of this contact; None where the set's surface or edge is straight."""
    design: Design
    """Tip with the mechanics of this contact."""
    rng: np.random.Generator
    """Generator of the rest of the contact."""


_MAX_MOTIONS = 1000
"""Number of motions sampled before ranges are rejected: at the corners of ±25 degrees every other one is too steep."""


def _sample_motion(configuration: Configuration, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose and a shear (6,), m and rad: the first sample that is not too steep to simulate.

    Raises TactipError where there is none among _MAX_MOTIONS.
    """
    for _ in range(_MAX_MOTIONS):
        pose, shear = configuration.pose.sample(rng), configuration.shear.sample(rng)
        if not exceeds_max_tilt(pose, shear):
            return pose, shear
    raise TactipError(
        f"all of {_MAX_MOTIONS} poses and shears sampled from the ranges tilt by more than {np.degrees(MAX_TILT_RAD):g} "
        "degrees: narrow the ranges of roll and pitch"
    )


def sample_contact(configuration: Configuration, number: int) -> ContactSample:
    """Return the sample of contact `number`. Poses and shears do not depend on what else varies."""
    c = configuration
    rng = generator(c.seed, c.task, c.split, number)
    pose, shear = _sample_motion(c, rng)
    solid = sample_curved_surface(rng, *c.curvature_per_m, c.varying_curvature_fraction) if c.is_curved else None
    design = c.design if c.mechanics_randomization.is_identity else c.mechanics_randomization.sample(c.design, rng)
    return ContactSample(pose, shear, solid, design, rng)


def simulator_for(configuration: Configuration, design: Design) -> RetryingSimulator:
    """Return a simulator of the contacts of a set.

    Args:
        configuration: Configuration of the set. If its surface is curved, the solid of each contact must be assigned to the
            simulator's stimulus.
        design: The set's design, or one with other mechanics.
    """
    c = configuration
    curved = SolidStimulus(curved_surface(0.0, 0.0, 0.0), min_radius_m=1 / MAX_CURVATURE_PER_M) if c.is_curved else None
    return RetryingSimulator(design, curved or c.task, c.fidelity, c.bounds)
