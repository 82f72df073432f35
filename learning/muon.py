"""Muon: an optimizer whose step changes a weight matrix as much in every direction of its input as in the strongest.

From Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024). The difference between two poses of an
edge is a small part of the pins' motion, and Adam learns the small parts last. torch has a Muon of its own, for matrices
alone: a convolution's weights are a matrix here, with a row for each filter.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from tactip_twin.learning.posenet import PoseNet

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Of the quintic that brings all singular values near one in five steps [Jordan et al.]."""

_STEPS = 5


class Muon(torch.optim.Optimizer):
    """Steps along the orthogonal factor of the momentum. For weights of two or more dimensions, (out, ...)."""

    def __init__(
        self, params: Iterable[torch.nn.Parameter], lr: float = 0.02, momentum: float = 0.95, half: bool = False
    ) -> None:
        """Make the optimizer.

        Args:
            params: Weights, (out, ...) each.
            lr: Learning rate: about how far a step turns a layer.
            momentum: Decay of the momentum, -.
            half: Whether to find the factor in bfloat16, which is good enough for it [Jordan et al.].
        """
        super().__init__(params, {"lr": lr, "momentum": momentum})
        self._precision = torch.bfloat16 if half else torch.float32

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Take one step, with Nesterov's momentum. closure: ignored; the gradients must be there. Returns None."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["momentum"] = torch.zeros_like(weight)
                state["momentum"].lerp_(weight.grad, 1 - group["momentum"])
                ahead = weight.grad.lerp(state["momentum"], group["momentum"])
                matrix = orthogonal(ahead.reshape(len(ahead), -1).to(self._precision))
                stretch = max(1.0, matrix.shape[0] / matrix.shape[1]) ** 0.5
                weight.add_(matrix.reshape(weight.shape), alpha=-group["lr"] * stretch)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """Return nearly the orthogonal polar factor of a matrix (m, n): its singular values are about 0.7 to 1.2."""
    a, b, c = _COEFFICIENTS
    x = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    x = x / (x.norm() + 1e-7)
    for _ in range(_STEPS):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x.T if matrix.shape[0] > matrix.shape[1] else x


def inner_weights(net: "PoseNet") -> list[torch.nn.Parameter]:
    """Return the weights of a network that Muon is for: those between layers, neither the first nor the last."""
    return [p for p in net.parameters() if p.ndim > 1 and p.shape[1] > 1 and p is not net.dense[-1].weight]
