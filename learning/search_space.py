"""Conversion between the search space and hyperopt: expressions of the space, and networks from values."""

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
from hyperopt import hp, space_eval

from tactip_twin.learning.configuration import Activation, PoseNetConfig, SearchSpace
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError

BATCH_SIZES = (16, 32, 64, 128)
"""Batch sizes [P]."""


def expressions(space: SearchSpace) -> dict[str, Any]:
    """Return hyperopt's expressions of the space, by label."""
    require(space.max_filters >= 2, "max_filters", space.max_filters, "at least 2")
    return {
        "conv_layers": hp.randint("conv_layers", 1, space.max_conv_layers + 1),
        "log2_filters": hp.randint("log2_filters", 1, _log2(space.max_filters) + 1),
        "dense_layers": hp.randint("dense_layers", 1, space.max_dense_layers + 1),
        "log2_units": hp.randint("log2_units", 1, _log2(space.max_dense_units) + 1),
        "activation": hp.choice("activation", list(get_args(Activation))),
        "batch_norm": hp.choice("batch_norm", [False, True]),
        "dropout": hp.uniform("dropout", 0.0, 0.5),
        "l1": hp.loguniform("l1", np.log(1e-4), np.log(1e-1)),
        "l2": hp.loguniform("l2", np.log(1e-4), np.log(1e-1)),
        "batch_size": hp.choice("batch_size", list(BATCH_SIZES)),
    }


def check_values(space: SearchSpace, values: Any, name: str) -> None:
    """Raise TactipError unless a JSON value holds hyperopt's values of a point of the space. name: of its file."""
    whole = {
        "conv_layers": (1, space.max_conv_layers),
        "log2_filters": (1, _log2(space.max_filters)),
        "dense_layers": (1, space.max_dense_layers),
        "log2_units": (1, _log2(space.max_dense_units)),
        "activation": (0, len(get_args(Activation)) - 1),
        "batch_norm": (0, 1),
        "batch_size": (0, len(BATCH_SIZES) - 1),
    }
    limits = whole | {"dropout": (0, 0.5), "l1": (1e-4, 0.1), "l2": (1e-4, 0.1)}
    if not isinstance(values, dict) or set(values) != set(limits):
        raise TactipError(f"{name}: values must be an object with {', '.join(limits)}")
    for label, (low, high) in limits.items():
        value = values[label]
        right = type(value) is int if label in whole else type(value) in (int, float)
        allowed = f"a {'whole ' if label in whole else ''}number from {low} to {high}"
        if not right or not low * (1 - _ROUNDING) <= value <= high * (1 + _ROUNDING):
            raise TactipError(f"{name}: {label} must be {allowed}, got {value!r:.60}")


_ROUNDING = 1e-9
"""Relative distance that a value may lie outside of its range, because hyperopt computes it from a logarithm."""


def network_of_values(space: SearchSpace, values: Mapping[str, Any]) -> PoseNetConfig:
    """Return the network of hyperopt's values (label to number; for a choice, its index)."""
    return network_of_point(space, space_eval(expressions(space), values))


def network_of_point(space: SearchSpace, point: Mapping[str, Any]) -> PoseNetConfig:
    """Return the network of a point of the space (label to value)."""
    plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in point.items()}
    filters, units = 2 ** plain.pop("log2_filters"), 2 ** plain.pop("log2_units")
    return PoseNetConfig(
        filters=int(filters), dense_units=int(units), blur_px=space.blur_px, downsample=space.downsample, **plain
    )


def _log2(number: int) -> int:
    """Return the base-2 logarithm, rounded down."""
    return int(np.log2(number))
