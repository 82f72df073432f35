"""Muon: an optimizer that orthogonalizes its step, so a weight matrix changes equally in all directions of its input.

From Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024). Two poses of an edge differ in a small
part of the pins' motion, and Adam learns small parts last. Torch's Muon accepts matrices only; here the weights of a
convolution are treated as a matrix with one row per filter.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from tactip_twin.learning.posenet import PoseNet

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Coefficients of the quintic that brings all singular values near 1 in five iterations [Jordan et al.]."""

_ITERATIONS = 5


class Muon(torch.optim.Optimizer):
    """Optimizer whose step is the orthogonal factor of the momentum, for weights (out, ...) of at least two dimensions."""

    def __init__(
        self, params: Iterable[torch.nn.Parameter], lr: float = 0.02, momentum: float = 0.95, half: bool = False
    ) -> None:
        """Make the optimizer.

        Args:
            params: Weights, (out, ...) each.
            lr: Learning rate, approximately the spectral norm of a step.
            momentum: Decay of the momentum, -.
            half: Whether to compute the factor in bfloat16, which is precise enough [Jordan et al.].
        """
        super().__init__(params, {"lr": lr, "momentum": momentum})
        self._precision = torch.bfloat16 if half else torch.float32

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """Take one step with Nesterov momentum; return None. The gradients must exist already: `closure` is ignored."""
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
    """Return the approximate orthogonal polar factor of a matrix (m, n), with singular values of about 0.7 to 1.2."""
    a, b, c = _COEFFICIENTS
    x = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    x = x / (x.norm() + 1e-7)
    for _ in range(_ITERATIONS):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x.T if matrix.shape[0] > matrix.shape[1] else x


def inner_weights(net: "PoseNet") -> list[torch.nn.Parameter]:
    """Return the weights that Muon optimizes: those of all layers except the first and the last."""
    return [p for p in net.parameters() if p.ndim > 1 and p.shape[1] > 1 and p is not net.dense[-1].weight]
