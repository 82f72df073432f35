"""Muon: an optimiser whose step turns a weight matrix as much in every direction of its input as in the strongest.

From Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024). What tells two poses of an edge apart
is a small part of what moves the pins, and Adam learns the small parts last. torch has a Muon of its own, for matrices
alone: a convolution's weights are a matrix here, a row for each filter.
"""

import torch

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Of the quintic that brings all singular values near one in five steps [Jordan et al.]."""

_STEPS = 5


class Muon(torch.optim.Optimizer):
    """Steps along the orthogonal factor of the momentum. For weights of two or more dimensions, (out, ...)."""

    def __init__(self, params, lr=0.02, momentum=0.95, half=False):
        """params: tensors. lr: float, about how far a step turns a layer. momentum: float, -. half: bool, find the factor
        in bfloat16, which is good enough for it [Jordan et al.]."""
        super().__init__(params, {"lr": lr, "momentum": momentum})
        self._precision = torch.bfloat16 if half else torch.float32

    @torch.no_grad()
    def step(self, closure=None):
        """One step, with Nesterov's momentum."""
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


def orthogonal(matrix):
    """Nearly the orthogonal factor of the polar decomposition of a matrix (m, n): singular values of about 0.7 to 1.2."""
    a, b, c = _COEFFICIENTS
    x = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    x = x / (x.norm() + 1e-7)
    for _ in range(_STEPS):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x.T if matrix.shape[0] > matrix.shape[1] else x


def inner_weights(net):
    """The weights (list of parameters) of a PoseNet that Muon is for: between layers, neither the first nor the last."""
    return [p for p in net.parameters() if p.ndim > 1 and p.shape[1] > 1 and p is not net.dense[-1].weight]
