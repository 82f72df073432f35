"""Trained policies as files of arrays, without pickle: a perceptron from an observed vector to an action."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.fast_tip.archive import check_numbers, pack, unpack
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

FORMAT, VERSION = "tactip-twin policy", 1

_MAX_LAYERS = 8


@dataclass(frozen=True)
class Policy:
    """A deterministic policy: rectified layers, and a hyperbolic tangent at the end."""

    environment: str
    """Name of the environment that it was trained in."""
    options: dict[str, Any]
    """Keyword arguments of that environment, as JSON."""
    scale: np.ndarray
    """(n,) float32 that the observed vector is divided by."""
    weights: tuple[np.ndarray, ...]
    """Matrices (out, in) and biases (out,) float32 in turn."""
    provenance: dict[str, Any]
    """Settings and results of the training, as JSON."""

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return the action (a,) float32, -1 to 1, for an observation with a single vector (modes oracle and pose).

        Raises:
            TactipError: The observation is another one.
        """
        (vector, *others) = observation.values()
        if others or vector.shape != self.scale.shape:
            raise TactipError(
                f"the observation must be one vector of {len(self.scale)} numbers, got {', '.join(observation)}: choose "
                "observation_mode oracle or pose, and the policy's options"
            )
        hidden = vector / self.scale
        pairs = list(zip(self.weights[::2], self.weights[1::2], strict=True))
        for matrix, bias in pairs[:-1]:
            hidden = np.maximum(matrix @ hidden + bias, 0)
        return np.tanh(pairs[-1][0] @ hidden + pairs[-1][1]).astype(np.float32)


def write_policy(policy: Policy, path: Path) -> None:
    """Write a policy to a file. Raises OSError."""
    about = {name: getattr(policy, name) for name in ("environment", "options", "provenance")}
    arrays = {f"layer{i}": array for i, array in enumerate(policy.weights)}
    write_file(path, pack(FORMAT, VERSION, about, arrays | {"scale": policy.scale}))


def read_policy(path: str | Path) -> Policy:
    """Read a policy from a file. Raises TactipError if the file is none, or was altered."""
    about, arrays = unpack(path, FORMAT, VERSION)
    try:
        count = len(arrays) - 1
        if count < 2 or count % 2 or count > 2 * _MAX_LAYERS:
            raise ValueError(f"it must have from 1 to {_MAX_LAYERS} layers, got {count} arrays")
        weights = tuple(arrays[f"layer{i}"] for i in range(count))
        width = len(arrays["scale"])
        shapes: dict[str, tuple[int, ...]] = {"scale": (width,)}
        for i in range(0, count, 2):
            out = len(weights[i])
            shapes |= {f"layer{i}": (out, width), f"layer{i + 1}": (out,)}
            width = out
        check_numbers(arrays, shapes)
        environment, options, provenance = about["environment"], about["options"], about["provenance"]
        if not (isinstance(environment, str) and isinstance(options, dict) and isinstance(provenance, dict)):
            raise ValueError("its description is incomplete")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise TactipError(f"{path} holds no policy: {error}") from error
    return Policy(environment, options, arrays["scale"], weights, provenance)
