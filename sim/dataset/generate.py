"""Makes data sets: contacts on worker processes, images, and files that survive a kill at any moment.

A contact, with the sample or the samples that it makes, is done when its record is in the set's `.partial` folder, after its
images. Resuming makes what has no record; the same bytes come out, because a contact depends on nothing but the
configuration and its number. When all are done the records become targets.csv, pins.npz and, last, meta.json. A finished
set grows in the same way: it becomes records again, and those that it lacks are made.
"""

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactip_twin.sim.contact.curved_surface import (
    MAX_CURVATURE_PER_M,
    MAX_HOLLOW_PER_M,
    curved_surface,
    sample_curved_surface,
)
from tactip_twin.sim.contact.limits import MAX_TILT_RAD, check_ranges, exceeds_max_tilt
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import RetryingSimulator
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.dataset.format import Configuration, checksum, encode_image, image_name, row_of
from tactip_twin.sim.dataset.partial_record import pack_record, record_path, samples_of
from tactip_twin.sim.dataset.sampling import generator, seed_text
from tactip_twin.sim.dataset.shards import ShardFinalizer, open_builder, shard_dir
from tactip_twin.sim.dataset.sliding import MOST_LOOKS, SlidingPath
from tactip_twin.sim.dataset.symmetry import SymmetricReader, ranges_are_symmetric
from tactip_twin.sim.parallel.ray_pool import RayPool, joined, ray_here
from tactip_twin.sim.parallel.worker_pool import WorkerPool
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.renderer import RENDERERS, renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image

_ROUND = 1e-9
"""A label may lie this far outside of its range, mm or degrees: rounding."""


@dataclass(frozen=True)
class Job:
    """A set to make and where."""

    configuration: Configuration
    """What it is to hold."""
    folder: Path
    """Where it is written."""


def check(configuration):
    """Raise TactipError where a configuration (Configuration) cannot be made."""
    if configuration.samples < 1:
        raise TactipError(f"a set of {configuration.samples} samples cannot be made: ask for at least 1")
    if configuration.seed < 0:
        raise TactipError(f"the seed {configuration.seed} does not do: it must be 0 or more")
    lookup("renderer", configuration.renderer, dict.fromkeys(RENDERERS))
    first = generator(configuration.seed, configuration.task, configuration.split, 0)
    configuration.pose.check("pose")
    configuration.shear.check("shear")
    deep = configuration.pose.depth_mm
    if deep[1] > 0:
        raise TactipError(f"the range pose.depth_mm is {deep}: depth is negative into the object, and it must be at most 0")
    check_ranges(configuration.pose, configuration.shear)
    _motion(configuration, first)
    _check_looks(configuration)
    _check_curvature(configuration)
    for name in ("pose", "shear"):
        if not ranges_are_symmetric(configuration.symmetries, getattr(configuration, name)):
            raise TactipError(
                f"the ranges of the {name} are not as wide to one side as to the other, and samples by symmetry would leave "
                "them: leave --symmetric out, or make the ranges even"
            )


def _check_looks(configuration):
    c = configuration
    if not 1 <= c.looks <= MOST_LOOKS:
        raise TactipError(f"{c.looks} looks at a contact cannot be had: it must be 1 to {MOST_LOOKS}")
    if c.shard_samples < c.each:
        raise TactipError(f"shards of {c.shard_samples} samples cannot be made: it must be {c.each}, of a contact, or more")
    names = ("x_mm", "y_mm", "yaw_deg") if c.task == "surface" else ("y_mm",)
    for name in names if c.looks > 1 else ():
        low, high = getattr(c.pose, name)
        if not low <= 0 <= high:
            raise TactipError(
                f"the range pose.{name} is ({low}, {high}): with more than one look at a contact 0 must be in it, as it is "
                "after a walk"
            )


def _check_curvature(configuration):
    low, high = configuration.curvature_per_m
    if configuration.bent and configuration.task != "surface":
        raise TactipError(f"a curvature is asked for with the task {configuration.task!r}: only a surface can be bent")
    if not 0 <= configuration.uneven <= 1:
        raise TactipError(f"the share of uneven surfaces is {configuration.uneven}: it must be from 0 to 1")
    if configuration.uneven and not configuration.bent:
        raise TactipError("an unevenly bent surface is asked for without a range of curvature: give --curvature-per-m, too")
    if not -MAX_HOLLOW_PER_M <= low <= high <= MAX_CURVATURE_PER_M:
        raise TactipError(
            f"the range of curvature is ({low}, {high}) 1/m: it must be rising, and from -{MAX_HOLLOW_PER_M:g} "
            f"to {MAX_CURVATURE_PER_M:g}"
        )


def make(jobs, workers, say=print, cluster=""):
    """Make the sets of `jobs` (list of Job), or finish them where they were left.

    workers: int; 0 for as many as there is room for. say: called with each line for the user. cluster: str, address of a Ray
    cluster (sim/parallel/ray_pool.py) whose workers make them, in folders that all of its machines see; none if empty.
    Returns a list
    of dict, one a job: samples kept, failed, made now, and the seconds this took. Raises TactipError (wrong configuration,
    unwritable folder, no OpenGL, no cluster, a set of another configuration in the folder) and Interrupted (Ctrl-C). Nothing
    that was done is lost by either.
    """
    if cluster:
        ray_here()
    for job in jobs:
        check(job.configuration)
    with contextlib.ExitStack() as stack:
        folders = [stack.enter_context(open_builder(job.configuration, job.folder)) for job in jobs]
        todo = [(k, number) for k, folder in enumerate(folders) for number in folder.missing()]
        total = sum(job.configuration.samples for job in jobs)
        left = sum(len(samples_of(jobs[k].configuration, number)) for k, number in todo)
        if todo and left < total:
            say(f"{total - left} of {total} samples are there already")
        start = time.perf_counter()

        def done(task, *cost):
            job, what = task
            if isinstance(what, ShardFinalizer):
                folders[job].closed(what.name)
                return None
            return [(job, closing) for closing in folders[job].done(what, cost, workers, time.perf_counter() - start)]

        unit = "contact" if any(job.configuration.each > 1 for job in jobs) else "sample"

        def named(task):
            job, what = task
            own = what if isinstance(what, ShardFinalizer) else f"{unit} {what}"
            return f"{own} of {jobs[job].folder}"

        if todo:
            arguments = [job.configuration for job in jobs], [str(job.folder.resolve()) for job in jobs]
            given = _Makers, arguments, todo, unit, say, named
            crew = RayPool(stack.enter_context(joined(cluster)), *given) if cluster else WorkerPool(*given)
            workers = min(workers or crew.places(), len(todo))
            crew.work(workers, done)
        return [folder.finish(workers, time.perf_counter() - start) for folder in folders]


class _Makers:
    """The sample makers of a worker, made as they are needed."""

    def __init__(self, configurations, folders):
        """configurations: list of Configuration. folders: list of str, theirs."""
        self._configurations, self._folders, self._makers = configurations, folders, {}

    def __call__(self, task):
        """Make the samples of a `task` (job number, contact number), or close a shard (job number, ShardFinalizer)."""
        job, number = task
        if isinstance(number, ShardFinalizer):
            number(self._configurations[job], Path(self._folders[job]))
            return
        if job not in self._makers:
            folder = Path(self._folders[job])
            self._makers[job] = _SampleMaker(self._configurations[job], folder, self._makers.values())
        self._makers[job].make(number)


class _SampleMaker:
    """Makes the samples of one set, in a worker."""

    def __init__(self, configuration, folder, others):
        """others: makers of this process whose scene and renderer can be shared, where theirs are the same."""
        self._configuration, self._folder = configuration, folder
        c = configuration
        alike = [m for m in others if m._configuration.design == c.design and m._configuration.renderer == c.renderer]
        self._render = alike[0]._render if alike else renderer_named(c.renderer, c.design)
        played = [m for m in alike if _physics(m._configuration) == _physics(c)]
        self._player = played[0]._player if played else simulator_for(c, c.design)
        self._reader = SymmetricReader(c.design, self._player.skin()[1], c.symmetries) if c.symmetric else None

    def make(self, number):
        """Write the images and the record of contact `number`. Raises OSError."""
        c = self._configuration
        given = sample_contact(c, number)
        player, reader = self._player, self._reader
        if not c.mechanics.still:
            player = simulator_for(c, given.design)
            reader = SymmetricReader(given.design, player.skin()[1], c.symmetries) if c.symmetric else None
        if given.solid is not None:
            player.stimulus.solid = given.solid
        indices, folder = samples_of(c, number), shard_dir(c, self._folder, number)
        seed = seed_text(c.seed, c.task, c.split, number)
        contact, faults = player.play(given.pose, given.shear)
        tries, failed = len(faults) + 1, len(faults) == player.tries
        kept, rows, images, missed = [], [], {}, []
        if failed:
            kept, rows = [contact], [row_of(contact, indices[0], tries, seed)]
        each = len(c.symmetries)
        for look, (seen, wrong) in enumerate([] if failed else self._looks(player, contact, given)):
            mine = indices[look * each : (look + 1) * each]
            if wrong:
                missed += [{"index": index, "seed": seed, "tries": [wrong]} for index in mine]
                continue
            contacts = reader.read(seen, player.skin()[0]) if reader else [seen]
            for index, one in zip(mine, contacts, strict=False):
                kept.append(one)
                rows.append(row_of(one, index, tries, seed))
                data = encode_image(tactile_image(self._render(one.tips, one.directions), c.design.image))
                write_file(folder / "images" / image_name(index), data)
                images[image_name(index)] = checksum(data)
        record = {"rows": rows, "faults": faults, "failed": failed, "images": images, "missed": missed}
        pins = ([getattr(one, k) for one in kept] for k in ("tips", "directions"))
        write_file(record_path(folder, number), pack_record(record, *pins))

    def _looks(self, player, contact, given):
        """The Contact of each look, and what is wrong with it (list of str): of `contact`, and of the walk from there."""
        c = self._configuration
        yield contact, []
        if c.looks == 1:
            return
        walk = SlidingPath(c.task, given.solid, c.pose, given.pose, given.draw)
        low, high = c.pose.bounds().T
        for _ in range(c.looks - 1):
            contact = player.slide(walk.stride(), walk.label())
            label, wrong = to_mm_deg(contact.pose), contact.faults(c.bounds.while_sliding())
            if not ((label > low - _ROUND) & (label < high + _ROUND)).all():
                wrong = [*wrong, "on the bent surface, its label is out of the ranges"]
            yield contact, wrong


def _physics(configuration):
    return configuration.task, configuration.bent, configuration.fidelity, configuration.bounds


@dataclass(frozen=True)
class ContactSample:
    """What is drawn for a contact."""

    pose: np.ndarray
    """(6,) m and rad."""
    shear: np.ndarray
    """(6,) m and rad."""
    solid: SignedDistanceMesh | None
    """What is pressed on, where it is bent anew for each contact."""
    design: Design
    """The tip, with the mechanics of this contact."""
    draw: np.random.Generator
    """What the rest of the contact is drawn by."""


_MOST_DRAWS = 1000
"""Draws of a motion before ranges are given up: of the corners of ±25 degrees every other one is too steep."""


def _motion(configuration, generator):
    """A pose and a shear (6,), m and rad: the first draw that is not too steep to be played.

    Raises TactipError where there is none, or next to none.
    """
    for _ in range(_MOST_DRAWS):
        pose, shear = configuration.pose.draw(generator), configuration.shear.draw(generator)
        if not exceeds_max_tilt(pose, shear):
            return pose, shear
    raise TactipError(
        f"of {_MOST_DRAWS} poses and shears drawn from the ranges all are steeper than {np.degrees(MAX_TILT_RAD):g} "
        "degrees: tilts nearer to 0 are needed"
    )


def sample_contact(configuration, number):
    """What is drawn (Drawn) for contact `number` of a Configuration. Poses and shears are the same whatever else is."""
    c = configuration
    draw = generator(c.seed, c.task, c.split, number)
    pose, shear = _motion(c, draw)
    solid = sample_curved_surface(draw, *c.curvature_per_m, c.uneven) if c.bent else None
    return ContactSample(pose, shear, solid, c.design if c.mechanics.still else c.mechanics.draw(c.design, draw), draw)


def simulator_for(configuration, design):
    """The RetryingSimulator of the contacts of a Configuration, by a Design: its own, or one of other mechanics. On a bent
    surface, its stimulus is to be given the solid of each contact."""
    c = configuration
    bent = SolidStimulus(curved_surface(0.0, 0.0, 0.0), sharpest_m=1 / MAX_CURVATURE_PER_M) if c.bent else None
    return RetryingSimulator(design, bent or c.task, c.fidelity, c.bounds)
