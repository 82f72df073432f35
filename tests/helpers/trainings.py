"""Small trainings, for tests of what they write."""

import torch

from tactip_twin.learning.configuration import PoseNetConfig, TrainSettings
from tactip_twin.learning.train import train

NET = PoseNetConfig(conv_layers=2, filters=6, dense_units=24, dropout=0.1, l1=0, l2=1e-5, batch_size=8)


QUICK = TrainSettings(epochs=4, learning_rate=3e-3)


def weights(folder):
    return torch.load(folder / "model.pt", weights_only=True)


def same(a, b):
    return all(torch.equal(a[k], b[k]) for k in a) and a.keys() == b.keys()


def quiet(*arguments, **options):
    return train(*arguments, log=lambda line: None, quiet=True, **options)
