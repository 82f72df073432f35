"""A set as a torch Dataset gives the samples of the loader, in any process, without keeping them."""

import pickle
import tracemalloc

import numpy as np
import pytest
import torch

import tactip_twin as tt
from helpers.learning_sets import mend_checksums, write_fake_set, write_fake_shards
from tactip_twin.learning.model import to_input
from tactip_twin.sim.dataset.format import encode_image


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return write_fake_shards(tmp_path_factory.mktemp("shards") / "set", shards=4, samples=6, size=24)


def test_samples_are_those_of_the_loader(shards):
    dataset, samples = tt.TactileDataset(shards), tt.read_samples(shards)
    assert len(dataset) == len(samples) == 24 and dataset.size == samples.size
    assert dataset.labels == samples.labels
    assert np.allclose(dataset.scale, samples.labels.scale)
    some = [dataset[i] for i in range(len(dataset))]
    assert torch.equal(torch.stack([s["image"] for s in some]), to_input(torch.from_numpy(samples.images)))
    assert np.array_equal(torch.stack([s["label"] for s in some]).numpy(), samples.targets.astype(np.float32))
    quantities = torch.stack([s["quantities"] for s in some]).numpy()
    assert np.array_equal(quantities, samples.quantities.astype(np.float32), equal_nan=True)
    assert torch.equal(dataset[-1]["image"], some[-1]["image"])
    with pytest.raises(IndexError, match="24 samples, got the index 24"):
        dataset[24]


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_data_loader_with_two_workers_gives_every_sample_once(shards):
    dataset = tt.TactileDataset(shards)
    batches = list(torch.utils.data.DataLoader(dataset, batch_size=5, shuffle=True, num_workers=2))
    assert batches[0]["image"].shape == (5, 1, 24, 24)
    labels = torch.cat([batch["label"] for batch in batches])
    expected = torch.stack([dataset[i]["label"] for i in range(len(dataset))])
    assert torch.equal(labels[labels[:, 0].argsort()], expected[expected[:, 0].argsort()])


def test_memory_does_not_grow_with_the_set(tmp_path):
    size = 200
    dataset = tt.TactileDataset(write_fake_shards(tmp_path / "set", shards=8, samples=6, size=size), cached_shards=1)
    tracemalloc.start()
    for i in range(len(dataset)):
        assert dataset[i]["image"].shape == (1, size, size)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.3 * len(dataset) * size**2


def test_copy_for_another_process_reads_its_own_tables(shards):
    dataset = tt.TactileDataset(shards)
    state = pickle.dumps(dataset)
    assert len(state) < 5000
    assert torch.equal(pickle.loads(state)[7]["label"], dataset[7]["label"])  # noqa: S301


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((20, 20), np.uint8), "image_00002.png .* is 20 by 20 px: all images of a set must be square"),
        (None, "was altered: it does not match its checksum"),
    ],
)
def test_damaged_image_raises_when_it_is_read(tmp_path, image, message):
    folder = write_fake_set(tmp_path / "set", samples=4)
    (folder / "images" / "image_00002.png").write_bytes(b"" if image is None else encode_image(image))
    if image is not None:
        mend_checksums(folder)
    dataset = tt.TactileDataset(folder)
    assert len(dataset) == 4 and dataset[1]["image"].shape == (1, 40, 40)
    with pytest.raises(tt.TactipError, match=message):
        dataset[2]


def test_what_is_not_a_set_raises(tmp_path):
    with pytest.raises(tt.TactipError, match="there is no data set in"):
        tt.TactileDataset(tmp_path)
    with pytest.raises(tt.TactipError, match="cached_shards must be at least 1, got 0"):
        tt.TactileDataset(write_fake_set(tmp_path / "set", samples=2), cached_shards=0)
