"""Makes data sets: contacts on worker processes, images, and files that survive a kill at any moment.

A contact, with the sample or the samples that it makes, is done when its record is in the set's `.partial` folder, after its
images. Resuming makes what has no record; the same bytes come out, because a contact depends on nothing but the
configuration and its number. When all are done the records become targets.csv, pins.npz and, last, meta.json. A finished
set grows in the same way: it becomes records again, and those that it lacks are made.
"""

import contextlib
import io
import json
import os
import platform
import shutil
import time
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from sim.bent import MOST_BENT_PER_M, MOST_HOLLOW_PER_M, bent_surface, drawn_surface
from sim.cluster import ClusterCrew, joined, ray_here
from sim.contact import STEEPEST_RAD, CarefulPlayer, check_ranges, too_steep
from sim.crew import Crew, disk_error
from sim.dataset import (
    PARTIAL,
    Configuration,
    checksum,
    encode_image,
    image_name,
    meta_json,
    read_meta,
    row_of,
    targets_csv,
    versions,
    write_file,
)
from sim.lock import locked
from sim.record import contacts_of, pack_record, read_record, record_path, reopen, samples_of
from sim.sampling import generator, seed_text
from sim.shape import Shape
from sim.solid import Solid
from sim.symmetry import SymmetricReader, keeps
from tactip_model.design import Design
from tactip_model.errors import TactipError, choose
from tactip_model.image import tactile_image
from tactip_model.pins import neutral_pins
from tactip_model.renderer import RENDERERS, renderer_named


@dataclass(frozen=True)
class Job:
    """A set to make and where."""

    configuration: Configuration
    folder: Path


def check(configuration):
    """Raise TactipError where a configuration (Configuration) cannot be made."""
    if configuration.samples < 1:
        raise TactipError(f"a set of {configuration.samples} samples cannot be made: ask for at least 1")
    if configuration.seed < 0:
        raise TactipError(f"the seed {configuration.seed} does not do: it must be 0 or more")
    choose("renderer", configuration.renderer, dict.fromkeys(RENDERERS))
    first = generator(configuration.seed, configuration.task, configuration.split, 0)
    configuration.pose.check("pose")
    configuration.shear.check("shear")
    check_ranges(configuration.pose, configuration.shear)
    _motion(configuration, first)
    _check_curvature(configuration)
    for name in ("pose", "shear"):
        if not keeps(configuration.symmetries, getattr(configuration, name)):
            raise TactipError(
                f"the ranges of the {name} are not as wide to one side as to the other, and samples by symmetry would leave "
                "them: leave --symmetric out, or make the ranges even"
            )


def _check_curvature(configuration):
    low, high = configuration.curvature_per_m
    if configuration.bent and configuration.task != "surface":
        raise TactipError(f"a curvature is asked for with the task {configuration.task!r}: only a surface can be bent")
    if not 0 <= configuration.uneven <= 1:
        raise TactipError(f"the share of uneven surfaces is {configuration.uneven}: it must be from 0 to 1")
    if configuration.uneven and not configuration.bent:
        raise TactipError("an unevenly bent surface is asked for without a range of curvature: give --curvature-per-m, too")
    if not -MOST_HOLLOW_PER_M <= low <= high <= MOST_BENT_PER_M:
        raise TactipError(
            f"the range of curvature is ({low}, {high}) 1/m: it must be rising, and from -{MOST_HOLLOW_PER_M:g} "
            f"to {MOST_BENT_PER_M:g}"
        )


def make(jobs, workers, say=print, cluster=""):
    """Make the sets of `jobs` (list of Job), or finish them where they were left.

    workers: int; 0 for as many as there is room for. say: called with each line for the user. cluster: str, address of a Ray
    cluster (sim/cluster.py) whose workers make them, in folders that all of its machines see; none if empty. Returns a list
    of dict, one a job: samples kept, failed, made now, and the seconds this took. Raises TactipError (wrong configuration,
    unwritable folder, no OpenGL, no cluster, a set of another configuration in the folder) and Stopped (Ctrl-C). Nothing
    that was done is lost by either.
    """
    if cluster:
        ray_here()
    for job in jobs:
        check(job.configuration)
    with contextlib.ExitStack() as stack:
        folders = [stack.enter_context(_Folder(job)) for job in jobs]
        todo = [(k, number) for k, folder in enumerate(folders) for number in folder.missing()]
        total = sum(job.configuration.samples for job in jobs)
        left = sum(len(samples_of(jobs[k].configuration, number)) for k, number in todo)
        if todo and left < total:
            say(f"{total - left} of {total} samples are there already")
        start = time.perf_counter()

        def done(task, *cost):
            folder = folders[task[0]]
            folder.costs.append(cost)
            if len(folder.costs) == sum(job == task[0] for job, _ in todo):
                folder.finish(time.perf_counter() - start, workers)

        if todo:
            arguments = [job.configuration for job in jobs], [str(job.folder.resolve()) for job in jobs]
            unit = "contact" if any(job.configuration.symmetric for job in jobs) else "sample"
            given = _Makers, arguments, todo, unit, say
            crew = ClusterCrew(stack.enter_context(joined(cluster)), *given) if cluster else Crew(*given)
            workers = min(workers or crew.places(), len(todo))
            crew.work(workers, done)
        return [folder.finish(time.perf_counter() - start, workers) for folder in folders]


class _Makers:
    """The sample makers of a worker, made as they are needed."""

    def __init__(self, configurations, folders):
        """configurations: list of Configuration. folders: list of str, theirs."""
        self._configurations, self._folders, self._makers = configurations, folders, {}

    def __call__(self, task):
        """Make the samples of the contact `task` (job number, contact number)."""
        job, number = task
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
        self._player = played[0]._player if played else player_of(c, c.design)
        self._reader = SymmetricReader(c.design, self._player.skin()[1], c.symmetries) if c.symmetric else None

    def make(self, number):
        """Write the images and the record of contact `number`. Raises OSError."""
        c = self._configuration
        given = drawn(c, number)
        player, reader = self._player, self._reader
        if not c.mechanics.still:
            player = player_of(c, given.design)
            reader = SymmetricReader(given.design, player.skin()[1], c.symmetries) if c.symmetric else None
        if given.solid is not None:
            player.stimulus.solid = given.solid
        contact, faults = player.play(given.pose, given.shear)
        failed = len(faults) == player.tries
        contacts = reader.read(contact, player.skin()[0]) if reader and not failed else [contact]
        indices = samples_of(c, number)
        contacts, rows, images = contacts[: len(indices)], [], {}
        for index, one in zip(indices, contacts, strict=False):
            rows.append(row_of(one, index, len(faults) + 1, seed_text(c.seed, c.task, c.split, number)))
            if not failed:
                image = tactile_image(self._render(one.tips, one.directions), c.design.image)
                data = encode_image(image)
                write_file(self._folder / "images" / image_name(index), data)
                images[image_name(index)] = checksum(data)
        record = {"rows": rows, "faults": faults, "failed": failed, "images": images}
        pins = ([getattr(one, k) for one in contacts] for k in ("tips", "directions"))
        write_file(record_path(self._folder, number), pack_record(record, *pins))


def _physics(configuration):
    return configuration.task, configuration.bent, configuration.fidelity, configuration.bounds


@dataclass(frozen=True)
class Drawn:
    """What is drawn for a contact."""

    pose: np.ndarray
    """(6,) m and rad."""
    shear: np.ndarray
    """(6,) m and rad."""
    solid: Solid | None
    """What is pressed on, where it is bent anew for each contact."""
    design: Design
    """The tip, with the mechanics of this contact."""


_MOST_DRAWS = 1000
"""Draws of a motion before ranges are given up: of the corners of ±25 degrees every other one is too steep."""


def _motion(configuration, generator):
    """A pose and a shear (6,), m and rad: the first draw that is not too steep to be played.

    Raises TactipError where there is none, or next to none.
    """
    for _ in range(_MOST_DRAWS):
        pose, shear = configuration.pose.draw(generator), configuration.shear.draw(generator)
        if not too_steep(pose, shear):
            return pose, shear
    raise TactipError(
        f"of {_MOST_DRAWS} poses and shears drawn from the ranges all are steeper than {np.degrees(STEEPEST_RAD):g} "
        "degrees: tilts nearer to 0 are needed"
    )


def drawn(configuration, number):
    """What is drawn (Drawn) for contact `number` of a Configuration. Poses and shears are the same whatever else is."""
    c = configuration
    draw = generator(c.seed, c.task, c.split, number)
    pose, shear = _motion(c, draw)
    solid = drawn_surface(draw, *c.curvature_per_m, c.uneven) if c.bent else None
    return Drawn(pose, shear, solid, c.design if c.mechanics.still else c.mechanics.draw(c.design, draw))


def player_of(configuration, design):
    """The CarefulPlayer of the contacts of a Configuration, by a Design: its own, or one of other mechanics. On a bent
    surface, its stimulus is to be given the solid of each contact."""
    c = configuration
    bent = Shape(bent_surface(0.0, 0.0, 0.0), sharpest_m=1 / MOST_BENT_PER_M) if c.bent else None
    return CarefulPlayer(design, bent or c.task, c.fidelity, c.bounds)


class _Folder:
    """A set's folder while it is made: whose it is, what is done, and the step from records to a finished set."""

    def __init__(self, job):
        self._configuration, self._path = job.configuration, job.folder
        self._partial = job.folder / PARTIAL
        self._held = contextlib.ExitStack()
        self._samples = None
        """The counts in meta.json, once there is one."""
        self.costs = []
        """(seconds, peak memory of the worker in MiB) of each sample made now."""

    def __enter__(self):
        with contextlib.ExitStack() as held:
            try:
                self._open(held)
            except OSError as error:
                raise TactipError(f"cannot write to the folder {self._path}: {error.strerror or error}") from error
            self._held = held.pop_all()
        return self

    def __exit__(self, *_):
        self._held.close()

    def _open(self, held):
        identity = {"configuration": self._configuration.as_json(), "versions": versions()}
        grows = (self._path / "meta.json").exists()
        if grows:
            meta = read_meta(self._path)
            self._refuse_other({k: meta.get(k) for k in identity}, _of_size(identity, meta))
            if meta["configuration"]["samples"] == self._configuration.samples:
                self._samples = meta["samples"]
                shutil.rmtree(self._partial, ignore_errors=True)  # a kill came between the last two steps
                return
        elif self._path.exists() and not self._partial.exists() and any(self._path.iterdir()):
            raise TactipError(f"the folder {self._path} is not empty and holds no data set: name another one")
        # First of all what makes the folder ours, so that a kill before the next line does not make it a stranger's.
        self._partial.mkdir(parents=True, exist_ok=True)
        (self._path / "images").mkdir(exist_ok=True)
        held.enter_context(locked(self._partial / "lock", f"making the set in {self._path}"))
        known = self._partial / "configuration.json"
        if known.exists() and not grows:
            self._refuse_other(json.loads(known.read_text()), identity)
        else:
            write_file(known, json.dumps(identity, indent=1).encode())
        if grows:
            reopen(self._path)
        for place in (self._path, self._partial, self._path / "images"):
            for leftover in place.glob(".*.tmp"):
                leftover.unlink(missing_ok=True)  # a worker that outlived its command may just have renamed it

    def _refuse_other(self, there, asked):
        difference = _first_difference(there, asked, "")
        if difference:
            name, old, new = difference
            raise TactipError(
                f"the folder {self._path} holds a set of another configuration: {name} is {old} there and {new} here; "
                "name another folder, or remove this one"
            )

    def missing(self):
        """Numbers (list of int) of the contacts that are still to be made."""
        if self._samples:
            return []
        return [n for n in range(contacts_of(self._configuration)) if not self._done(n)]

    def _done(self, number):
        record = record_path(self._path, number)
        names = (image_name(i) for i in samples_of(self._configuration, number))
        return record.exists() and (
            all((self._path / "images" / n).exists() for n in names) or read_record(record)["failed"]
        )

    def finish(self, seconds, workers):
        """Turn records into a finished set, if it is not one. Returns a dict: folder, asked, kept, failed, made, seconds.

        seconds: float, since the command began. workers: int. Raises TactipError where the disk is full.
        """
        if not self._samples:
            try:
                self._samples = self._assemble(workers, seconds)
            except OSError as error:
                raise TactipError(disk_error(error)) from error
        return {"folder": str(self._path), **self._samples, "made": self._made(), "seconds": seconds}

    def _made(self):
        """Samples made now; the last contact of a set may have been cut short."""
        return min(len(self.costs) * len(self._configuration.symmetries), self._configuration.samples)

    def _assemble(self, workers, seconds):
        rows, failures, images, tips, directions = [], [], {}, [], []
        for number in range(contacts_of(self._configuration)):
            with np.load(record_path(self._path, number), allow_pickle=False) as data:
                record = json.loads(str(data["record"]))
                if record["failed"]:
                    for index in samples_of(self._configuration, number):
                        seed = record["rows"][0]["seed"]
                        failures.append({"index": index, "seed": seed, "tries": record["faults"]})
                    continue
                rows += record["rows"]
                images |= record["images"]
                tips += list(data["tips"])
                directions += list(data["directions"])
        neutral_tips, neutral_directions = neutral_pins(self._configuration.design)
        pins = io.BytesIO()
        shape = (-1, len(neutral_tips), 3)
        np.savez(
            pins,
            tips=np.array(tips, np.float32).reshape(shape),
            directions=np.array(directions, np.float32).reshape(shape),
            neutral_tips=neutral_tips.astype(np.float32),
            neutral_directions=neutral_directions.astype(np.float32),
            digest=np.array(self._configuration.digest()),
        )
        files = {"targets.csv": targets_csv(rows), "pins.npz": pins.getvalue()}
        for name, data in files.items():
            write_file(self._path / name, data)
        write_file(self._path / "run.json", self._run_json(workers, seconds))
        sums = {name: checksum(data) for name, data in files.items()}
        write_file(self._path / "meta.json", meta_json(self._configuration, rows, failures, sums, images))
        shutil.rmtree(self._partial)
        return {"asked": self._configuration.samples, "kept": len(rows), "failed": len(failures)}

    def _run_json(self, workers, seconds):
        """The facts of this very run, which are not the same in the next."""
        run = {
            "finished": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
            "workers": workers,
            "samples_made_by_the_last_command": self._made(),
            "seconds_from_the_commands_start": round(seconds, 3),
        }
        if self.costs:  # none if a kill came just before the end
            run["seconds_a_contact_and_worker_median"] = round(float(np.median([c[0] for c in self.costs])), 4)
            run["peak_memory_of_a_worker_MiB"] = round(max(c[1] for c in self.costs))
        return (json.dumps(run, indent=1) + "\n").encode()


def _of_size(identity, meta):
    """An `identity` with the samples of a finished set's `meta` where these are fewer: such a set can grow."""
    there, asked = meta.get("configuration", {}).get("samples"), identity["configuration"]["samples"]
    small = there if isinstance(there, int) and there < asked else asked
    return {**identity, "configuration": {**identity["configuration"], "samples": small}}


def _first_difference(there, asked, name):
    """The first (name, value there, value asked) in which two JSON values differ, or None."""
    if isinstance(there, dict) and isinstance(asked, dict):
        for key in sorted(set(there) | set(asked)):
            difference = _first_difference(there.get(key), asked.get(key), f"{name}.{key}" if name else key)
            if difference:
                return difference
        return None
    return None if there == asked else (name, json.dumps(there), json.dumps(asked))
