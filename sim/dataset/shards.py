"""Large sets: folders of shards, each a whole set of its own, and a manifest that makes one set of them.

    shard-00000/ …   a set of at most `shard_samples` samples; their indices go on from shard to shard
    meta.json        the manifest: configuration of the whole, its shards, and a checksum of the meta.json of each
    run.json         when, where and how fast it was made

What is held in memory while a set is made, and how many files a folder has, is then a matter of a shard and not of the set.
Readers (sim/dataset/format.py) take shards as one set. A set that grows out of one shard is moved into its first.
"""

import shutil
from dataclasses import dataclass, replace

from tactip_twin.sim.dataset.builder import DatasetBuilder
from tactip_twin.sim.dataset.format import PARTIAL, checksum, meta_json, read_meta
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file


def is_sharded(configuration):
    """Whether a set of a Configuration is a folder of shards (bool)."""
    return configuration.samples > _most(configuration)


def open_builder(configuration, path):
    """The folder (DatasetBuilder) in which a set of a Configuration is made at a Path."""
    return (ShardedFolder if is_sharded(configuration) else DatasetBuilder)(configuration, path)


def shard_dir(configuration, folder, number):
    """Path of the set or shard to which contact `number` of the set of a Configuration in a folder (Path) belongs."""
    if not is_sharded(configuration):
        return folder
    return folder / _shard_name(number * configuration.each // _most(configuration))


def shards_of(configuration):
    """Configurations of the shards of a Configuration, by the names of their folders (dict)."""
    each, total = _most(configuration), configuration.samples
    starts = range(0, total, each)
    return {
        _shard_name(k): replace(configuration, first=first, samples=min(each, total - first))
        for k, first in enumerate(starts)
    }


def _most(configuration):
    """Most samples (int) of a shard: those of a contact stay together."""
    return configuration.shard_samples - configuration.shard_samples % configuration.each


def _shard_name(k):
    return f"shard-{k:05d}"


@dataclass(frozen=True, repr=False)
class ShardFinalizer:
    """A shard that has all of its contacts: a task for a worker, so that who hands out contacts need not do it."""

    name: str
    """Folder of the shard, within that of the set."""
    run_json: bytes
    """What its run.json is to be."""

    def __call__(self, configuration, folder):
        """Turn its records into a finished set. configuration: Configuration of the whole set. folder: Path, the whole
        set's. Raises OSError."""
        part = DatasetBuilder(shards_of(configuration)[self.name], folder / self.name, alone=False)
        # Another worker may have done it, and been lost before it could say so.
        if (folder / self.name / "meta.json").exists():
            shutil.rmtree(folder / self.name / PARTIAL, ignore_errors=True)
        else:
            part.assemble(self.run_json)

    def __repr__(self):
        return f"the end of {self.name}"


class ShardedFolder(DatasetBuilder):
    """The folder of a set of shards while it is made."""

    def __init__(self, configuration, path):
        """configuration: Configuration. path: Path."""
        super().__init__(configuration, path)
        parts = shards_of(configuration).items()
        self._shards = {name: DatasetBuilder(part, path / name, alone=False) for name, part in parts}

    def _there(self, identity):
        """See DatasetBuilder. Raises TactipError where it is larger than a shard, and in one folder."""
        meta = super()._there(identity)
        if meta and "shards" not in meta and (there := meta["configuration"]["samples"]) > _most(self._configuration):
            raise TactipError(
                f"the set in {self._path} cannot grow: it has {there} samples in one folder, more than the "
                f"{_most(self._configuration)} of a shard; make the larger one in another folder"
            )
        return meta

    def _begin(self, held, meta):
        if meta and "shards" in meta:
            for name in ("meta.json", "run.json"):
                (self._path / name).unlink(missing_ok=True)
        # meta.json goes first: after a kill it is an unfinished set, and the next command moves what it finds.
        first = self._path / _shard_name(0)
        first.mkdir(exist_ok=True)
        for name in ("meta.json", "images", "targets.csv", "pins.npz", "run.json"):
            if (self._path / name).exists():
                (self._path / name).rename(first / name)
        for shard in self._shards.values():
            held.enter_context(shard)

    def missing(self):
        """See DatasetBuilder."""
        return [] if self.finished else [number for shard in self._shards.values() for number in shard.missing()]

    def done(self, number, cost, workers, seconds):
        """See DatasetBuilder."""
        self.costs.append(cost)
        name = shard_dir(self._configuration, self._path, number).name
        run_json = self._shards[name].last(number, cost, workers, seconds)
        return [ShardFinalizer(name, run_json)] if run_json else []

    def closed(self, name):
        """Note that a worker has closed a shard."""
        self._shards[name].closed_elsewhere()

    def finish(self, workers, seconds):
        """See DatasetBuilder."""
        # Those that a command before this one left without their end.
        for shard in () if self.finished else self._shards.values():
            shard.finish(workers, seconds)
        return super().finish(workers, seconds)

    def assemble(self, run_json):
        """See DatasetBuilder."""
        counts = {name: read_meta(self._path / name)["samples"] for name in self._shards}
        samples = {key: sum(count[key] for count in counts.values()) for key in ("asked", "kept", "failed")}
        write_file(self._path / "run.json", run_json)
        sums = {f"{name}/meta.json": checksum((self._path / name / "meta.json").read_bytes()) for name in counts}
        write_file(self._path / "meta.json", meta_json(self._configuration, samples, sums, {"shards": list(counts)}))
        shutil.rmtree(self._partial)
        return samples
