"""The folder of a data set while it is made: its lock, its progress, and how records become a finished set."""

import contextlib
import json
import os
import platform
import shutil
from collections import deque
from collections.abc import Iterable
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import PARTIAL, checksum, meta_json, pack_pins, read_meta, targets_csv, versions
from tactip_twin.sim.dataset.mesh_states import pack_mesh_states
from tactip_twin.sim.dataset.partial_record import (
    check_unaltered,
    contact_numbers,
    read_record,
    record_path,
    sample_indices,
    unpack_finished_set,
)
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.resume import check_resumable, first_difference
from tactip_twin.sim.parallel.worker_pool import disk_error
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import sync_all, write_file
from tactip_twin.tactip_model.input_files import read_file, read_json

if TYPE_CHECKING:
    from tactip_twin.sim.dataset.shards import ShardFinalizer

_KIND = "data set"
_SAMPLES = "configuration.samples"


class _Costs:
    """Costs of the contacts made by this command."""

    def __init__(self) -> None:
        self.count = 0
        """Number of contacts."""
        self.seconds: deque[float] = deque(maxlen=_MAX_COSTS)
        """Seconds of each of the last ones."""
        self.peak_mib = 0.0
        """Peak memory of a worker, MiB."""

    def add(self, seconds: float, peak_mib: float) -> None:
        """Add a contact: its seconds, and the peak memory of its worker in MiB."""
        self.count += 1
        self.seconds.append(seconds)
        self.peak_mib = max(self.peak_mib, peak_mib)


_MAX_COSTS = 10_000
"""Number of contacts whose seconds are kept for the median: a set may have millions."""


class DatasetBuilder:
    """The folder of a data set while it is made. In its `with` block no other command can make this set."""

    def __init__(self, configuration: Configuration, path: Path, alone: bool = True) -> None:
        """Prepare to make a set; nothing is written yet.

        Args:
            configuration: Configuration of the set.
            path: Folder of the set.
            alone: Whether the folder has a lock of its own; False for a part of another folder, which is locked already.
        """
        self._configuration, self._path, self._alone = configuration, path, alone
        self._partial = path / PARTIAL
        self._open_contexts = contextlib.ExitStack()
        self._missing: set[int] | None = None
        """Numbers of the contacts that are still to be made; None until they are looked for."""
        self._samples: dict[str, int] | None = None
        """The counts in meta.json, once there is one."""
        self._costs = _Costs()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            try:
                self._open(stack)
            except OSError as error:
                raise TactipError(f"cannot write to the folder {self._path}: {error.strerror or error}") from error
            self._open_contexts = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open_contexts.close()

    def _open(self, stack: contextlib.ExitStack) -> None:
        identity = {"configuration": self._configuration.as_json(), "versions": versions()}
        meta = self._existing_meta(identity)
        if not self._partial.exists():
            if self._is_complete(meta):
                return
            if meta:
                check_unaltered(self._path, meta)  # before anything is written
            else:
                check_resumable(self._path, _KIND, None, identity)
        # This folder marks the set as started. It comes first, so a kill before the next line leaves a resumable set.
        self._partial.mkdir(parents=True, exist_ok=True)
        if self._alone:
            stack.enter_context(locked(self._partial / "lock", f"making the set in {self._path}"))
        meta = self._existing_meta(identity)  # another command may have finished it
        if self._is_complete(meta):
            shutil.rmtree(self._partial, ignore_errors=True)  # a kill came between the last two steps
            return
        started = self._partial / "configuration.json"
        recorded = _read_json(started)
        if recorded and not meta:
            self._check_same(recorded, identity)
        else:
            if started.exists() and not meta:
                # A power cut damaged it, so the configuration of the records is unknown.
                for record in self._partial.glob("*.npz"):
                    record.unlink()
            write_file(started, json.dumps(identity, indent=1).encode())
        for folder in (self._path, self._partial, self._path / "images"):
            for leftover in folder.glob(".*.tmp"):
                leftover.unlink(missing_ok=True)  # a worker that outlived its command may just have renamed it
        self._begin(stack, meta)

    def _existing_meta(self, identity: dict[str, Any]) -> dict[str, Any] | None:
        """Return the meta.json of a finished set of this identity with as many samples or fewer; None if there is none.

        Raises:
            TactipError: The folder holds a set of another identity, or a larger one.
        """
        path = self._path / "meta.json"
        if not path.exists() or (self._partial.exists() and _read_json(path) is None):
            return None  # an unfinished set, or a finished one whose last file was damaged before the records were removed
        meta = read_meta(self._path)
        self._check_same({key: meta.get(key) for key in identity}, _with_size_of(identity, meta))
        return meta

    def _is_complete(self, meta: dict[str, Any] | None) -> bool:
        """Return whether a finished set has all the requested samples, and note its counts if so."""
        if not meta or meta["configuration"]["samples"] != self._configuration.samples:
            return False
        self._samples = meta["samples"]
        return True

    def _begin(self, stack: contextlib.ExitStack, meta: dict[str, Any] | None) -> None:
        """Prepare the folder for samples.

        Args:
            stack: Contexts that are closed at the end.
            meta: The meta.json of a finished set that grows; None for a new or unfinished one.
        """
        (self._path / "images").mkdir(exist_ok=True)
        if meta:
            unpack_finished_set(self._path)

    def _check_same(self, recorded: dict[str, Any], requested: dict[str, Any]) -> None:
        """Raise TactipError where the folder holds a set of another identity."""
        difference = first_difference(recorded, requested)
        if difference and difference[0] == _SAMPLES:
            _, old, new = difference
            if not first_difference(recorded, _with_samples(requested, json.loads(old))):
                finished = (self._path / "meta.json").exists()
                allowed = f"at least {old}" if finished else f"{old} until the set is finished"
                raise TactipError(
                    f"the {'finished' if finished else 'unfinished'} set in {self._path} has {old} samples: samples must be "
                    f"{allowed}, got {new}; or choose another folder"
                )
        if difference and difference[0] in ("configuration.fast_tip", "configuration.corrected"):
            old, new = (_fidelity(one["configuration"]) for one in (recorded, requested))
            if old != new:
                raise TactipError(
                    f"the folder {self._path} holds a {_KIND} with the fidelity {old}, got {new}: choose another folder, or "
                    "remove this one"
                )
        check_resumable(self._path, _KIND, recorded, requested)

    def plan(self) -> tuple[int, int]:
        """Return the numbers of contacts and of samples that are still to be made."""
        numbers = list(self.missing())
        return len(numbers), sum(len(sample_indices(self._configuration, number)) for number in numbers)

    def missing(self) -> Iterable[int]:
        """Return the numbers of the contacts that are still to be made, as they were when this was first called."""
        if self._missing is None:
            self._missing = set() if self.finished else self._find_missing()
        return sorted(self._missing)

    def set_missing(self, numbers: Iterable[int]) -> None:
        """Set the numbers of the contacts that are still to be made, where they are known."""
        self._missing = {int(number) for number in numbers}

    def _find_missing(self) -> set[int]:
        recorded = {path.name for path in self._partial.glob("*.npz")}
        return {
            number
            for number in contact_numbers(self._configuration)
            if record_path(self._path, number).name not in recorded or not self._is_done(number)
        }

    def done(self, number: int, cost: tuple[float, float], workers: int, seconds: float) -> "list[ShardFinalizer]":
        """Note that a contact is made, and finish the set if it was the last.

        Args:
            number: Number of the contact.
            cost: Seconds, and peak memory of the worker in MiB.
            workers: Number of workers.
            seconds: Time since the start of the command, s.

        Returns:
            Tasks for a worker that finish shards.
        """
        if self.last(number, cost, workers, seconds):
            self.finish(workers, seconds)
        return []

    def last(self, number: int, cost: tuple[float, float], workers: int, seconds: float) -> bytes | None:
        """Note that a contact is made, as `done` does; return the bytes of run.json if it was the last, else None."""
        self._costs.add(*cost)
        missing = self._missing or set()
        missing.discard(number)
        return None if missing else self._run_json(workers, seconds)

    @property
    def finished(self) -> bool:
        """Whether the set is finished."""
        return self._samples is not None

    def _is_done(self, number: int) -> bool:
        """Return whether a contact has an intact record and intact images; what a power cut damaged is made anew."""
        record = read_record(record_path(self._path, number), self._configuration.keep_mesh)
        return record is not None and all(self._is_intact(name, value) for name, value in record["images"].items())

    def _is_intact(self, name: str, expected: str) -> bool:
        path = self._path / "images" / name
        return path.exists() and checksum(read_file(path)) == expected

    def finish(self, workers: int, seconds: float) -> dict[str, Any]:
        """Turn records into a finished set, if it is not one yet.

        Args:
            workers: Number of workers.
            seconds: Time since the start of the command, s.

        Returns:
            A result with folder, asked, kept, failed, made and seconds.

        Raises:
            TactipError: The disk is full.
        """
        if self._samples is None:
            try:
                self._samples = self.assemble(self._run_json(workers, seconds))
            except OSError as error:
                raise TactipError(disk_error(error)) from error
        return {"folder": str(self._path), **self._samples, "made": self._made(), "seconds": seconds}

    def _made(self) -> int:
        """Return the number of samples made by this command; the last contact of a set may make fewer than the others."""
        return min(self._costs.count * self._configuration.samples_per_contact, self._configuration.samples)

    def assemble(self, run_json: bytes) -> dict[str, int]:
        """Write the tables of the set and meta.json, from the records.

        Args:
            run_json: Content of run.json.

        Returns:
            The counts in meta.json.
        """
        rows, failures, images, pin_tips, directions = [], [], {}, [], []
        numbers, states = [], []
        for number in contact_numbers(self._configuration):
            with np.load(record_path(self._path, number), allow_pickle=False) as data:
                record = json.loads(str(data["record"]))
                if record["failed"]:
                    for index in sample_indices(self._configuration, number):
                        seed = record["rows"][0]["seed"]
                        failures.append({"index": index, "seed": seed, "tries": record["violations"]})
                    continue
                failures += record.get("missed", [])
                rows += record["rows"]
                images |= record["images"]
                pin_tips += list(data["pin_tips"])
                directions += list(data["directions"])
                if self._configuration.keep_mesh:
                    numbers.append(number)
                    states.append(data["states"])
        pins = pack_pins(self._configuration, pin_tips, directions)
        files = {"targets.csv": targets_csv(rows), "pins.npz": pins}
        if self._configuration.keep_mesh:
            files["mesh.npz"] = pack_mesh_states(self._configuration, numbers, states)
        for name, data in files.items():
            write_file(self._path / name, data)
        write_file(self._path / "run.json", run_json)
        sync_all()  # images are written unsynced, and meta.json declares the set finished
        sums = {name: checksum(data) for name, data in files.items()}
        samples = {"asked": self._configuration.samples, "kept": len(rows), "failed": len(failures)}
        more = {"failures": failures, "images": images}
        write_file(self._path / "meta.json", meta_json(self._configuration, samples, sums, more))
        shutil.rmtree(self._partial)
        return samples

    def _run_json(self, workers: int, seconds: float) -> bytes:
        """Return the content of run.json: facts of this run, which differ between runs."""
        run = {
            "finished": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
            "workers": workers,
            "samples_made_by_the_last_command": self._made(),
            "seconds_from_the_commands_start": round(seconds, 3),
        }
        if self._costs.count:  # none if a kill came just before the end
            run["seconds_a_contact_and_worker_median"] = round(float(np.median(self._costs.seconds)), 4)
            run["peak_memory_of_a_worker_MiB"] = round(self._costs.peak_mib)
        return (json.dumps(run, indent=1) + "\n").encode()


def _read_json(path: Path) -> dict[str, Any] | None:
    """Return the object in a JSON file; None if the file is missing or damaged."""
    try:
        data = read_json(path)
    except TactipError:
        return None
    return data if isinstance(data, dict) else None


def _with_size_of(identity: dict[str, Any], meta: dict[str, Any]) -> dict[str, Any]:
    """Return an identity with the number of samples of a finished set if that is smaller: such a set can grow."""
    existing, requested = meta.get("configuration", {}).get("samples"), identity["configuration"]["samples"]
    return _with_samples(identity, existing if isinstance(existing, int) and existing < requested else requested)


def _with_samples(identity: dict[str, Any], samples: int) -> dict[str, Any]:
    """Return an identity with another number of samples."""
    return {**identity, "configuration": {**identity["configuration"], "samples": samples}}


def _fidelity(configuration: dict[str, Any]) -> str:
    """Return the name of the fidelity of a set's configuration, as JSON."""
    if configuration.get("fast_tip"):
        return "corrected" if configuration.get("corrected") else "fast"
    return str(configuration["fidelity"]["name"])
