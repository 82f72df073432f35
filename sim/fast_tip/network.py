"""Small perceptrons in numpy, so workers need no torch."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

_MIN_ARRAYS = 4
"""Smallest number of matrices and biases: those of the first and of the last layer."""


@dataclass(frozen=True)
class Network:
    """A perceptron with residual layers."""

    weights: tuple[np.ndarray, ...]
    """Matrices (out, in) and biases (out,) float32 in turn: the first layer, the residual layers, the last layer."""
    skip: np.ndarray | None = None
    """(outputs, inputs) float32, a linear map that is added; None for none."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return outputs (n, out) for inputs (n, in), float32."""
        pairs = list(zip(self.weights[::2], self.weights[1::2], strict=True))
        hidden = _silu(x @ pairs[0][0].T + pairs[0][1])
        for matrix, bias in pairs[1:-1]:
            hidden = hidden + _silu(hidden @ matrix.T + bias)
        out = hidden @ pairs[-1][0].T + pairs[-1][1]
        return out if self.skip is None else out + x @ self.skip.T

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """Return the weights by name, for a file; `name` begins each."""
        out = {f"{name}_{i}": weight for i, weight in enumerate(self.weights)}
        return out if self.skip is None else out | {f"{name}_skip": self.skip}


def _silu(x: np.ndarray) -> np.ndarray:
    """Return x times its logistic function, computed by tanh, which does not overflow."""
    half = 0.5 * x
    return half * (1 + np.tanh(half))


def network_of(arrays: Mapping[str, np.ndarray], name: str, inputs: int, outputs: int) -> Network:
    """Return the network in the arrays of a file (Network.arrays).

    Args:
        arrays: Arrays by name.
        name: How the names of its arrays begin.
        inputs: Number of inputs that it must have.
        outputs: Number of outputs that it must have.

    Raises:
        ValueError: There are no layers that fit together.
    """
    found = [array for key, array in arrays.items() if key.startswith(f"{name}_")]
    skip = arrays.get(f"{name}_skip")
    count = len(found) - (skip is not None)
    if count < _MIN_ARRAYS or count % 2 or any(w.dtype != np.float32 or not np.isfinite(w).all() for w in found):
        raise ValueError(f"{name} must have layers of finite float32")
    network = Network(tuple(arrays[f"{name}_{i}"] for i in range(count)), skip)
    if network(np.zeros((1, inputs), np.float32)).shape != (1, outputs):
        raise ValueError(f"{name} must have {inputs} inputs and {outputs} outputs")
    return network
