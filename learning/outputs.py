"""Outputs of a network and their loss: means of pose and other quantities, with standard deviations.

    n components: means (n), if `deviations` log standard deviations (n), if one is circular its cosine

All but a circular component's sine (in its place among the means) and cosine are over the components' scales. Components are
those of the pose, then, if `quantities`, QUANTITIES.

Without deviations, the loss of a sample is the sum of the squared errors [P]. With them it is the sum of the negative log
likelihoods of a normal distribution, each times the 2β-th power of its deviation, taken as a constant: otherwise components
with small errors would dominate, and means that are hard to learn would stay underfitted (Seitzer et al., "On the Pitfalls
of Heteroscedastic Uncertainty Estimation", ICLR 2022) [R].
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import softplus

from tactip_twin.learning.configuration import PoseNetConfig
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.quantities import QUANTITIES

_MIN_LOG_DEVIATION = float(np.log(1e-3))
"""Smallest logarithm of a standard deviation over its scale: 5 µm of 5 mm."""

_MAX_LOG_DEVIATION = float(np.log(30.0))
"""Largest one: 150 mm of 5 mm. Without it, weights of the loss overflow where a network first sees images unlike those that
it was trained on."""

_INITIAL_LOG_DEVIATION = float(np.log(0.3))
"""That of a network with zero weights: the order of the labels' own [?]."""


@dataclass(frozen=True)
class Split:
    """Outputs of a network for m images, over the components' scales."""

    means: torch.Tensor
    """(m, n)."""
    log_deviations: torch.Tensor | None
    """(m, n), or None if the network does not estimate them."""
    circular: "Circular | None" = None
    """The component that comes back to where it began, if there is one."""

    def squares(self, targets: torch.Tensor) -> torch.Tensor:
        """Return the squared errors (m, n) of targets (m, n), over the scales; 0 where a target is NaN.

        That of a circular component is the squared chord between the estimated sine and cosine and those of the target: for
        small errors that of the angle, and without a jump.
        """
        known = torch.isfinite(targets)
        wanted = torch.where(known, targets, 0.0)
        squares = (self.means - wanted).square()
        if self.circular is not None:
            c = self.circular
            angle = c.scale_rad * wanted[:, c.index]
            chord = (c.sine - angle.sin()).square() + (c.cosine - angle.cos()).square()
            columns = list(squares.unbind(1))
            columns[c.index] = chord / c.scale_rad**2
            squares = torch.stack(columns, 1)
        return torch.where(known, squares, 0.0)


@dataclass(frozen=True)
class Circular:
    """A circular component as a network estimates it."""

    index: int
    """Its place among the components."""
    scale_rad: float
    """Its scale, rad."""
    sine: torch.Tensor
    """(m,), about the sine."""
    cosine: torch.Tensor
    """(m,), about the cosine."""


class Layout:
    """Arrangement of a network's outputs."""

    def __init__(self, config: PoseNetConfig, labels: Labels) -> None:
        """Take the network, and the components of the pose that it estimates."""
        components = len(labels.components)
        self.circular, self._scale_rad = labels.circular, 1.0
        """Place of the circular component; None if there is none."""
        if self.circular is not None:
            self._scale_rad = float(np.radians(labels.scale[self.circular]))
        self.components = components + (len(QUANTITIES) if config.quantities else 0)
        """Number of means."""
        self._deviations = config.deviations

    @property
    def size(self) -> int:
        """Number of outputs."""
        return self.components * (2 if self._deviations else 1) + (self.circular is not None)

    def split(self, raw: torch.Tensor) -> Split:
        """Return the parts of outputs (m, size)."""
        n = self.components
        logs = None
        if self._deviations:
            # Above the minimum, and nearly the identity well above it.
            logs = _MIN_LOG_DEVIATION + softplus(raw[:, n : 2 * n] + _INITIAL_LOG_DEVIATION - _MIN_LOG_DEVIATION)
            logs = logs.clamp(max=_MAX_LOG_DEVIATION)
        means = raw[:, :n]
        if self.circular is None:
            return Split(means, logs)
        sine, cosine = means[:, self.circular], raw[:, -1]
        columns = list(means.unbind(1))
        columns[self.circular] = torch.atan2(sine, cosine) / self._scale_rad
        return Split(torch.stack(columns, 1), logs, Circular(self.circular, self._scale_rad, sine, cosine))

    def rows_of(self, earlier: "Layout") -> list[tuple[int, int]]:
        """Return pairs of output rows, of this layout and of an `earlier` one of the same pose, that mean the same."""
        shared = min(self.components, earlier.components)
        same = self.circular == earlier.circular
        pairs = [(k, k) for k in range(shared) if same or k not in (self.circular, earlier.circular)]
        if self._deviations and earlier._deviations:
            pairs += [(self.components + k, earlier.components + k) for k in range(shared)]
        if self.circular is not None and self.circular == earlier.circular:
            pairs.append((self.size - 1, earlier.size - 1))
        return pairs


def losses(split: Split, targets: torch.Tensor, beta: float) -> torch.Tensor:
    """Return the loss of each sample, (m,); targets that are NaN do not count.

    Args:
        split: Outputs.
        targets: (m, n) over the components' scales.
        beta: Exponent β of the negative log likelihoods; 0: without weights.
    """
    known, squares = torch.isfinite(targets), split.squares(targets)
    if split.log_deviations is None:
        return squares.sum(1)
    logs = split.log_deviations
    each = 0.5 * squares * torch.exp(-2 * logs) + logs
    if beta:
        each = each * torch.exp(2 * beta * logs.detach())
    return torch.where(known, each, 0.0).sum(1)


def scaled_loss(split: Split, targets: torch.Tensor) -> torch.Tensor:
    """Return the mean loss of samples, (), with each component's deviations multiplied by the factor for which it is least.

    That factor is the root mean square of errors over deviations. Without deviations, it is the mean of `losses`.

    Args:
        split: Outputs.
        targets: (m, n) over the components' scales; NaN does not count.
    """
    if split.log_deviations is None:
        return losses(split, targets, beta=0.0).mean()
    known = torch.isfinite(targets)
    logs, count = torch.where(known, split.log_deviations, 0.0), known.sum(0).clamp(min=1)
    square = (split.squares(targets) * torch.exp(-2 * logs)).sum(0) / count
    each = 0.5 + 0.5 * square.clamp(min=1e-12).log() + logs.sum(0) / count
    return (each * known.to(each.dtype).mean(0)).sum()
