"""The space of networks that is searched, and what hyperopt needs to know of it."""

from dataclasses import dataclass

import numpy as np
from hyperopt import hp, space_eval

from tactip_twin.learning.posenet import ACTIVATIONS, PoseNetConfig
from tactip_twin.tactip_model.bounds import check, require, within

BATCH_SIZES = (16, 32, 64, 128)
"""Batch sizes [P]."""


@dataclass(frozen=True)
class SearchSpace:
    """What may be tried; the paper's space by default. Filters and units are powers of two from 2 on."""

    most_conv_layers: int = within(1, 8, default=5)
    """Most convolutions [P]."""
    most_filters: int = within(2, 1024, default=512)
    """Most filters [P]; a CPU hardly trains more than 64."""
    most_dense_layers: int = within(1, 5, default=5)
    """Most dense layers [P]."""
    most_units: int = within(2, 4096, default=512)
    """Most units [P]."""
    blur_px: float = within(0, 4, default=0.0)
    """Of every network (PoseNetConfig.blur_px); none [P]."""
    reduce: int = within(1, 8, default=1)
    """Of every network (PoseNetConfig.reduce); 1 [P]. At 2 convolutions multiply a quarter, and 4 of them are the most."""

    def __post_init__(self):
        check(self)

    def checked(self, size):
        """This space. Raises TactipError where some of it leaves no pixels of an image of `size` px."""
        PoseNetConfig(conv_layers=self.most_conv_layers, reduce=self.reduce).last_size(size)
        return self

    def expressions(self):
        """The space as hyperopt's expressions: a dict."""
        require(self.most_filters >= 2, "most_filters", self.most_filters, "at least 2")
        return {
            "conv_layers": hp.randint("conv_layers", 1, self.most_conv_layers + 1),
            "log2_filters": hp.randint("log2_filters", 1, _log2(self.most_filters) + 1),
            "dense_layers": hp.randint("dense_layers", 1, self.most_dense_layers + 1),
            "log2_units": hp.randint("log2_units", 1, _log2(self.most_units) + 1),
            "activation": hp.choice("activation", list(ACTIVATIONS)),
            "batch_norm": hp.choice("batch_norm", [False, True]),
            "dropout": hp.uniform("dropout", 0.0, 0.5),
            "l1": hp.loguniform("l1", np.log(1e-4), np.log(1e-1)),
            "l2": hp.loguniform("l2", np.log(1e-4), np.log(1e-1)),
            "batch_size": hp.choice("batch_size", list(BATCH_SIZES)),
        }

    def network(self, values):
        """The PoseNetConfig of hyperopt's values (dict of label to number)."""
        point = space_eval(self.expressions(), values)
        return self.network_of(point)

    def network_of(self, point):
        """The PoseNetConfig of a point (dict) of the space."""
        plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in point.items()}
        filters, units = 2 ** plain.pop("log2_filters"), 2 ** plain.pop("log2_units")
        return PoseNetConfig(filters=int(filters), units=int(units), blur_px=self.blur_px, reduce=self.reduce, **plain)


def _log2(number):
    return int(np.log2(number))
