"""Generation of data sets: contacts on worker processes, images, and files that survive a kill at any moment.

A contact and its samples are done once its record is in the set's `.partial` folder; its images are written before. Resuming
makes the contacts without a record, and the bytes are the same, because a contact depends only on the configuration and its
number. When all are done, the records become tables and, last, meta.json. A finished set grows
likewise: it becomes records again, and the missing ones are made.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactip_twin.sim.contact.curved_surface import (
    MAX_CURVATURE_PER_M,
    MAX_HOLLOW_PER_M,
)
from tactip_twin.sim.contact.fidelity import is_coarse
from tactip_twin.sim.contact.limits import check_ranges
from tactip_twin.sim.dataset.builder import DatasetBuilder
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import sample_motion
from tactip_twin.sim.dataset.format import MAX_PINS_BYTES, pins_bytes
from tactip_twin.sim.dataset.mesh_states import MAX_MESH_BYTES, mesh_states_bytes
from tactip_twin.sim.dataset.pressed_object import OBJECT
from tactip_twin.sim.dataset.sample_maker import SampleMaker
from tactip_twin.sim.dataset.sampling import generator
from tactip_twin.sim.dataset.shards import (
    MAX_SHARDS,
    ShardedDatasetBuilder,
    ShardFinalizer,
    open_builder,
    shard_count,
)
from tactip_twin.sim.dataset.sliding import MAX_SNAPSHOTS
from tactip_twin.sim.dataset.symmetry import ranges_are_symmetric
from tactip_twin.sim.parallel.ray_pool import RayPool, joined, ray_here
from tactip_twin.sim.parallel.worker_pool import WorkerPool
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.renderer import RENDERERS

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
    object: bytes | None = None
    """Content of object.npz, if the configuration names an object."""


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
    sample_motion(configuration, rng)
    _check_snapshots(configuration)
    _check_shards(configuration)
    _check_curvature(configuration)
    _check_mesh(configuration)
    _check_fast_tip(configuration)
    _check_object(configuration)
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
    require(bool(c.fast_tip) or not c.corrected, "corrected", c.corrected, "False without a learned tip")
    if not c.fast_tip:
        return
    if c.keep_mesh:
        raise TactipError("keep_mesh needs a simulated tip: the learned tip knows no mesh")
    if c.rough_fraction:
        raise TactipError("rough_fraction needs a simulated tip: the learned tip has met no surface that is bent so sharply")
    if not c.mechanics_randomization.is_identity and (c.corrected or c.needs_sliding_tip):
        what = "correction" if c.corrected else "learned tip that slides"
        raise TactipError(f"mechanics_randomization needs a simulated tip: the {what} knows the mechanics of one tip only")


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
    for name, chosen in {"curvature_per_m": any((low, high)), "rough_fraction": configuration.rough_fraction > 0}.items():
        if chosen and configuration.task != "surface":
            raise TactipError(f"{name} applies to the task 'surface' only, got the task {configuration.task!r}")
    for name in ("varying_curvature_fraction", "rough_fraction"):
        fraction = getattr(configuration, name)
        require(0 <= fraction <= 1, name, fraction, "between 0 and 1")
    if configuration.varying_curvature_fraction and not any((low, high)):
        raise TactipError("varying_curvature_fraction needs a range of curvature: give --curvature-per-m too")
    allowed = f"a low and a high between -{MAX_HOLLOW_PER_M:g} and {MAX_CURVATURE_PER_M:g} 1/m"
    require(-MAX_HOLLOW_PER_M <= low <= high <= MAX_CURVATURE_PER_M, "curvature_per_m", (low, high), allowed)


def _check_object(configuration: Configuration) -> None:
    """Raise TactipError where an object is combined with what is for the flat surface."""
    c = configuration
    if c.object is None:
        return
    if c.task != "surface":
        raise TactipError(f"an object needs the task 'surface', got {c.task!r}")
    unfit = {"curvature_per_m": any(c.curvature_per_m), "rough_fraction": c.rough_fraction > 0}
    unfit |= {"augment_symmetry": c.augment_symmetry, "keep_mesh": c.keep_mesh}
    for name, chosen in (unfit | {"a learned tip": bool(c.fast_tip)}).items():
        if chosen:
            raise TactipError(f"an object cannot be combined with {name}: its contacts are simulated, on its own surface")


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
        for job in jobs:
            if job.object is not None:
                write_file(job.folder / OBJECT, job.object)
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
        self._makers: dict[int, SampleMaker] = {}

    def __call__(self, task: _Task) -> None:
        """Make the samples of a contact, or finish a shard."""
        job, item = task
        if isinstance(item, ShardFinalizer):
            item(self._configurations[job], Path(self._folders[job]))
            return
        if job not in self._makers:
            folder = Path(self._folders[job])
            arguments = self._configurations[job], folder, self._makers.values(), self._fast_tips[job]
            self._makers[job] = SampleMaker(*arguments)
        self._makers[job].make(item)
