"""Sets of up to ten million samples: what the command that assigns contacts keeps in memory, without simulating them."""

import tracemalloc

import pytest

from helpers.set_commands import configuration
from tactip_twin.sim.dataset.format import image_name, meta_json
from tactip_twin.sim.dataset.generate import check
from tactip_twin.sim.dataset.shards import MAX_SHARDS, ShardedDatasetBuilder, open_builder, shard_name
from tactip_twin.sim.parallel.worker_pool import TaskQueue
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import MAX_JSON_BYTES

MAX_MIB = 20
"""The contacts of a shard take 2 MiB, and Python's table of interned strings, which holds the names of files, up to 10 MiB
if it grows meanwhile. Lists of all samples would take 190 MiB for a million samples (37 MiB for 200,000)."""

MAX_SHARD = 87725
"""Largest allowed number of samples of a shard, for 127 pins."""


@pytest.mark.parametrize("samples", [10**4, 10**5, 10**6, 10**7])
def test_planning_memory_does_not_grow_with_samples(design, tmp_path, samples):
    tracemalloc.start()
    try:
        with open_builder(configuration(design, samples=samples), tmp_path / "set") as builder:
            assert builder.plan() == (samples, samples)
            queue = TaskQueue(builder.missing(), samples)
            count = min(samples, 20_000)
            assert [queue.pop() for _ in range(count)][-1] == count - 1
            peak = tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
    print(f"{samples} samples: at most {peak:.1f} MiB")
    assert peak < MAX_MIB
    # A shard is prepared when its first contact is assigned.
    assert len(list((tmp_path / "set").glob("shard-*"))) == (0 if samples == 10**4 else 2)


@pytest.mark.slow
def test_memory_of_all_contacts_is_that_of_one_shard(design, tmp_path):
    """All contacts are assigned and reported as made; workers would write their records and finish the shards."""
    peaks = {}
    for samples in (20_000, 200_000):
        tracemalloc.start()
        try:
            with open_builder(configuration(design, samples=samples), tmp_path / f"{samples}") as builder:
                assert isinstance(builder, ShardedDatasetBuilder)
                builder.plan()
                ends = []
                for number in builder.missing():
                    for end in builder.done(number, (0.1, 100.0), 2, 1.0):
                        builder.mark_shard_finished(end.shard)
                        ends.append(end.shard)
            peaks[samples] = tracemalloc.get_traced_memory()[1] / 2**20
        finally:
            tracemalloc.stop()
        assert ends == list(range(samples // 10_000))
    assert max(peaks.values()) < MAX_MIB, peaks


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": 10**7, "shard_samples": 99}, "shard_samples must be at least 100 for 10000000 samples, got 99"),
        (
            {"samples": 10**6, "shard_samples": 10**6},
            f"shard_samples must be at most {MAX_SHARD} for these pins",
        ),
    ],
)
def test_shards_that_could_not_be_read_again_are_refused(design, changes, message):
    with pytest.raises(TactipError, match=message):
        check(configuration(design, **changes))


def test_descriptions_of_largest_shard_and_of_most_shards_can_be_read(design):
    counts = {"asked": 1, "kept": 1, "failed": 0}
    images = {image_name(10**7 - i): 64 * "f" for i in range(MAX_SHARD)}
    assert len(meta_json(configuration(design), counts, {}, {"failures": [], "images": images})) < MAX_JSON_BYTES
    names = [shard_name(k) for k in range(MAX_SHARDS)]
    sums = {f"{name}/meta.json": 64 * "f" for name in names}
    assert len(meta_json(configuration(design), counts, sums, {"shards": names})) < MAX_JSON_BYTES
