"""The folder of a set while it is made: whose it is, what is done, and the step from records to a finished set."""

import contextlib
import io
import json
import os
import platform
import shutil
from datetime import datetime, timezone

import numpy as np

from tactip_twin.sim.dataset.format import PARTIAL, checksum, image_name, meta_json, read_meta, targets_csv, versions
from tactip_twin.sim.dataset.partial_record import numbers_of, read_record, record_path, samples_of, unpack_finished_set
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.worker_pool import disk_error
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.pins import neutral_pins

_SAMPLES = "configuration.samples"


class DatasetBuilder:
    """A set's folder while it is made; held for a `with` block, in which no other command makes this set."""

    def __init__(self, configuration, path, alone=True):
        """configuration: Configuration. path: Path. alone: bool, no part of another folder, which is held already."""
        self._configuration, self._path, self._alone = configuration, path, alone
        self._partial = path / PARTIAL
        self._held = contextlib.ExitStack()
        self._left = set()
        self._samples = None
        """The counts (dict) in meta.json, once there is one."""
        self.costs = []
        """(seconds, peak memory of the worker in MiB) of each contact made now."""

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
        meta = self._there(identity)
        if not self._partial.exists():
            if self._is_whole(meta):
                return
            if not meta and self._path.exists() and any(self._path.iterdir()):
                raise TactipError(f"the folder {self._path} is not empty and holds no data set: name another one")
        # First of all what makes the folder ours, so that a kill before the next line does not make it a stranger's.
        self._partial.mkdir(parents=True, exist_ok=True)
        if self._alone:
            held.enter_context(locked(self._partial / "lock", f"making the set in {self._path}"))
        meta = self._there(identity)  # another command may have come to its end
        if self._is_whole(meta):
            shutil.rmtree(self._partial, ignore_errors=True)  # a kill came between the last two steps
            return
        known = self._partial / "configuration.json"
        if known.exists() and not meta:
            self._refuse_other(json.loads(known.read_text()), identity)
        else:
            write_file(known, json.dumps(identity, indent=1).encode())
        for place in (self._path, self._partial, self._path / "images"):
            for leftover in place.glob(".*.tmp"):
                leftover.unlink(missing_ok=True)  # a worker that outlived its command may just have renamed it
        self._begin(held, meta)

    def _there(self, identity):
        """The meta.json (dict) of a finished set of an `identity`, of as many samples or fewer; None where there is none.

        Raises TactipError where it is one of another identity.
        """
        if not (self._path / "meta.json").exists():
            return None
        meta = read_meta(self._path)
        self._refuse_other({k: meta.get(k) for k in identity}, _of_size(identity, meta))
        return meta

    def _is_whole(self, meta):
        """Whether a `meta` (dict or None) is of all samples that are asked for (bool); it is noted if so."""
        if not meta or meta["configuration"]["samples"] != self._configuration.samples:
            return False
        self._samples = meta["samples"]
        return True

    def _begin(self, held, meta):
        """Make what samples need. held: ExitStack, closed at the end. meta: dict of a finished set that grows, or None."""
        (self._path / "images").mkdir(exist_ok=True)
        if meta:
            unpack_finished_set(self._path)

    def _refuse_other(self, there, asked):
        difference = _first_difference(there, asked, "")
        if not difference:
            return
        name, old, new = difference
        if name == _SAMPLES and not _first_difference(there, _of_samples(asked, json.loads(old)), ""):
            finished = (self._path / "meta.json").exists()
            unfinished = f"an unfinished set of {old} samples: ask for {old} to finish it, and for more after that"
            holds = f"a set of {old} samples: ask for more of them" if finished else unfinished
            raise TactipError(
                f"{new} samples are asked for, and the folder {self._path} holds {holds}, or name another folder"
            )
        raise TactipError(
            f"the folder {self._path} holds a set of another configuration: {name} is {old} there and {new} here; "
            "name another folder, or remove this one"
        )

    def missing(self):
        """Numbers (list of int) of the contacts that are still to be made."""
        if not self.finished:
            self._left = {n for n in numbers_of(self._configuration) if not self._is_there(n)}
        return sorted(self._left)

    def done(self, number, cost, workers, seconds):
        """Note that contact `number` is made, and finish the set if it was the last.

        cost: of `costs`. workers, seconds: see finish. Returns a list of Closings that a worker is to do.
        """
        if self.last(number, cost, workers, seconds):
            self.finish(workers, seconds)
        return []

    def last(self, number, cost, workers, seconds):
        """Note that contact `number` is made. Returns the bytes of run.json if it was the last, else None."""
        self.costs.append(cost)
        self._left.discard(number)
        return None if self._left else self._run_json(workers, seconds)

    def closed_elsewhere(self):
        """Note that a worker has finished the set."""
        self._samples = read_meta(self._path)["samples"]

    @property
    def finished(self):
        """Whether it is a finished set."""
        return self._samples is not None

    def _is_there(self, number):
        record = record_path(self._path, number)
        names = [image_name(i) for i in samples_of(self._configuration, number)]
        return record.exists() and (self._are_there(names) or self._are_there(read_record(record)["images"]))

    def _are_there(self, names):
        return all((self._path / "images" / name).exists() for name in names)

    def finish(self, workers, seconds):
        """Turn records into a finished set, if it is not one. Returns a dict: folder, asked, kept, failed, made, seconds.

        seconds: float, since the command began. workers: int. Raises TactipError where the disk is full.
        """
        if self._samples is None:
            try:
                self._samples = self.assemble(self._run_json(workers, seconds))
            except OSError as error:
                raise TactipError(disk_error(error)) from error
        return {"folder": str(self._path), **self._samples, "made": self._made(), "seconds": seconds}

    def _made(self):
        """Samples made now; the last contact of a set may have been cut short."""
        return min(len(self.costs) * self._configuration.each, self._configuration.samples)

    def assemble(self, run_json):
        """Write what makes the set whole. run_json: bytes. Returns the counts (dict) in meta.json."""
        rows, failures, images, tips, directions = [], [], {}, [], []
        for number in numbers_of(self._configuration):
            with np.load(record_path(self._path, number), allow_pickle=False) as data:
                record = json.loads(str(data["record"]))
                if record["failed"]:
                    for index in samples_of(self._configuration, number):
                        seed = record["rows"][0]["seed"]
                        failures.append({"index": index, "seed": seed, "tries": record["faults"]})
                    continue
                failures += record.get("missed", [])
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
        write_file(self._path / "run.json", run_json)
        sums = {name: checksum(data) for name, data in files.items()}
        samples = {"asked": self._configuration.samples, "kept": len(rows), "failed": len(failures)}
        more = {"failures": failures, "images": images}
        write_file(self._path / "meta.json", meta_json(self._configuration, samples, sums, more))
        shutil.rmtree(self._partial)
        return samples

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
    return _of_samples(identity, small)


def _of_samples(identity, samples):
    """An `identity` with so many samples (int) in the place of its own."""
    return {**identity, "configuration": {**identity["configuration"], "samples": samples}}


def _first_difference(there, asked, name):
    """The first (name, value there, value asked) in which two JSON values differ, or None."""
    if isinstance(there, dict) and isinstance(asked, dict):
        for key in sorted(set(there) | set(asked)):
            difference = _first_difference(there.get(key), asked.get(key), f"{name}.{key}" if name else key)
            if difference:
                return difference
        return None
    return None if there == asked else (name, json.dumps(there), json.dumps(asked))
